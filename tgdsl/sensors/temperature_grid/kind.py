"""Temperature grid: heat in links that are divided into cells, and between these and what they touch.

The box of each link has nx × ny × nz cells of one material, and θ_i = T_i − T_a is a cell's temperature above ambient [K]. A
step of Δt solves, one after the other:

1. radiation beyond its tangent at ambient, εσ (T⁴ − T_a⁴ − 4 T_a³ θ), from the surfaces of cells (`losses`);
2. all else together: conduction θ̇ = α ∇²θ with α = k/(ρc), the losses (h + 4εσ T_a³) θ from the faces, a source of P/N in each
   cell or q A_i at a face, and contact with bodies and links, C_i θ̇_i = Σ_n g_in (φ_n − θ_i).

Conduction, linear losses and sources are exact in time (`diffusion`). Contact is exact for steady flows, and between bodies of
one temperature each; otherwise two numbers describe a flow's course in the step (`conduction`). g_in follows from the area of
the patch, both conductivities and the constriction of heat to a small spot (`patch_flow`).

    y ← T + (y − T_before) e^(−Δt/τ) − (T − T_before)(1 − e^(−Δt/τ)) τ/Δt                                  [°C]

is the reading of a sensing element with time constant τ, exact where T is linear between calls. C_i = ρcV_i is a cell's heat
capacity [J/K]. Without a source, losses and conduction keep temperatures between extremes of links and surroundings for any Δt.
The splitting of 1 and 2 is of first order in Δt; objects with cells have all their losses in 1. A patch has the area of the
contact points' convex hull, or A = π (3 F R/4E*)^(2/3) of a Hertzian contact under the normal force F, whichever is larger.

The heat of objects is part of the sensor's state. An object has one temperature, and conducts from a patch to its middle as a
cube of its volume would, or a grid with `cells`. An episode begins at the temperatures of the document or the state, and the
first reading is these.

Sums are compensated: a float32 module keeps increments to 2⁻⁴⁸ of a temperature, and heat that leaves one cell enters another.
`<sensor>/heat` reports for each link the heat stored above ambient, and this call's heat from source, radiation, convection and
contact [J]. `<sensor>/objects` reports the same for each object, and its temperature.

Source: Incropera et al., *Fundamentals of Heat and Mass Transfer*; Johnson, *Contact Mechanics*, 4.2 (Hertz). The order of
steps and the lag are from Chung et al., *Tactile Genesis*.

Departures: fluxes act on areas, conduction is implicit, the area of a point contact is an area, and the lag is exact.
`paper_step` has the printed formulas.

Limits: a link is a solid box, with the box's heat capacity and exposed faces. Patches do not shade faces from losses.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.fields.materials import Material
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.patches import ContactPatches, is_cell, outer_areas, tables
from tgdsl.sensors.base import Axis, Channel, Constants, Context, Kind, Lowered, Memory, State, SurfaceOf, scalar
from tgdsl.sensors.noise import BASE
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius
from tgdsl.sensors.temperature_grid.reference import reference
from tgdsl.sensors.temperature_grid.spec import TemperatureGridSpec, alternatives, boxes_of, counts, warn_of_coarse
from tgdsl.sensors.temperature_grid.step import Heat, advanced

HEAT = tuple(Channel(name, "J") for name in ("stored", "source", "radiation", "convection", "contact"))
OBJECTS = (Channel("temperature", "degC"), *(Channel(name, "J") for name in ("stored", "radiation", "convection", "contact")))


def lower(spec: TemperatureGridSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Divide the links' boxes into cells; what of a step does not depend on Δt is computed."""
    boxes = boxes_of(spec, layout, surface_of)
    count, size = counts(spec, boxes), boxes[:, 1] - boxes[:, 0]
    there = is_cell(count)
    made_of = [spec.material_of(link.name) for link in layout.links]
    conductivity = np.array([material.conductivity for material in made_of])
    for pattern in spec.materials:
        if not any(fnmatchcase(link.name, pattern) for link in layout.links):
            link_names = ", ".join(link.name for link in layout.links)
            raise LowerError(
                f'`materials`: no link of the sensor matches "{pattern}"', field="materials", hint=f"it has {link_names}"
            )
    film, radiated = _films(spec, made_of, size / count, count)
    if film.any():
        names, total = [link.name for link in layout.links], _radiated(spec, made_of) + (spec.convection or 0.0)
        warn_of_coarse(names, count, size, spec.exposed, conductivity, total)
    constants = tables(count, size, spec.exposed, film * (size / count) / conductivity[:, None]) | {
        "box": np.concatenate([boxes[:, 0], size / count, count], axis=1),
        "conductivity": conductivity,
        "volumetric_heat": np.array([material.density * material.specific_heat for material in made_of]),
        "ambient": scalar(spec.ambient),
        "start": scalar(spec.start - spec.ambient),
        "is_cell": there.astype(np.float64),
        **_contact(spec, made_of, size),
    }
    if film.any():
        constants |= {"film": film, "film_radiated": radiated}
    if spec.emissivity is not None:
        constants["emissivity"] = _emissivities(spec, made_of)
    if spec.convection is not None:
        constants["convection"] = scalar(spec.convection)
    if spec.source is not None:
        constants |= _source(spec, count, size)
    if "source" in constants:
        constants["power"] = constants["source"].sum(axis=(1, 2, 3))
    shape = there.shape
    state = {"cells": Memory(shape=shape), "cells_low": Memory(shape=shape)}
    if spec.feels:
        state |= {"objects": Memory(shape=ContactPatches), "objects_low": Memory(shape=ContactPatches)}
    if spec.lag is not None:
        constants["lag"], state["measured"] = scalar(spec.lag), Memory(shape=shape)
    rows = _rows(spec, layout, count, boxes)
    read = np.flatnonzero(_is_read(spec, count, size))
    if spec.outputs in ("cells", "surface"):
        if len(read) < there.size:
            constants["read"] = read
    else:
        constants["share"] = there / there.sum(axis=(1, 2, 3), keepdims=True)
        constants[spec.outputs] = scalar(1.0)
    constants |= {
        f"is_{name}": scalar(1.0) for name in (spec.scheme, spec.model) if name in ("spectral", "semi_implicit", "paper")
    }
    is_stiff = all(material.youngs_modulus is not None for material in made_of)
    reports, report_rows = {"heat": HEAT}, {}
    if spec.feels:
        reports["objects"], report_rows["objects"] = OBJECTS, Axis("object", len(spec.feels), {"object": spec.feels})
    return Lowered(
        channels=(Channel("temperature", "degC"),),
        constants=constants,
        state=state,
        requests=(
            ContactPatches(
                spec.feels,
                slots=spec.slots,
                boxes=boxes,
                is_star=spec.model == "paper",
                needs_stiffness=spec.contact_area == "manifold" and not is_stiff,
            ),
        ),
        rows=rows,
        reports=reports,
        report_rows=report_rows,
    )


def _emissivities(spec: TemperatureGridSpec, made_of: list[Material]) -> Float[np.ndarray, " row"]:
    if spec.emissivity is None:
        return np.zeros(len(made_of))
    return np.array([material.emissivity if spec.emissivity == "material" else spec.emissivity for material in made_of])


def _films(
    spec: TemperatureGridSpec, made_of: list[Material], step: Float[np.ndarray, "row 3"], count: Int[np.ndarray, "row 3"]
) -> tuple[Float[np.ndarray, "row 3"], Float[np.ndarray, " row"]]:
    """Return u₀ of each link's faces across each axis [W/(m²·K)], and the share of it that is radiation: see `losses`."""
    if spec.model == "paper":
        return np.zeros(step.shape), np.zeros(len(step))
    k = np.array([material.conductivity for material in made_of])[:, None]
    radiated = _radiated(spec, made_of)
    total = radiated + (spec.convection or 0.0)
    num_ends = np.array([sum(face[1] == axis for face in spec.exposed) for axis in "xyz"])
    resistance = step / (2.0 * k) * (1.0 - num_ends / (3.0 * count))
    return total[:, None] / (1.0 + total[:, None] * resistance), radiated / np.where(total > 0, total, 1.0)


def _radiated(spec: TemperatureGridSpec, made_of: list[Material]) -> Float[np.ndarray, " row"]:
    return 4.0 * stefan_boltzmann() * _emissivities(spec, made_of) * (spec.ambient + zero_celsius()) ** 3


def _contact(spec: TemperatureGridSpec, made_of: list[Material], size: np.ndarray) -> dict[str, np.ndarray]:
    """Return what areas and conductances of patches follow from."""
    if not spec.feels:
        return {}
    result = {}
    if spec.contact_area == "manifold":
        moduli = [(material.youngs_modulus, material.poissons_ratio or 0.0) for material in made_of]
        result["compliance"] = np.array([0.0 if e is None else (1.0 - nu * nu) / e for e, nu in moduli])
        radius = 0.5 * size.min(axis=1) if spec.curvature_radius is None else np.full(len(size), spec.curvature_radius)
        result["curvature"] = 1.0 / radius
    else:
        result["contact_area"] = scalar(spec.contact_area)
    if spec.contact_conductance is not None:
        result["contact_conductance"] = scalar(spec.contact_conductance)
    return result


def _source(spec: TemperatureGridSpec, count: np.ndarray, size: np.ndarray) -> dict[str, np.ndarray]:
    """Return the heat source of each cell (row, x, y, z) [W]; for the paper's formula q/Δ of each row [W/m³]."""
    source, there = spec.source, is_cell(count)
    assert source is not None
    if source.flux is None or source.face is None:
        return {"source": (source.power or 0.0) * there / there.sum(axis=(1, 2, 3), keepdims=True)}
    if spec.model == "paper":
        return {"paper_source": source.flux / (size / count)[:, "xyz".index(source.face[1])]}
    return {"source": source.flux * outer_areas(count, size, [source.face])}


def _is_read(spec: TemperatureGridSpec, count: np.ndarray, size: np.ndarray) -> np.ndarray:
    return outer_areas(count, size, ("-x", "+x", "-y", "+y", "-z", "+z")) > 0 if spec.outputs == "surface" else is_cell(count)


def _rows(spec: TemperatureGridSpec, layout: Layout, count: np.ndarray, boxes: np.ndarray) -> Axis:
    """Return the rows of the reading with their boxes: centres and sides, along the bodies' axes [m]."""
    sides = boxes[:, 1] - boxes[:, 0]
    if spec.outputs not in ("cells", "surface"):
        table = {"link": [link.name for link in layout.links], "pos": 0.5 * (boxes[:, 0] + boxes[:, 1]), "size": sides}
        return Axis("body", len(boxes), table, np.arange(len(boxes)))
    row, *at = np.nonzero(_is_read(spec, count, sides))
    size = (sides / count)[row]
    pos = boxes[row, 0] + (np.stack(at, axis=1) + 0.5) * size
    table = {"link": [layout.links[i].name for i in row], "pos": pos, "size": size, "cell": np.stack(at, axis=1)}
    return Axis("cell", len(row), table, row.astype(np.int64))


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return temperatures [°C], and the stored and received heat of each link and object [J]."""
    previous = state["cells"]
    heat = advanced(gathered[ContactPatches], context, constants, state)
    new = {"cells": heat.cells, "cells_low": heat.cells_low}
    if "objects" in state:
        new |= {"objects": heat.objects.flatten(1), "objects_low": heat.objects_low.flatten(1)}
    seen = heat.cells + heat.cells_low
    if "lag" in constants:
        seen = new["measured"] = _lagged(seen, previous, state["measured"], constants, context)
    readings = {"signal": (_output(seen, constants) + constants["ambient"])[:, None], **_reports(heat, constants)}
    return readings, new


def _lagged(after: Tensor, before: Tensor, measured: Tensor, constants: Constants, context: Context) -> Tensor:
    """Return the reading of an element with a lag, for temperatures that are linear between calls [K]."""
    is_first = context.is_first[..., None, None, None]
    ratio = context.dt / constants["lag"]
    if "is_paper" in constants:
        return torch.where(is_first, after, measured + ratio * (after - measured))
    decay, moved = torch.exp(-ratio), -torch.expm1(-ratio) / ratio
    return torch.where(is_first, after, after + (measured - before) * decay - (after - before) * moved)


def _output(cells: Tensor, constants: Constants) -> Tensor:
    """Return the reading above ambient, from cells above ambient, (env, row)."""
    if "share" not in constants:
        flat = cells.flatten(1)
        return flat[:, constants["read"]] if "read" in constants else flat
    if "mean" in constants:
        return (cells * constants["share"]).sum(dim=(-3, -2, -1))
    return torch.where(constants["is_cell"] > 0, cells, -torch.inf).amax(dim=(-3, -2, -1))


def _reports(heat: Heat, constants: Constants) -> dict[str, Tensor]:
    """Return the reports, (env, channel, row)."""
    reports = {"heat/signal": torch.stack([heat.stored, *heat.gained], dim=1)}
    if heat.of_objects:
        above, *rest = heat.of_objects
        reports["objects/signal"] = torch.stack([above + constants["ambient"], *rest], dim=1)
    return reports


TEMPERATURE_GRID = Kind(
    TemperatureGridSpec,
    lower,
    forward,
    reference,
    knobs=BASE,
    is_timed=True,
    alternatives=alternatives,
)
