"""Contact patches: where and how widely links touch objects, and the heat that the objects hold.

Shapes: `env` environments, or 1 where all are alike, `body` bodies that carry the sensor, `object` objects, in the order of the
request, `choice` materials that one may have, `variant` its variants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from tgdsl.fields.materials import Material
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.contacts import SLOT_FIELDS, is_counted, reference_contacts
from tgdsl.quantities.pairs import Pair, PairedObject
from tgdsl.quantities.patch import CONTACT_PATCH, Contacts, Sides, cancelled
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.surfaces.sensed import ObjectHeat


@dataclass(frozen=True)
class Topology:
    """What is joined."""

    num_bodies: int
    cells: tuple[tuple[int, int, int], ...]  # how many cells each object has along each axis; all 1 if it has one temperature
    grids: tuple[int, ...]  # the objects that are rows themselves
    lumped: tuple[int, ...]  # the objects that are nodes
    links: tuple[int, ...]  # for each object the body that it is, if it is a link of the sensor; else −1
    met: tuple[tuple[int, int], ...]  # the (body, object) pairs that may meet

    @property
    def num_objects(self) -> int:
        return len(self.cells)

    @property
    def is_plain(self) -> bool:
        """Whether every object is a node: then a link's sides are its patches with the objects, in their order."""
        return len(self.lumped) == self.num_objects

    @property
    def num_rows(self) -> int:
        return self.num_bodies + len(self.grids)

    @property
    def interfaces(self) -> tuple[tuple[int, int], ...]:
        """The pairs whose patch is a node."""
        return tuple(pair for pair in self.met if pair[1] not in self.lumped)

    @property
    def num_nodes(self) -> int:
        return len(self.lumped) + len(self.interfaces)

    def node_of(self, body: int, target: int) -> int:
        if target in self.lumped:
            return self.lumped.index(target)
        return len(self.lumped) + self.interfaces.index((body, target))

    def sides(self) -> list[list[tuple[int, bool, int]]]:
        """Return of each row its sides: the pair, counted body by body, whether it is the object's side, and the node."""
        rows: list[list[tuple[int, bool, int]]] = [[] for _ in range(self.num_rows)]
        for body, target in self.met:
            pair, node = body * self.num_objects + target, self.node_of(body, target)
            rows[body].append((pair, False, node))
            if self.links[target] >= 0:
                rows[self.links[target]].append((pair, True, node))
            elif target in self.grids:
                rows[self.num_bodies + self.grids.index(target)].append((pair, True, node))
        return rows

    def tables(self) -> dict[str, np.ndarray]:
        """Return the sides as arrays of indices.

        pair (row, slot), with the number of pairs where there is no side; is_object (row, slot); node (row, slot), 0 where
        there is none; at_node (node, share), sides counted row by row, with their number where there is none; coupled (node,
        node, share), pairs of slots counted row by row, with their number where there is none.
        """
        rows = self.sides()
        count = max(1, *map(len, rows)) if rows else 1
        pair = np.full((self.num_rows, count), self.num_bodies * self.num_objects, dtype=np.int64)
        is_object, node = np.zeros((2, *pair.shape), dtype=np.int64)
        at: list[list[int]] = [[] for _ in range(self.num_nodes)]
        between: list[list[int]] = [[] for _ in range(self.num_nodes**2)]
        for r, row in enumerate(rows):
            for s, (entry, is_objects, n) in enumerate(row):
                pair[r, s], is_object[r, s], node[r, s] = entry, is_objects, n
                at[n].append(r * count + s)
                for t, (_, _, m) in enumerate(row):
                    if m != n:
                        between[n * self.num_nodes + m].append((r * count + s) * count + t)
        coupled = _filled(between, 0, pair.size * count)
        coupled = coupled.reshape(self.num_nodes, self.num_nodes, coupled.shape[1])
        sides = {"pair": pair, "is_object": is_object, "node": node}
        return {**sides, "at_node": _filled(at, 1, pair.size), "coupled": coupled}


def _filled(rows: Sequence[Sequence[int]], least: int, none: int) -> np.ndarray:
    """Return rows of numbers as an array, at least so wide, filled up with the number for none."""
    result = np.full((len(rows), max([least, *map(len, rows)])), none, dtype=np.int64)
    for row, numbers in zip(result, rows, strict=True):
        row[: len(numbers)] = numbers
    return result


class HeatOfObjects(NamedTuple):
    """Materials of objects, planes (env, object)."""

    start: Tensor  # temperature at which an episode begins [°C]; ignored where the object has none
    has_start: Tensor  # 1 where it has
    conductivity: Tensor  # k [W/(m·K)]
    volumetric_heat: Tensor  # ρc [J/(m³·K)]
    emissivity: Tensor  # ε [1]
    compliance: Tensor  # (1 − ν²)/E [1/Pa]
    volume: Tensor  # [m³]; infinite for what keeps its temperature, such as a plane
    area: Tensor  # outer surface [m²]
    curvature: Tensor  # 1/R of the touched surface [1/m]; 0 where it is flat
    size: Vec  # sides of the box of one that is divided into cells, planes (object,) each [m]
    corner: Vec  # lowest corner of that box in the object's frame [m]


class ContactPatch(NamedTuple):
    """Patches between each body and each object, planes (env, body, object); all zero where they do not touch.

    Contacts count where their normal force is positive. The centre is their mean position, and the normal the direction of the
    sum of their normals, both weighted by normal force. Where the normals cancel, as when a link is pinched from two sides, it
    is the first contact's normal.
    """

    force: Tensor  # sum of the contacts' normal forces [N]
    area: Tensor  # area of the contact points' convex hull in the plane across the normal [m²]; 0 for fewer than three
    pos: Vec  # centre in the link's frame [m]
    normal: Vec  # unit normal out of the object, in the link's frame
    object_pos: Vec | None  # centre in the object's frame [m]; None if no object there is divided into cells
    object_normal: Vec | None  # normal in the object's frame
    objects: HeatOfObjects  # materials of the objects
    topology: Topology  # which patch joins what
    sides: Mapping[str, Tensor]  # `topology`'s tables
    cells: Mapping[str, Tensor]  # tables of the boxes of objects with cells, see `tables`
    boxes: Float[Tensor, "body 2 3"]  # lowest and highest corner of each body's box, (body, 2, 3) in its frame [m]


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactPatches(Request[ContactPatch]):
    """Asks for the patches."""

    slots: int  # contacts per body and object that make a patch
    # lowest and highest corner of each body's box in its frame, handed on (body, 2, 3) [m]
    boxes: Float[np.ndarray, "body 2 3"]
    # whether the area is the paper's polygon, through all points in the order of their angles about the centre, instead of
    # their convex hull
    is_star: bool
    needs_stiffness: bool  # whether each object's material needs a Young's modulus

    @property
    def wants_contacts(self) -> bool:  # type: ignore[override]
        """Whether contacts are read: where there are objects."""
        return bool(self.objects)

    @property
    def num_slots(self) -> int:
        return self.slots if self.objects else 0

    def key(self) -> tuple[Any, ...]:
        return (type(self), self.objects, self.slots, self.is_star, self.boxes.tobytes())


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class PatchesUse(Generic[Array]):
    """One request."""

    topology: Topology  # which patch joins what
    is_star: bool  # see `ContactPatches`
    bodies: Array  # indices of the sensor's bodies in the state, (body,); empty without objects
    pairs: Array  # whose contacts: indices into `inputs.pairs`, or their number for none, (body, object)
    relations: Array  # the same pair by its number in the Plan, or the number of pairs, (body, object)
    boxes: Array  # lowest and highest corner of each body's box (body, 2, 3) [m]
    start: Array  # temperature at which each object begins (object,) [°C], and `has_start` 1 where it has one
    has_start: Array  # see `start`
    materials: Array  # conductivity [W/(m·K)], ρc [J/(m³·K)], emissivity [1] and compliance [1/Pa], (object, choice, 4)
    shapes: Array  # volume [m³], area [m²] and curvature [1/m], (object, variant, 3)
    grids: Array  # lowest corner of each object's box and its sides (object, 2, 3) [m]
    variants: tuple[int, ...]  # where each object's variant is in the state's field; −1: all alike
    heated: tuple[int, ...]  # where each object is in the state's fields of heat; −1: it is not there
    has_own_start: tuple[bool, ...]  # whether the state says at which temperature it begins
    num_materials: tuple[int, ...]  # how many materials it may have
    sides: Mapping[str, Array]  # the tables of `topology`
    # tables of the boxes of objects with cells, see `tables`; empty if there are none
    cells: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class PatchesPart(Generic[Array]):
    """All uses."""

    uses: tuple[PatchesUse[Array], ...]


FACES = ("-x", "+x", "-y", "+y", "-z", "+z")  # faces of a box, by the axis that they are across, and on which side


def tables(
    count: Int[np.ndarray, "row 3"],
    size: Float[np.ndarray, "row 3"],
    faces: Sequence[str] = FACES,
    loss: Float[np.ndarray, "row 3"] | None = None,
) -> dict[str, np.ndarray]:
    """Return the tables of a step for boxes, from the numbers of cells along each axis, sizes [m] and exposed faces.

    `count`, `number` and `volume` of cells; by axis `ends`, how many exposed faces across it a cell has, `mode`, the modes,
    their eigenvalues `square`, `smooth` with (kπ/n)² instead of 4 sin²(kπ/2n) in them, and the modes' sums over the cells
    `total`. `loss` is b of the exposed faces across each axis [1]; default: they are insulated.
    """
    loss = np.zeros(count.shape) if loss is None else loss
    result = {"count": count.astype(np.float64)}
    result |= {"number": result["count"].prod(axis=1), "volume": (size / count).prod(axis=1)}
    for axis, name in enumerate("xyz"):
        ends = exposed_ends(count[:, axis], [face[0] for face in faces if face[1] == name])
        vectors, values = modes(count[:, axis], ends * loss[:, axis, None])
        k = np.arange(values.shape[1])[None, :] / count[:, axis, None]
        smooth = np.where(k < 1, values + (np.pi * k) ** 2 - 4.0 * np.sin(0.5 * np.pi * k) ** 2, 0.0)
        sums = vectors.sum(axis=2)
        if not (ends * loss[:, axis, None]).any():
            sums[:, 1:] = 0.0  # exactly: what insulated cells hold stays
        result |= {f"ends_{name}": ends, f"mode_{name}": vectors}
        result |= {f"square_{name}": values, f"smooth_{name}": smooth, f"total_{name}": sums}
    return result


def is_cell(count: Int[np.ndarray, "row 3"]) -> Bool[np.ndarray, "row x y z"]:
    """Return which cells there are, where rows are padded to as many as the one with most."""
    along = [np.arange(count[:, axis].max(initial=1))[None, :] < count[:, axis, None] for axis in range(3)]
    return along[0][:, :, None, None] & along[1][:, None, :, None] & along[2][:, None, None, :]


def exposed_ends(count: Int[np.ndarray, " row"], sides: Sequence[str]) -> Float[np.ndarray, "row cell"]:
    """Return how many exposed faces cells along an axis have across it, on the sides `-` and `+`."""
    place = np.arange(count.max(initial=1))[None, :]
    first, last = np.broadcast_to(place == 0, (len(count), place.size)), place == count[:, None] - 1
    return np.sum([first if side == "-" else last for side in sides], axis=0, dtype=np.float64) + np.zeros(last.shape)


def outer_areas(
    count: Int[np.ndarray, "row 3"], size: Float[np.ndarray, "row 3"], faces: Sequence[str]
) -> Float[np.ndarray, "row x y z"]:
    """Return the area of each cell that lies on some faces of its box [m²]."""
    there, step = is_cell(count), size / count
    area = np.zeros(there.shape)
    for axis, name in enumerate("xyz"):
        ends = exposed_ends(count[:, axis], [face[0] for face in faces if face[1] == name])
        shape = [len(count), 1, 1, 1]
        shape[1 + axis] = -1
        across = step[:, [a for a in range(3) if a != axis]].prod(axis=1)
        area += ends.reshape(shape) * across[:, None, None, None] * there
    return area


def modes(
    count: Int[np.ndarray, " row"], loss: Float[np.ndarray, "row cell"]
) -> tuple[Float[np.ndarray, "row mode cell"], Float[np.ndarray, "row mode"]]:
    """Return the modes along an axis, orthonormal, the slowest first and positive, and their eigenvalues μ [1].

    Both are 0 where a row has fewer cells than another. `loss` is what each cell loses at its exposed faces, b of each [1].
    """
    most = int(count.max(initial=1))
    vectors, values = np.zeros((len(count), most, most)), np.zeros((len(count), most))
    for row, n in enumerate(count.tolist()):
        if loss[row, :n].any():
            coupled = np.diff(np.eye(n), axis=0)
            cosines = np.linalg.eigh(coupled.T @ coupled + np.diag(loss[row, :n]))[1].T
            cosines *= np.where(cosines.sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
            # By Rayleigh's quotient, a sum of positive numbers: a small loss keeps its digits.
            values[row, :n] = (np.diff(cosines, axis=1) ** 2).sum(axis=1) + (loss[row, :n] * cosines**2).sum(axis=1)
        else:
            m, i = np.arange(n)[:, None], np.arange(n)[None, :] + 0.5
            cosines = np.sqrt(np.where(m == 0, 1.0, 2.0) / n) * np.cos(np.pi * m * i / n)
            values[row, :n] = 4.0 * np.sin(0.5 * np.pi * np.arange(n) / n) ** 2
        vectors[row, :n, :n] = cosines
    return vectors, values


def _mistake(planning: Planning, use: Use, name: str, holder: str | None) -> tuple[tuple[str, ...], str, str] | None:
    """Return why the heat of an object is not this use's alone: a place, the problem and a hint; None if it is."""
    heat, place, holders = planning.sensed[name].heat, ("objects", name), [*([holder] if holder else []), *use.sensors]
    if heat is None:
        hint = "give it `material`, and `temperature` if it does not begin at the sensor's ambient"
        return place, "it has no `material`, and a sensor of temperature feels it", hint
    if heat.cells and not np.isfinite(heat.volume).all():
        return (*place, "cells"), "a plane is without bounds, and has one temperature", "leave `cells` out"
    if planning.sensed[name].body in use.bodies and (heat.cells or heat.temperature is not None):
        which = "cells" if heat.cells else "temperature"
        problem = f"it is a link of the sensor, whose own {which} counts; its `material` says how stiff it is to touch"
        return (*place, which), problem, f"leave `{which}` out"
    if use.request.needs_stiffness and any(material.youngs_modulus is None for material in heat.materials):
        problem = "neither it nor a link that feels it has a `youngs_modulus`, from which the area of a contact follows"
        return (*place, "material"), problem, "give one, or the sensor's `contact_area`"
    if heat.cells and len(heat.volume) > 1:
        return (*place, "cells"), "an object with variants has one temperature", "leave `cells` out"
    if is_counted(planning, name, use.request.objects):
        return place, "it shares its geoms with another object of the sensor", "one body has one heat"
    if len(holders) > 1:
        problem = f'the sensors "{holders[0]}" and "{holders[1]}" both hold the heat of object "{name}"'
        return ("sensors", holders[1], "feels"), problem, "put their links into one sensor, with `materials` by link"
    return None


def _use(planning: Planning, use: Use) -> PatchesUse[np.ndarray]:
    names, bodies = use.request.objects, use.bodies
    heats = [heat for name in names if (heat := planning.sensed[name].heat) is not None]
    objects = [next((target for target in planning.objects if target.name == name), None) for name in names]
    topology = _topology(planning, bodies, names, heats)

    def table(pairs: Sequence[Pair]) -> np.ndarray:
        result = np.full((len(bodies), len(names)), len(pairs), dtype=np.int64)
        for b, o in topology.met:
            if (pair := Pair(bodies[b], names[o])) in pairs:
                result[b, o] = pairs.index(pair)
        return result

    materials = [[_thermal(m) for m in heat.materials] for heat in heats]
    shapes = [np.stack([heat.volume, heat.area, heat.curvature], axis=1).tolist() for heat in heats]
    count = np.array([topology.cells[i] for i in topology.grids], dtype=np.int64).reshape(-1, 3)
    size = np.array([heats[i].box_size[0] for i in topology.grids], dtype=np.float64).reshape(-1, 3)
    varied = [name in planning.heated and (h.is_per_env or len(h.materials) > 1) for name, h in zip(names, heats, strict=True)]
    return PatchesUse(
        topology=topology,
        is_star=use.request.is_star,
        bodies=np.array([planning.bodies.index(b) for b in bodies if names], dtype=np.int64),
        pairs=table(planning.contact_pairs),
        relations=table(planning.pairs),
        boxes=use.request.boxes,
        start=np.array([heat.temperature or 0.0 for heat in heats]),
        has_start=np.array([float(heat.temperature is not None) for heat in heats]),
        materials=_padded(materials, 4),
        shapes=_padded(shapes, 3),
        grids=np.array([_grid(heat) for heat in heats]).reshape(-1, 2, 3),
        variants=tuple(-1 if target is None or target.num_variants == 1 else target.varied for target in objects),
        heated=tuple(planning.heated.index(name) if varies else -1 for name, varies in zip(names, varied, strict=True)),
        has_own_start=tuple(heat.is_per_env for heat in heats),
        num_materials=tuple(len(heat.materials) for heat in heats),
        sides=topology.tables(),
        cells=tables(count, size) if len(count) else {},
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


def _thermal(material: Material) -> list[float]:
    modulus, ratio = material.youngs_modulus, material.poissons_ratio
    compliance = 0.0 if modulus is None else (1.0 - (ratio or 0.0) ** 2) / modulus
    return [material.conductivity, material.density * material.specific_heat, material.emissivity, compliance]


def _grid(heat: ObjectHeat) -> list[np.ndarray]:
    size = np.asarray(heat.box_size[0], dtype=np.float64)
    if not np.isfinite(size).all():
        return [np.zeros(3), np.ones(3)]
    return [np.asarray(heat.box_center[0]) - 0.5 * size, size]


def _padded(rows: list[list[list[float]]], num: int) -> np.ndarray:
    """Return rows of choices of `num` numbers, as many of each row: the first again where there are fewer."""
    most = max([1, *map(len, rows)])
    return np.array([[*row, *[row[0]] * (most - len(row))] for row in rows]).reshape(-1, most, num)


FIELDS = (*(f"contact_{name}" for name in ("force", "torque", "normal", "pos", "netforce")), "body_pos", "body_quat")
"""Fields of the state that patches follow from."""


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
        assert scene.pairs is not None
        rotation = planes.rot(pad(part, (0, 1))[:, use.relations] for part in scene.pairs.rotation)
        offset = planes.vec(pad(part, (0, 1))[:, use.relations] for part in scene.pairs.offset)
        seen = planes.add(planes.rotate(rotation, centre), offset), planes.rotate(rotation, normal)
    return ContactPatch(force, area, centre, normal, *seen, objects, use.topology, use.sides, cells, boxes)


def _objects(use: PatchesUse[Tensor], scene: Scene) -> HeatOfObjects:
    """Return the objects' materials where they differ between environments."""
    materials, shapes = use.materials.to(scene.dtype)[None], use.shapes.to(scene.dtype)[None]
    start = use.start.to(scene.dtype)[None]
    if any(use.has_own_start):
        temperatures = scene.tensors["object_temperature"].to(scene.dtype)
        columns = [
            temperatures[:, place] if is_own else None for place, is_own in zip(use.heated, use.has_own_start, strict=True)
        ]
        start = torch.stack([start[:, i].expand(len(temperatures)) if c is None else c for i, c in enumerate(columns)], dim=1)
    material_id = _select(materials, scene.tensors.get("object_material"), use.heated, use.num_materials)
    counts = tuple(2 if place >= 0 else 1 for place in use.variants)
    shaped = _select(shapes, scene.tensors.get("variant"), use.variants, counts)
    grids = use.grids.to(scene.dtype)
    corner, size = (planes.vec(grids[:, i, axis] for axis in range(3)) for i in range(2))
    made_of: Any = (*material_id.unbind(-1), *shaped.unbind(-1))
    return HeatOfObjects(start, use.has_start.to(scene.dtype)[None], *made_of, size=size, corner=corner)


def _select(values: Tensor, which: Tensor | None, places: tuple[int, ...], counts: tuple[int, ...]) -> Tensor:
    """Return values (1, object, choice, n) as (env, object, n): each environment's choice."""
    if which is None or not any(count > 1 and place >= 0 for place, count in zip(places, counts, strict=True)):
        return values[:, :, 0]
    columns = []
    for i, (place, count) in enumerate(zip(places, counts, strict=True)):
        is_chosen = count > 1 and place >= 0
        columns.append(values[0, i][which[:, place].long()] if is_chosen else values[:, i, 0].expand(len(which), -1))
    return torch.stack(columns, dim=1)


@dataclass(frozen=True)
class ReferencePatch:
    """One patch: normal force [N], area [m²], centre [m] and normal, in the link's frame and in the object's."""

    force: float
    area: float
    pos: Float[np.ndarray, " 3"]
    normal: Float[np.ndarray, " 3"]
    object_pos: Float[np.ndarray, " 3"]
    object_normal: Float[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class ReferenceObject:
    """An object's material, see `HeatOfObjects`; `start` is None where the object has no temperature."""

    start: float | None
    conductivity: float
    volumetric_heat: float
    emissivity: float
    compliance: float
    volume: float
    area: float
    curvature: float
    corner: Float[np.ndarray, " 3"]
    size: Float[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class ReferencePatches:
    """All patches by (body, object), with the objects and the links' boxes."""

    patches: dict[tuple[int, int], ReferencePatch]
    objects: tuple[ReferenceObject, ...]
    topology: Topology
    boxes: Float[np.ndarray, "body 2 3"]


def _reference_patch(scene: ReferenceScene, b: int, pair: int, is_star: bool) -> ReferencePatch | None:
    link, name = scene.body(scene.layout.bodies[b]), scene.contact_pairs[pair].object
    target = scene.object_body(next(each for each in scene.objects if each.name == name))
    contacts = reference_contacts(scene, pair)
    pressing = [(pos, float(force @ normal), normal) for pos, force, _, normal in contacts if not force @ normal <= 0]
    if not pressing:
        return None
    weights = np.array([force for _, force, _ in pressing])
    pos = np.average([pos for pos, _, _ in pressing], axis=0, weights=weights)
    normal = np.average([normal for _, _, normal in pressing], axis=0, weights=weights)
    if np.linalg.norm(normal) < cancelled():
        normal = pressing[0][2]
    normal = normal / np.linalg.norm(normal)
    area = _area([point - pos for point, _, _ in pressing], normal, is_star)
    frames = [(body.rotation.T @ (pos - body.pos), body.rotation.T @ normal) for body in (link, target)]
    return ReferencePatch(float(weights.sum()), area, *frames[0], *frames[1])


def _area(points: list[np.ndarray], normal: np.ndarray, is_star: bool) -> float:
    """Return the area of points about the origin across the normal [m²]: of their hull, or in the order of their angles."""
    one = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    one /= np.linalg.norm(one)
    flat = np.array([[point @ one, point @ np.cross(normal, one)] for point in points])
    if not is_star:
        from scipy.spatial import ConvexHull, QhullError

        try:
            return ConvexHull(flat).volume
        except QhullError:  # fewer than three points, or all on a line
            return 0.0
    flat = flat[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]), kind="stable")]
    after = np.roll(flat, -1, axis=0)
    return max(0.0, 0.5 * float(np.sum(flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0])))


def _reference_object(use: PatchesUse[np.ndarray], i: int, scene: ReferenceScene) -> ReferenceObject:
    start = float(use.start[i]) if use.has_start[i] else None
    if use.has_own_start[i]:
        start = float(scene.fields["object_temperature"][use.heated[i]])
    material = int(scene.fields["object_material"][use.heated[i]]) if use.num_materials[i] > 1 else 0
    variant = int(scene.fields["variant"][use.variants[i]]) if use.variants[i] >= 0 else 0
    corner, size = use.grids[i]
    made_of: Any = (*use.materials[i, material].tolist(), *use.shapes[i, variant].tolist())
    return ReferenceObject(start, *made_of, corner=corner, size=size)


class _Patches(Quantity):
    name, request, part = "patches", ContactPatches, PatchesPart
    has_rows = True
    is_fused = True

    def plan(self, planning: Planning, uses: Sequence[Use]) -> PatchesPart[np.ndarray]:
        """Return the part of the Plan; an object that has no heat, or whose heat another sensor has, is a mistake."""
        held: dict[str, str] = {}
        results = []
        for use in uses:
            mistakes = []
            for name in use.request.objects:
                mistake = _mistake(planning, use, name, held.get(name))
                if mistake is None:
                    held[name] = use.sensors[0]
                else:
                    mistakes.append(mistake)
                    planning.report(*mistake)
            if not mistakes:
                results.append(_use(planning, use))
        return PatchesPart(tuple(results))

    def gather_use(self, part: PatchesUse[Tensor], scene: Scene) -> ContactPatch:
        return _patches(part, scene)

    def reference(self, part: PatchesPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferencePatches:
        use_part = part.uses[use]
        pairs, is_star = use_part.pairs, use_part.is_star
        patches = {(b, o): _reference_patch(scene, b, int(pairs[b, o]), is_star) for b, o in use_part.topology.met}
        objects = tuple(_reference_object(use_part, i, scene) for i in range(use_part.topology.num_objects))
        touching = {pair: patch for pair, patch in patches.items() if patch is not None}
        return ReferencePatches(touching, objects, use_part.topology, use_part.boxes)

    def fields(self, part: PatchesPart) -> set[str]:
        names = {"object_temperature"} if any(any(use.has_own_start) for use in part.uses) else set()
        if any(use.topology.num_objects for use in part.uses):
            names |= {"contact_found", "contact_netforce", *SLOT_FIELDS}
        if any(count > 1 for use in part.uses for count in use.num_materials):
            names.add("object_material")
        return names

    def bodies(self, use: Use) -> tuple[str, ...]:
        return use.bodies if use.request.objects else ()

    def num_rows(self, part: PatchesPart, use: int) -> int:
        cells = part.uses[use].topology.cells
        most = [max(shape[axis] for shape in cells) if cells else 1 for axis in range(3)]
        return len(cells) * most[0] * most[1] * most[2]

    def explain(self, part: PatchesPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
        topology = part.uses[use].topology
        return [f"contact patches with {topology.num_objects} objects"] if topology.num_objects else []


PATCHES = _Patches()
