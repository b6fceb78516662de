"""From requests for contact patches to their part of the Plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.quantities.base import Planning, Use
from tgdsl.quantities.contacts.planning import is_counted
from tgdsl.quantities.pairs import Pair
from tgdsl.quantities.patches.cells import tables
from tgdsl.quantities.patches.part import PatchesPart, PatchesUse
from tgdsl.quantities.patches.request import ContactPatches
from tgdsl.quantities.patches.topology import Topology
from tgdsl.surfaces.sensed import ObjectHeat

HINT = "give it `material`, and `temperature` if it does not begin at the sensor's ambient"


def plan(planning: Planning, uses: Sequence[Use]) -> PatchesPart[np.ndarray]:
    """Return the part of the Plan; an object without heat, or with that of two sensors, is a mistake."""
    held: dict[str, str] = {}
    found = []
    for use in uses:
        if _check(planning, use, held):
            found.append(_use(planning, use))
    return PatchesPart(tuple(found))


def _check(planning: Planning, use: Use, held: dict[str, str]) -> bool:
    """Return whether the objects of a use have heat that is this use's alone; note what is wrong."""
    assert isinstance(use.request, ContactPatches)
    is_well = True
    for name in use.request.objects:
        heat, others = planning.sensed[name].heat, [*([held[name]] if name in held else []), *use.sensors]
        if heat is None:
            planning.report(("objects", name), "it has no `material`, and a sensor of temperature feels it", HINT)
        elif heat.cells and not np.isfinite(heat.volume).all():
            planning.report(
                ("objects", name, "cells"), "a plane is without bounds, and has one temperature", "leave `cells` out"
            )
        elif planning.sensed[name].body in {link.body for link in use.links} and (heat.cells or heat.temperature is not None):
            which = "cells" if heat.cells else "temperature"
            what = f"it is a link of the sensor, whose own {which} counts; its `material` says how stiff it is to touch"
            planning.report(("objects", name, which), what, f"leave `{which}` out")
        elif use.request.needs_stiffness and any(own.youngs_modulus is None for own in heat.materials):
            what = "neither it nor a link that feels it has a `youngs_modulus`, from which the area of a contact follows"
            planning.report(("objects", name, "material"), what, "give one, or the sensor's `contact_area`")
        elif heat.cells and len(heat.volume) > 1:
            planning.report(("objects", name, "cells"), "an object with variants has one temperature", "leave `cells` out")
        elif is_counted(planning, name, use.request.objects):
            planning.report(("objects", name), "it shares its geoms with another object that is felt", "one body has one heat")
        elif len(others) > 1:
            hint = "put their links into one sensor, with `materials` by link"
            what = f'the sensors "{others[0]}" and "{others[1]}" both hold the heat of object "{name}"'
            planning.report(("sensors", others[1], "feels"), what, hint)
        else:
            held[name] = use.sensors[0]
            continue
        is_well = False
    return is_well


def _use(planning: Planning, use: Use) -> PatchesUse[np.ndarray]:
    assert isinstance(use.request, ContactPatches)
    names = use.request.objects
    bodies = tuple(dict.fromkeys(link.body for link in use.links))
    heats = [heat for name in names if (heat := planning.sensed[name].heat) is not None]
    objects = [next((own for own in planning.objects if own.name == name), None) for name in names]
    gate = {pair: i for i, pair in enumerate(planning.contact_pairs)}
    order = {pair: i for i, pair in enumerate(planning.pairs)}
    topology = _topology(planning, bodies, names, heats)
    met = set(topology.met)

    def table(index: dict[Pair, int]) -> np.ndarray:
        rows = [
            [index.get(Pair(body, name), len(index)) if (b, o) in met else len(index) for o, name in enumerate(names)]
            for b, body in enumerate(bodies)
        ]
        return np.array(rows, dtype=np.int64).reshape(len(bodies), len(names))

    choices, variants = (max([len(own) for own in part] + [1]) for part in _parts(heats))
    return PatchesUse(
        topology=topology,
        is_star=use.request.is_star,
        bodies=np.array([planning.bodies.index(b) for b in bodies if names], dtype=np.int64),
        pairs=table(gate),
        relations=table(order),
        boxes=use.request.boxes,
        start=np.array([heat.temperature or 0.0 for heat in heats]),
        has_start=np.array([float(heat.temperature is not None) for heat in heats]),
        materials=np.array([_padded([_thermal(m) for m in heat.materials], choices) for heat in heats]).reshape(-1, choices, 4),
        shapes=np.array([_padded(_shapes(heat), variants) for heat in heats]).reshape(-1, variants, 3),
        grids=np.array([_grid(heat) for heat in heats]).reshape(-1, 2, 3),
        variants=tuple(-1 if own is None or own.num_variants == 1 else own.varied for own in objects),
        heated=tuple(_place(planning, name, heat) for name, heat in zip(names, heats, strict=True)),
        has_own_start=tuple(heat.is_per_env for heat in heats),
        num_materials=tuple(len(heat.materials) for heat in heats),
        sides=topology.tables(),
        cells=_cells(topology, heats),
    )


def _topology(planning: Planning, bodies: Sequence[str], names: Sequence[str], heats: Sequence[ObjectHeat]) -> Topology:
    links = [bodies.index(planning.sensed[name].body) if planning.sensed[name].body in bodies else -1 for name in names]
    contact = set(planning.contact_pairs)
    met: list[tuple[int, int]] = []
    for b, body in enumerate(bodies):
        for o, name in enumerate(names):
            is_seen_already = links[o] >= 0 and any(
                b == links[other] and links[o] == of for of, other in met if links[other] >= 0
            )
            if Pair(body, name) in contact and not is_seen_already:
                met.append((b, o))
    cells = tuple((1, 1, 1) if heat.cells is None else heat.cells for heat in heats)
    grids = tuple(i for i, heat in enumerate(heats) if heat.cells is not None and links[i] < 0)
    lumped = tuple(i for i in range(len(names)) if i not in grids and links[i] < 0)
    return Topology(len(bodies), cells, grids, lumped, tuple(links), tuple(met))


def _place(planning: Planning, name: str, heat: ObjectHeat) -> int:
    """Return where an object is in the state's fields of heat, if they say anything of it; else −1."""
    is_told = heat.is_per_env or len(heat.materials) > 1
    return planning.heated.index(name) if is_told and name in planning.heated else -1


def _parts(heats: Sequence[ObjectHeat]) -> tuple[list, list]:
    return [heat.materials for heat in heats], [heat.volume for heat in heats]


def _thermal(material) -> list[float]:  # type: ignore[no-untyped-def]
    modulus, ratio = material.youngs_modulus, material.poissons_ratio
    compliance = 0.0 if modulus is None else (1.0 - (ratio or 0.0) ** 2) / modulus
    return [material.conductivity, material.density * material.specific_heat, material.emissivity, compliance]


def _shapes(heat: ObjectHeat) -> list[list[float]]:
    return [[float(v) for v in row] for row in zip(heat.volume, heat.area, heat.curvature, strict=True)]


def _grid(heat: ObjectHeat) -> list[np.ndarray]:
    size = np.asarray(heat.box_size[0], dtype=np.float64)
    if not np.isfinite(size).all():
        return [np.zeros(3), np.ones(3)]
    return [np.asarray(heat.box_center[0]) - 0.5 * size, size]


def _cells(topology: Topology, heats: Sequence[ObjectHeat]) -> dict[str, np.ndarray]:
    count = np.array([topology.cells[i] for i in topology.grids], dtype=np.int64).reshape(-1, 3)
    size = np.array([heats[i].box_size[0] for i in topology.grids], dtype=np.float64).reshape(-1, 3)
    return tables(count, size) if len(count) else {}


def _padded(rows: list[list[float]], count: int) -> list[list[float]]:
    return [*rows, *[rows[0]] * (count - len(rows))]
