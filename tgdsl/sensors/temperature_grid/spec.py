"""What a document says of a temperature grid."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, StrictInt, model_validator

from tgdsl.errors import CoarseCellsWarning, LowerError
from tgdsl.fields.materials import Material, MaterialField
from tgdsl.fields.models import Area, PositiveLength, Quantity, SpecModel, Temperature, Usual
from tgdsl.fields.regions import Region
from tgdsl.layout.layout import Layout
from tgdsl.quantities.contacts import DEFAULT_PATCH_SLOTS
from tgdsl.quantities.patches import is_cell, tables
from tgdsl.sensors.base import Alternative, LinkSpec, SurfaceOf

Face = Literal["-x", "+x", "-y", "+y", "-z", "+z"]
FACES: tuple[Face, ...] = ("-x", "+x", "-y", "+y", "-z", "+z")
"""Faces of a box, by the axis of the link's frame that they are across, and on which side."""
HeatTransfer = Annotated[float, Quantity("heat_transfer", gt=0.0)]
Cells = Annotated[tuple[Annotated[StrictInt, Field(ge=1)], ...], Field(min_length=3, max_length=3)]


class HeatSource(SpecModel):
    """A heat source in each link: `power` or `flux`."""

    power: Annotated[Annotated[float, Quantity("power")] | None, Usual("power", high=100.0)] = None
    """In all of each link, evenly [W]."""
    flux: Annotated[Annotated[float, Quantity("heat_flux")] | None, Usual("heat_flux", high=1e6)] = None
    """Through a face of each link's box, into the cells there [W/m²]."""
    face: Face | None = None
    """The face of `flux`."""

    @model_validator(mode="after")
    def _check(self) -> HeatSource:
        if (self.power is None) == (self.flux is None):
            raise ValueError("expected one of `power` and `flux`")
        if (self.flux is None) != (self.face is None):
            raise ValueError("`face` says where `flux` comes in: expected both or neither")
        return self


class TemperatureGridSpec(LinkSpec):
    """Temperatures of links that are divided into cells."""

    kind: Literal["temperature_grid"]
    """Temperature of each cell of a link [°C], by conduction within it, heat made there, losses, and what it touches."""
    feels: tuple[str, ...] = ()
    """Objects that heat flows to and from where they touch. An object that is a body of one of the links is that link."""
    cells: Cells | None = None
    """How many cells the box of each link is divided into, along x, y and z of the link's frame."""
    spacing: Annotated[PositiveLength | None, Usual("length", low=1e-5, high=0.1)] = None
    """Largest size of the cells, instead of `cells` [m]."""
    region: Region = ()
    """Part of each link's surface whose box is divided, such as a geom by its name; default: all of the link's surface."""
    material: MaterialField
    """Material of the links, by name or by its properties."""
    materials: dict[str, MaterialField] = {}
    """Other materials, by links' names or shell wildcards; the first that matches counts."""
    ambient: Temperature = 22.0
    """Temperature of the surroundings [°C]."""
    temperature: Temperature | None = None
    """Temperature at which the links begin an episode [°C]; default: ambient."""
    scheme: Literal["exact", "spectral", "semi_implicit"] = "exact"
    """Conduction within a link in a step: `exact` for the cells' equations, without overshoot; `spectral` by the modes of the
    continuous solid, which overshoots a jump by up to 4 %; `semi_implicit`, of first order in time (the paper)."""
    model: Literal["physical", "paper"] = "physical"
    """`paper`: the formulas as printed, which are unstable and lack the units of a heat flow."""
    source: HeatSource | None = None
    """Heat source in the links; default: none."""
    emissivity: Literal["material"] | Annotated[float, Quantity("number", ge=0.0, le=1.0)] | None = None
    """Radiation of the exposed faces and of the objects: `material`, or the links' emissivity [1]; default: none."""
    convection: HeatTransfer | None = None
    """Convection from the exposed faces and the objects: heat transfer coefficient [W/(m²·K)]; default: none."""
    exposed: Annotated[tuple[Face, ...], Field(min_length=1)] = FACES
    """Faces that lose heat by radiation and convection."""
    contact_area: Literal["manifold"] | Area = "manifold"
    """Area of a patch: `manifold`, the contact points' convex hull, or by Hertz from the force, whichever is larger; or this,
    whenever they touch [m²]. A side whose material has no Young's modulus, as skin, counts as rigid."""
    contact_conductance: HeatTransfer | None = None
    """Conductance of the interface itself, such as roughness or a film [W/(m²·K)]; default: no resistance."""
    curvature_radius: Annotated[PositiveLength | None, Usual("length", low=1e-4, high=1.0)] = None
    """Radius of the links' surface where they touch, for Hertz [m]; default: half of the shortest side of its box."""
    slots: Annotated[StrictInt, Field(ge=1, le=32)] = DEFAULT_PATCH_SLOTS
    """Contacts per link and object that make a patch [1]."""
    lag: Annotated[Annotated[float, Quantity("time", gt=0.0)] | None, Usual("time", low=1e-4, high=100.0)] = None
    """Time constant of the sensing element, by which readings trail temperatures [s]; default: none."""
    outputs: Literal["cells", "surface", "max", "mean"] = "cells"
    """Rows of the reading: every cell, the cells at the faces of the box, or the maximum or mean of each link."""

    @model_validator(mode="after")
    def _check(self) -> TemperatureGridSpec:
        if (self.cells is None) == (self.spacing is None):
            raise ValueError("expected one of `cells` and `spacing`")
        for name, where in self._without_effect:
            raise ValueError(f"`{name}` has no effect {where}; remove it")
        if self.model == "paper" and self.source is not None and self.source.flux is None:
            raise ValueError("the source of `model: paper` is a `flux`, found `power`")
        return self

    @property
    def _without_effect(self) -> Iterator[tuple[str, str]]:
        """Fields that others make meaningless, and by which."""
        idle: list[tuple[bool, set[str], str]] = [
            (self.model == "paper", {"scheme", "contact_conductance"}, "with `model: paper`"),
            (not self.feels, {"contact_area", "contact_conductance", "curvature_radius", "slots"}, "without `feels`"),
            (self.contact_area != "manifold", {"curvature_radius"}, "with a given `contact_area`"),
            (self.emissivity is None and self.convection is None, {"exposed"}, "without `emissivity` or `convection`"),
        ]
        for is_idle, names, where in idle:
            yield from ((name, where) for name in sorted(names & self.model_fields_set) if is_idle)

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that the sensor feels."""
        return self.feels

    @property
    def start(self) -> float:
        """Temperature at which the links begin [°C]."""
        return self.ambient if self.temperature is None else self.temperature

    def material_of(self, link: str) -> Material:
        """Return a link's material."""
        return next((material for pattern, material in self.materials.items() if fnmatchcase(link, pattern)), self.material)


def alternatives(spec: TemperatureGridSpec) -> list[Alternative]:
    """Return coarser cells, the other schemes, and cells of half the size."""
    if spec.model == "paper":
        return []

    def resolved(label: str, factor: float) -> Alternative:
        if spec.spacing is not None:
            return Alternative(label, {"spacing": factor * spec.spacing, "scheme": "exact"})
        assert spec.cells is not None
        return Alternative(label, {"cells": [max(1, round(num / factor)) for num in spec.cells], "scheme": "exact"})

    schemes = [Alternative(scheme, {"scheme": scheme}) for scheme in ("semi_implicit", "spectral", "exact")]
    return [resolved("cells of twice the size", 2.0), *schemes, resolved("cells of half the size", 0.5)]


MOST = 1_000_000  # cells that a sensor has at most, each link counted as if it had as many along each axis as the one with most


def boxes_of(spec: TemperatureGridSpec, layout: Layout, surface_of: SurfaceOf) -> Float[np.ndarray, "row 2 3"]:
    """Return the lowest and highest corner of each link's box in its body's frame [m].

    Raises:
        LowerError: If two links are one body, or a box has no volume.
    """
    if len(layout.bodies) != len(layout.links):
        raise LowerError(
            "two of its links are one body", field="links", hint="name the body, or choose a part of it by `region`"
        )
    results = []
    for link in layout.links:
        surface = surface_of(link.name, spec.region)
        used = surface.vertices[np.unique(surface.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        if not (high - low > 1e-9).all():
            raise LowerError(f'the box of link "{link.name}" has no volume', field="links", hint="a link needs a solid")
        results.append((low, high))
    return np.array(results)


def counts(spec: TemperatureGridSpec, corners: Float[np.ndarray, "row 2 3"]) -> Int[np.ndarray, "row 3"]:
    """Return how many cells each box has along each axis.

    Raises:
        LowerError: If there are more than `MOST`.
    """
    if spec.cells is not None:
        result = np.tile(np.array(spec.cells, dtype=np.int64), (len(corners), 1))
    else:
        assert spec.spacing is not None
        result = np.maximum(1, np.ceil((corners[:, 1] - corners[:, 0]) / spec.spacing - 1e-9).astype(np.int64))
    # Rows are padded to the longest along each axis.
    if (total := len(result) * float(np.prod(result.max(axis=0, initial=1), dtype=np.float64))) > MOST:
        field = "cells" if spec.spacing is None else "spacing"
        raise LowerError(
            f"its links have {total:.3g} cells, expected at most {MOST:,}", field=field, hint="use fewer, larger cells"
        )
    return result


def centres(count: Int[np.ndarray, "row 3"], corners: Float[np.ndarray, "row 2 3"]) -> Float[np.ndarray, "cell 3"]:
    """Return the centres of all cells, row after row, in their bodies' frames [m]."""
    step = (corners[:, 1] - corners[:, 0]) / count
    row, *at = np.nonzero(is_cell(count))
    return corners[row, 0] + (np.stack(at, axis=1) + 0.5) * step[row]


LARGEST_ERROR = 0.01  # error of the heat lost up to which cells are fine enough [1]
EARLY = 0.5  # when they are compared, in time constants of the cells: two fifths of the heat are lost then
MOST_CELLS = 64  # cells along an axis that are tried


def warn_of_coarse(
    names: Sequence[str],
    count: Int[np.ndarray, "row 3"],
    size: Float[np.ndarray, "row 3"],
    exposed: Sequence[str],
    conductivity: Float[np.ndarray, " row"],
    film: Float[np.ndarray, " row"],
) -> None:
    """Warn of the link whose cells err most, and name the cells that would do.

    Args:
        names: The links.
        count: Their cells along each axis.
        size: Sides of their boxes [m].
        exposed: Faces that lose heat.
        conductivity: k [W/(m·K)].
        film: Heat transfer coefficient of a face near ambient [W/(m²·K)].
    """
    errors = [abs(lost_error(*row, exposed)) for row in zip(count, size, film / conductivity, strict=True)]
    worst = int(np.argmax(errors))
    if errors[worst] <= LARGEST_ERROR:
        return
    across = np.array([any(face[1] == axis for face in exposed) for axis in "xyz"])
    size, ratio = size[worst], film[worst] / conductivity[worst]
    enough = f"more than {MOST_CELLS} along an axis would be needed"
    for most in range(2, MOST_CELLS + 1):
        finer = np.where(across, np.maximum(count[worst], most), count[worst])
        if abs(lost_error(finer, size, ratio, exposed)) <= LARGEST_ERROR:
            enough = f"{_times(finer)} cells hold {100 * LARGEST_ERROR:g} %"
            break
    problem = f"what its faces lose is {100 * errors[worst]:.2g} % wrong with {_times(count[worst])} cells"
    warnings.warn(f"heat of {names[worst]}: {problem}; {enough}", CoarseCellsWarning, stacklevel=2)


def _times(count: Int[np.ndarray, " axis"]) -> str:
    return " × ".join(str(number) for number in count.tolist())


def lost_error(
    count: Int[np.ndarray, " axis"], size: Float[np.ndarray, " axis"], ratio: float, exposed: Sequence[str]
) -> float:
    """Return the relative error of the heat that cells have lost after `EARLY`.

    The oracle is the closed form of a box that cools from one temperature:

        θ̄ = Π_a Σ_m 4 sin² β/(β (2β + sin 2β)) e^(−β² αt/L²),   β tan β = hL/k                                          [1]

    is the mean remaining temperature of a box, a product over the axes with exposed faces. L is the box's side along one, or
    half of it if both of its faces are exposed. The cells' value is the sum of their modes. The two are compared when two
    fifths of the heat are lost. Cells start with an even flow to the face, the solid with a steeper one, which cells too large
    for Bi = hL/k miss.

    Source: Carslaw and Jaeger, *Conduction of Heat in Solids*, 3.11; Incropera et al., 5.5 and 5.8.

    Shapes: `row` links, `axis` x, y and z.

    Args:
        count: Cells along each axis.
        size: Sides of the box [m].
        ratio: Heat transfer coefficient of its faces over conductivity [1/m].
        exposed: The faces.
    """
    ends = np.array([sum(face[1] == axis for face in exposed) for axis in "xyz"])
    step = size / count
    loss = ratio * step / (1.0 + ratio * step / 2.0 * (1.0 - ends / (3.0 * count)))
    slowest = tables(count[None], size[None], exposed, loss[None])
    rates = [slowest[f"square_{axis}"][0] / step[a] ** 2 for a, axis in enumerate("xyz")]
    time = EARLY / sum(rate.min() for rate in rates)
    ours, exact = 1.0, 1.0
    for a, axis in enumerate("xyz"):
        ours *= float(slowest[f"total_{axis}"][0] ** 2 @ np.exp(-rates[a] * time)) / count[a]
        if ends[a]:
            exact *= _slab_left(ratio * size[a] / ends[a], time / (size[a] / ends[a]) ** 2)
    return (1.0 - ours) / (1.0 - exact) - 1.0


def _slab_left(biot: float, fourier: float, count: int = 40) -> float:
    """Return the mean of a slab that began at 1 and loses heat at one of its faces."""
    low, high = np.pi * np.arange(count), np.pi * (np.arange(count) + 0.5)
    for _ in range(60):
        middle = 0.5 * (low + high)
        is_below = middle * np.sin(middle) * (-1.0) ** np.arange(count) < biot * np.cos(middle) * (-1.0) ** np.arange(count)
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    beta = 0.5 * (low + high)
    share = 4.0 * np.sin(beta) ** 2 / (beta * (2.0 * beta + np.sin(2.0 * beta)))
    return float(share @ np.exp(-(beta**2) * fourier))
