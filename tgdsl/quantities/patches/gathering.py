"""From the solver's contacts to patches.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` objects, `slot` contacts of a body and an object.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Scene
from tgdsl.quantities.patches.part import PatchesPart, PatchesUse
from tgdsl.quantities.patches.patch import CONTACT_PATCH
from tgdsl.quantities.patches.request import ContactPatch, HeatOfObjects
from tgdsl.quantities.patches.slots import Contacts, Sides

FIELDS = (*(f"contact_{name}" for name in ("force", "torque", "normal", "pos", "netforce")), "body_pos", "body_quat")
"""Fields of the state that patches follow from."""


def gather(part: PatchesPart[Tensor], scene: Scene) -> tuple[ContactPatch, ...]:
    """Return what each use asks for."""
    return tuple(_patches(use, scene) for use in part.uses)


def _patches(use: PatchesUse[Tensor], scene: Scene) -> ContactPatch:
    objects, boxes = _objects(use, scene), use.boxes.to(scene.dtype)
    cells = {name: table.to(scene.dtype) for name, table in use.cells.items()}
    if not use.topology.met:
        none = use.start.new_zeros((1, use.topology.num_bodies, use.topology.num_objects)).to(scene.dtype)
        nowhere = (none, none, none)
        return ContactPatch(none, none, nowhere, nowhere, None, None, objects, use.topology, use.sides, cells, boxes)
    tensors, sides = scene.tensors, Sides(use.bodies, use.pairs, len(use.topology.met) == use.pairs.numel(), use.is_star)
    force, area, centre, normal = CONTACT_PATCH(Contacts(*(tensors[name] for name in FIELDS)), sides, scene.dtype)
    seen: tuple[Vec | None, Vec | None] = None, None
    if use.topology.interfaces:
        seen = _as_objects_see(use, scene, centre, normal)
    return ContactPatch(force, area, centre, normal, *seen, objects, use.topology, use.sides, cells, boxes)


def _as_objects_see(use: PatchesUse[Tensor], scene: Scene, centre: Vec, normal: Vec) -> tuple[Vec, Vec]:
    """Return centres and normals in the frames of the objects."""
    assert scene.pairs is not None

    rotation = planes.rot(_of_pairs(use.relations, part) for part in scene.pairs.rotation)
    offset = planes.vec(_of_pairs(use.relations, part) for part in scene.pairs.offset)
    return planes.add(planes.rotate(rotation, centre), offset), planes.rotate(rotation, normal)


def _of_pairs(relations: Tensor, plane: Tensor) -> Tensor:
    """Return a plane (env, pair) as (env, body, object); 0 where they never meet."""
    return pad(plane, (0, 1))[:, relations]


def _objects(use: PatchesUse[Tensor], scene: Scene) -> HeatOfObjects:
    """Return what the objects are made of, where they differ between environments."""
    materials, shapes = use.materials.to(scene.dtype)[None], use.shapes.to(scene.dtype)[None]
    start = use.start.to(scene.dtype)[None]
    if any(use.has_own_start):
        given = scene.tensors["object_temperature"].to(scene.dtype)
        columns = [given[:, place] if own else None for place, own in zip(use.heated, use.has_own_start, strict=True)]
        start = torch.stack([start[:, i].expand(len(given)) if c is None else c for i, c in enumerate(columns)], dim=1)
    chosen = _chosen(materials, scene.tensors.get("object_material"), use.heated, use.num_materials)
    counts = tuple(2 if place >= 0 else 1 for place in use.variants)
    shaped = _chosen(shapes, scene.tensors.get("variant"), use.variants, counts)
    grids = use.grids.to(scene.dtype)
    corner, size = (planes.vec(grids[:, i, axis] for axis in range(3)) for i in range(2))
    conductivity, volumetric_heat, emissivity, compliance = chosen.unbind(-1)
    volume, area, curvature = shaped.unbind(-1)
    made_of = (conductivity, volumetric_heat, emissivity, compliance, volume, area, curvature)
    return HeatOfObjects(start, use.has_start.to(scene.dtype)[None], *made_of, size, corner)


def _chosen(values: Tensor, which: Tensor | None, places: tuple[int, ...], counts: tuple[int, ...]) -> Tensor:
    """Return values (1, object, choice, n) as (env, object, n), of the choice that each environment has."""
    if which is None or not any(count > 1 and place >= 0 for place, count in zip(places, counts, strict=True)):
        return values[:, :, 0]
    columns = []
    for i, (place, count) in enumerate(zip(places, counts, strict=True)):
        is_chosen = count > 1 and place >= 0
        columns.append(values[0, i][which[:, place].long()] if is_chosen else values[:, i, 0].expand(len(which), -1))
    return torch.stack(columns, dim=1)
