"""How deep each probe is in which object, which way is out, how that moves; and how far each surface is.

`measure` computes the distance of every probe to every object, once; `penetration` makes of it what one sensor feels, with its
own gates and objects. `search` does both where a GPU's kernel can: it looks for the geom that each probe is deepest in.

Shapes: `env` environments, `pair` (link, object) pairs, `taxel` probes, `object` felt objects, `geom` geoms of an object, or of
all of these, `case` 1, or `env` if an object differs between environments, `row` columns of a geom.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import BakeError
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Rot, Vec, vec
from tgdsl.geometry.reference import TIE
from tgdsl.geometry.shapes import KINDS, SHAPES
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use, pairs_for
from tgdsl.quantities.geoms import (
    Frame,
    Geoms,
    GeomTable,
    account_of_geoms,
    distance_to,
    geoms_of,
    object_geoms,
    union_distance,
)
from tgdsl.quantities.pairs import Motion, PairedObject, Pairs, at_probes, gathered
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.tensors.env_ids import is_cheap_to_read
from tgdsl.tensors.operations import Operation

# The shapes that the search knows; to it a sphere is a capsule without a length.
SEARCHED = ("", "plane", "sphere", "capsule", "cylinder", "box")
EVERYWHERE = 3e38  # bound of a plane [m]: its square is infinite, so no point is beyond it; −∞ added to it is −∞
MARGIN = 10 * planes.tie()  # a geom is passed over farther than its reach and this [m]: beyond what counts as equal in float32


class Deepest(NamedTuple):
    """What each probe is deepest in, the first among equals."""

    depth: Float[Tensor, "env taxel"]  # penetration depth max(0, radius − distance) [m]; not-a-number where a pose is
    normal: Vec  # unit normal out of the object, in the link's frame, planes (env, taxel); zero where nothing is reached
    pair: Int[Tensor, "env taxel"]  # index of the winner's pair among all pairs; −1 where nothing is reached


def geom_tables(objects: Sequence[Geoms]) -> tuple[Tensor, Tensor]:
    """Return the tables of objects (case, object, 2) and of their geoms (case, geom, row) that the kernel reads.

    Of an object: radius of a sphere about its origin that holds it [m], −∞ if it is absent, and how many geoms it has. Of a
    geom: size, place and rotation in its body's frame, radius of a sphere about its own origin that holds it [m], and its kind,
    negative if it has a frame. Few operations: each is a kernel of a microsecond where objects differ between environments.
    """
    parts = [part for target in objects for part in (target.size, target.pos, target.rotation, target.is_absent)]
    num_cases = next((part.shape[0] for part in parts if part is not None and part.shape[0] != 1), 1)
    counts = [len(target.shapes) for target in objects]
    each = [geom for target in objects for geom in zip(target.shapes, target.is_centred, strict=True)]
    shape = _filled(objects[0].size, [SEARCHED.index(shape) for shape, _ in each])
    is_centred = _filled(objects[0].size, [is_centred for _, is_centred in each]) > 0
    kind = _filled(objects[0].size, [KINDS.index("capsule" if shape == "sphere" else shape) for shape, _ in each])
    size, pos, rotation = (
        _side_by_side([getattr(target, name).expand(num_cases, -1, -1) for target in objects])
        for name in ("size", "pos", "rotation")
    )
    x, y, z = planes.split(size)
    y = torch.where(shape == SEARCHED.index("sphere"), 0.0, y)
    squared = x * x + y * y + torch.where(shape == SEARCHED.index("box"), z * z, 0.0)
    bound = torch.where(shape <= SEARCHED.index("capsule"), x + y, planes.safe_sqrt(squared))
    bound = torch.where(shape == SEARCHED.index("plane"), EVERYWHERE, bound + MARGIN)
    if any(target.is_absent is not None for target in objects):
        masks = [target.size[..., 0] < -1 if target.is_absent is None else target.is_absent for target in objects]
        bound = torch.where(_side_by_side([mask.expand(num_cases, -1) for mask in masks]), -torch.inf, bound)
    kind = torch.where(is_centred, kind, -kind).expand(num_cases, -1)
    geoms = torch.cat([torch.stack([x, y, z], dim=-1), pos, rotation, bound[..., None], kind[..., None]], dim=-1)
    held = torch.where(is_centred, bound, bound + planes.safe_sqrt(planes.dot(planes.split(pos), planes.split(pos))))
    if len(set(counts)) == 1:
        held = held.unflatten(1, (len(objects), counts[0])).amax(dim=2)
    else:
        held = torch.stack([part.amax(dim=1) for part in held.split(counts, dim=1)], dim=1)
    return torch.stack([held, _filled(held, counts).expand(num_cases, -1)], dim=-1), geoms


def _filled(like: Tensor, values: Sequence[float]) -> Float[Tensor, "1 value"]:
    runs = [(float(value), len(list(run))) for value, run in groupby(values)]
    return torch.cat([like.new_full((1, count), value) for value, count in runs], dim=1)


@torch.library.custom_op("tgdsl::side_by_side", mutates_args=(), schema="(Tensor[] parts) -> Tensor")
def _side_by_side(parts: list[Tensor]) -> Tensor:
    return torch.cat(parts, dim=1)


_side_by_side.register_fake(lambda parts: torch.cat(parts, dim=1))


class Distance(NamedTuple):
    """Signed distance of each probe to one object's surface [m], and its gradient in the link's frame: planes (env, taxel).

    The distance is infinite where the pair is out of question: an inactive probe, or a link and itself.
    """

    value: Tensor
    gradient: Vec


class Penetration(NamedTuple):
    """What probes meet, at the geom that each is deepest in; planes of shape (env, taxel), in the link's frame."""

    pos: Vec  # where the probes are [m], planes (taxel,)
    depth: Tensor  # penetration depth max(0, radius − distance) [m]
    normal: Vec | None  # unit normal out of the object; zero where the depth is zero. None if not asked for.
    velocity: Vec | None  # velocity of the object's material at the probe relative to the probe [m/s]; None if not asked for
    angular: Vec | None  # angular velocity of the object relative to the link [rad/s]; None if not asked for
    distances: dict[str, Distance]  # distance to each object, by its name; empty if not asked for
    frames: dict[str, Frame]  # how each object sees the link, by its name; empty if not asked for


@dataclass(frozen=True, eq=False)
class ContactDepth(Request[Penetration]):
    """Asks how deep probes are in objects: the deepest object wins, the first among equals."""

    # radius of each probe [m], (taxel,); None: the taxels'. Inactive probes have depth 0.
    radius: Float[np.ndarray, " taxel"] | None = None
    range: float = 0.0  # distance from an object's surface up to which it is needed [m], if more than the radius
    normal: bool = False  # whether the normal is asked for
    motion: bool = False  # whether the velocities are
    distance: bool = False  # whether the distances to all objects are
    frame: bool = False  # whether the frames are
    is_within_radii: ClassVar[bool] = True

    @property
    def wants(self) -> tuple[str, ...]:
        """Results that are requested in addition to the depth."""
        return tuple(name for name in ("distance", "frame", "motion", "normal") if getattr(self, name))

    def key(self) -> tuple[Any, ...]:
        return type(self), self.objects, self.is_gated, None if self.radius is None else self.radius.tobytes()

    def merged(self, other: ContactDepth) -> ContactDepth:
        wants = dict.fromkeys((*self.wants, *other.wants), True)
        return dataclasses.replace(self, range=max(self.range, other.range), **wants)

    def join_key(self) -> tuple[Any, ...]:
        return type(self), self.objects, self.is_gated, self.wants, self.radius is None

    def joined(self, others: Sequence[ContactDepth]) -> ContactDepth:
        radii = [request.radius for request in (self, *others) if request.radius is not None]
        radius = np.concatenate(radii) if radii else None
        return dataclasses.replace(self, radius=radius, range=max(request.range for request in (self, *others)))

    def wants_distance(self, radius: Float[np.ndarray, " taxel"]) -> bool:
        return self.distance or bool((self.reach(radius) > -np.inf).any())

    def reach(self, radius: Float[np.ndarray, " taxel"]) -> Float[np.ndarray, " taxel"]:
        """Return the reach of each probe [m] for these radii; −∞ for inactive ones."""
        return np.where(radius > 0, radius if self.radius is None else self.radius, -np.inf)


class Probes(NamedTuple):
    """Probes of one query; the positions are in the frame of each probe's link."""

    pos: Vec  # positions [m], planes of shape (taxel,)
    pair: Int[Tensor, "object taxel"]  # for each object, index of each probe's pair among the pairs of that object


class Target(NamedTuple):
    """An object that probes are measured against: where its pairs are, and its geoms."""

    object: PairedObject
    geoms: Geoms


class ObjectDistance(NamedTuple):
    """How far each probe is from one object's surface."""

    name: str  # the object's name
    pairs: slice  # its pairs among all of the plan
    pair: Int[Tensor, " taxel"]  # index of each probe's pair among them
    distance: Tensor  # signed distance [m], a plane (env, taxel)
    gradient: Vec  # its unit gradient in the link's frame


def measure(pairs: Pairs, probes: Probes, targets: Sequence[Target]) -> tuple[ObjectDistance, ...]:
    """Return how far all probes are from each object, in the order of `probes.pair`; not-a-number where a pose is."""
    return tuple(
        ObjectDistance(target.name, target.pairs, pair, *_distance(pairs, probes, geoms, target.pairs, pair))
        for (target, geoms), pair in zip(targets, probes.pair, strict=True)
    )


def penetration(
    pairs: Pairs,
    probes: Probes,
    near: Sequence[ObjectDistance],
    reach: Float[Tensor, "object *env taxel"],
    wants: Collection[str],
) -> Penetration:
    """Return the probes' penetration; the deepest object wins, the first among equals.

    `reach` is the radius of each probe towards each object [m], −∞ where the probe is inactive or the pair cannot meet; `wants`
    names the optional parts of the answer: "normal", "motion", "distance", "frame".
    """
    num_envs = pairs.offset[0].shape[0]
    zero = pairs.offset[0].new_zeros((num_envs, probes.pos[0].shape[0]))
    depth, normal, linear, angular = zero, (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
    with_normal, with_motion = "normal" in wants, "motion" in wants and pairs.motion is not None
    distances: dict[str, Distance] = {}
    frames: dict[str, Frame] = {}
    for target, radius in zip(near, reach, strict=True):
        if pairs.gate is not None:
            radius = radius + at_probes(pairs.gate, target.pairs, target.pair)
        reached = radius - target.distance
        is_deeper = reached > torch.where(depth > 0, depth + planes.tie(), 0.0)
        if with_normal:
            normal = planes.where(is_deeper, target.gradient, normal)
        if with_motion and pairs.motion is not None:
            linear = planes.where(is_deeper, gathered(pairs.motion.linear, target.pairs, target.pair), linear)
            angular = planes.where(is_deeper, gathered(pairs.motion.angular, target.pairs, target.pair), angular)
        if "distance" in wants:
            value = torch.where(radius.isnan(), radius, target.distance)
            value = torch.where(radius == -torch.inf, torch.inf, value)
            distances[target.name] = Distance(value, target.gradient)
        if "frame" in wants:
            rotation = planes.rot(at_probes(part, target.pairs, target.pair) for part in pairs.rotation)
            frames[target.name] = Frame(rotation, gathered(pairs.offset, target.pairs, target.pair))
        depth = torch.maximum(depth, reached)
    velocity = planes.add(linear, planes.cross(angular, probes.pos)) if with_motion else None
    turning = angular if with_motion else None
    return Penetration(probes.pos, depth, normal if with_normal else None, velocity, turning, distances, frames)


def _distance(pairs: Pairs, probes: Probes, geoms: Geoms, own: slice, pair: Tensor) -> tuple[Tensor, Vec]:
    """Return signed distance [m] to the union of an object's geoms, and its gradient in the link's frame."""
    parts = [*pairs.rotation, *pairs.offset]
    if own != slice(0, parts[0].shape[1]):
        parts = [part[:, own] for part in parts]
    rotation, offset = planes.rot(parts[:9]), planes.vec(parts[9:])
    centred = _at_probes(rotation, offset, pair) if any(geoms.is_centred) else None
    frames = []
    for g, is_centred in enumerate(geoms.is_centred):
        frames.append(centred)
        if not is_centred:
            turn = planes.rot(geoms.rotation[:, g, None].unbind(-1))
            moved = planes.sub(offset, planes.split(geoms.pos[:, g, None]))
            frames[-1] = _at_probes(planes.transpose_times(turn, rotation), planes.rotate_back(turn, moved), pair)
    return union_distance(probes.pos, frames, geoms)


def _at_probes(rotation: Rot, offset: Vec, pair: Tensor) -> Frame:
    turn, shift = ([at_probes(part, slice(None), pair) for part in parts] for parts in (rotation, offset))
    return Frame(planes.rot(turn), planes.vec(shift))


THRESHOLD = 5
"""Geoms from which on the kernel is used: with four boxes Inductor's code is as fast, 1.6 million probes in 0.08 ms."""
Reach = Float[Tensor, "object *env taxel"]


def is_searchable(shapes: Collection[str], wants: Collection[str]) -> bool:
    """Return whether the kernel can answer: enough geoms, all of shapes that it knows, and nothing but normal and motion."""
    is_known = all(shape in SEARCHED for shape in shapes) and all(want in ("normal", "motion") for want in wants)
    return is_known and len(shapes) >= THRESHOLD


def search(
    pairs: Pairs,
    probes: Probes,
    targets: Sequence[Target],
    known: Mapping[str, Tensor],
    reach: Reach,
    wants: Collection[str],
) -> Penetration | None:
    """Return what `penetration` would of searchable targets, by one kernel; None where that cannot run.

    `known` has their tables by name: `pair`, and `spheres` and `geoms` where they are the same at all calls.
    """
    if not DEEPEST.takes_kernel(pairs, probes, targets, known, reach):
        return None
    result = DEEPEST.kernel(pairs, probes, targets, known, reach)
    velocity = angular = None
    if "motion" in wants and pairs.motion is not None:
        pair, is_met = result.pair.clamp(min=0).long(), result.pair >= 0
        motion = (*pairs.motion.linear, *pairs.motion.angular)
        x, y, z, u, v, w = (torch.where(is_met, part.gather(1, pair), 0.0) for part in motion)
        velocity, angular = planes.add((x, y, z), planes.cross((u, v, w), probes.pos)), (u, v, w)
    normal = result.normal if "normal" in wants else None
    return Penetration(probes.pos, result.depth, normal, velocity, angular, {}, {})


def deepest(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> Deepest:
    """Return each probe's deepest penetration, the first of equals; `known` as in `search`, the pairs' gate holds."""
    pairs_of = torch.stack([pair - target.object.first_pair for pair, target in zip(known["pair"], targets, strict=True)])
    near = measure(pairs, Probes(probes.pos, pairs_of), targets)
    # Each pair moves along x by its number, so the velocity found identifies the deepest pair.
    number = torch.arange(1, pairs.offset[0].shape[1] + 1, dtype=reach.dtype, device=reach.device).expand_as(pairs.offset[0])
    still = torch.zeros_like(number)
    motion = Motion((number, still, still), (still, still, still), (still, still, still))
    felt = penetration(pairs._replace(motion=motion), probes, near, reach, ("normal", "motion"))
    assert felt.normal is not None and felt.velocity is not None
    return Deepest(felt.depth, felt.normal, felt.velocity[0].int() - 1)


def _by_kernel(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> Deepest:
    from tgdsl.quantities.deepest_kernel import find

    built = () if "geoms" in known else geom_tables([target.geoms for target in targets])
    spheres, geoms = built or (known["spheres"], known["geoms"])
    return Deepest(*find(pairs, probes.pos, known["pair"], spheres, geoms, reach))


def _inputs(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> list[Tensor]:
    motion = () if pairs.motion is None else (*pairs.motion.linear, *pairs.motion.angular)
    geoms = [part for _, geom in targets for part in (geom.size, geom.pos, geom.rotation)]
    return [*pairs.offset, *pairs.rotation, *motion, *probes.pos, reach, *geoms]


DEEPEST = Operation("deepest", deepest, _by_kernel, _inputs)


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class SearchPart(Generic[Array]):
    """What a GPU's search for the deepest geom is given that is the same at all calls: see `geom_tables`."""

    pair: Array  # index of each probe's pair with each object among all pairs, (object, taxel)
    spheres: Array | None  # bounds of the objects, (1, object, 2); None where they differ between environments
    geoms: Array | None  # their geoms, (1, geom, row); None in the same case


@dataclass(frozen=True, eq=False)
class ProbeQuery(Generic[Array]):
    """Probes whose distances are computed once, however many uses share them."""

    objects: tuple[int, ...]  # the objects that they are measured against: indices into the Plan's
    pos: Array  # where the probes are in their links' bodies' frames [m], (3, taxel)
    pair: Array  # index of each probe's pair with each object among that object's pairs, (object, taxel)


@dataclass(frozen=True, eq=False)
class DepthUse(Generic[Array]):
    """One request: the objects of a query that count, and how."""

    query: int  # number of its query
    objects: tuple[int, ...]  # which of that one's objects
    is_gated: bool  # whether they count only in contact
    wants: tuple[str, ...]  # further results: "distance", "frame", "motion", "normal"
    radius_noise: str  # the sensor whose noise disturbs the radii, if any
    reach: Array  # how far each probe feels each object [m], (object, taxel); −∞ where it does not
    search: SearchPart[Array] | None  # inputs of the kernel's search; None where it has no use


@dataclass(frozen=True, eq=False)
class ContactDepthPart(Generic[Array]):
    """All of it."""

    geoms: tuple[GeomTable[Array] | None, ...]  # geoms of the Plan's objects; None of one that nothing is measured against
    queries: tuple[ProbeQuery[Array], ...]
    uses: tuple[DepthUse[Array], ...]


FAR = 1e6  # numbers of poses up to this [m] have distances that are numbers, in float32 too


def _are_closed(scene: Scene) -> bool:
    """Return whether no pair is in contact, and nothing is so far away or no number that a closed gate would not hide it."""
    pairs = scene.pairs
    if pairs is None or pairs.gate is None or not is_cheap_to_read(pairs.gate) or not bool((pairs.gate == -torch.inf).all()):
        return False
    sizes = scene.tensors.get("object_size", pairs.gate[:, :0])
    return bool((torch.stack([*pairs.rotation, *pairs.offset]).abs() < FAR).all() and sizes.isfinite().all())


def _reach(use: DepthUse[Tensor], scene: Scene) -> Tensor:
    """Return how far each probe feels each object [m]: (object, taxel), or (object, env, taxel) with noise."""
    if not use.radius_noise:
        return use.reach
    radius, shift = use.reach[:, None], scene.radius_shifts[use.radius_noise]
    return torch.where(radius > -torch.inf, torch.clamp(radius + shift, min=0), -torch.inf)


@dataclass(frozen=True, eq=False)
class ReferencePenetration:
    """What a sensor's probes feel, in their links' frames: the fields of `Penetration`, one row per taxel.

    `distance` [m] and its gradient `outward` have one column per object, as in `distances`; so have `rotation` and `offset`,
    as in `frames`.
    """

    depth: Float[np.ndarray, " taxel"]
    normal: Float[np.ndarray, "taxel 3"]
    velocity: Float[np.ndarray, "taxel 3"]
    angular: Float[np.ndarray, "taxel 3"]
    distance: Float[np.ndarray, "taxel object"]
    outward: Float[np.ndarray, "taxel object 3"]
    rotation: Float[np.ndarray, "taxel object 3 3"]
    offset: Float[np.ndarray, "taxel object 3"]


class _ContactDepth(Quantity):
    name, request, part = "contact_depth", ContactDepth, ContactDepthPart

    def plan(self, planning: Planning, uses: Sequence[Use]) -> ContactDepthPart[np.ndarray]:
        """Return the part of the Plan; report each object whose mesh no grid within its budget fits."""
        all_tables = {name: _table(planning, name, uses) for name in planning.sensed}
        tables = {name: table for name, table in all_tables.items() if table is not None}
        groups: dict[int, list[Use]] = {}
        for use in uses:
            groups.setdefault(id(use.pos), []).append(use)
        queries, parts = [], {}
        for number, group in enumerate(groups.values()):
            query, use_parts = _query(planning, number, group, tables)
            queries.append(query)
            parts |= {id(use): part for use, part in zip(group, use_parts, strict=True)}
        geoms = tuple(tables.get(target.name) for target in planning.objects)
        return ContactDepthPart(geoms, tuple(queries), tuple(parts[id(use)] for use in uses))

    def gather(self, part: ContactDepthPart[Tensor], scene: Scene) -> tuple[Penetration, ...]:
        targets = {
            i: Target(target, object_geoms(geoms, target, scene))
            for i, (target, geoms) in enumerate(zip(scene.objects, part.geoms, strict=True))
            if geoms is not None
        }
        measured: dict[int, tuple[ObjectDistance, ...]] = {}
        result, are_closed = [], _are_closed(scene)
        for use in part.uses:
            query = part.queries[use.query]
            probes, felt = Probes(vec(query.pos.unbind()), query.pair), [targets[o] for o in query.objects]
            if are_closed and use.is_gated and not {"distance", "frame"} & {*use.wants}:  # as right after a reset
                result.append(penetration(pairs_for(scene, True), probes, (), use.reach[:0], use.wants))
                continue
            answer = None
            if use.search is not None:
                names = [name for name in ("pair", "spheres", "geoms") if getattr(use.search, name) is not None]
                tables = {name: getattr(use.search, name) for name in names}
                searched, pairs = [felt[o] for o in use.objects], pairs_for(scene, use.is_gated)
                answer = search(pairs, probes, searched, tables, _reach(use, scene), use.wants)
            if answer is None:
                if use.query not in measured:
                    measured[use.query] = measure(pairs_for(scene, True), probes, felt)
                near = [measured[use.query][o] for o in use.objects]
                answer = penetration(pairs_for(scene, use.is_gated), probes, near, _reach(use, scene), use.wants)
            result.append(answer)
        return tuple(result)

    def reference(self, part: ContactDepthPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferencePenetration:
        """Return what probes feel by the paper's equations.

        q = p_L + R_L x, d = max(0, max_g (R − φ_g(q))), m = ∇φ at the deepest geom, v = R_Lᵀ (v_C(q) − v_L(q)).
        """
        use_part, layout = part.uses[use], scene.layout
        radius = use_part.reach[:, scene.rows].max(axis=0, initial=-np.inf)
        links, num = [scene.body(link.body) for link in layout.links], (layout.num_taxels, len(use_part.objects))
        normal, velocity, angular = np.zeros((3, num[0], 3))
        distance, outward, rotation, offset = (np.zeros((*num, *rest)) for rest in ((), (3,), (3, 3), (3,)))
        distance += np.inf
        felt = ReferencePenetration(np.zeros(num[0]), normal, velocity, angular, distance, outward, rotation, offset)
        for k, o in enumerate(part.queries[use_part.query].objects[o] for o in use_part.objects):
            target, table = scene.objects[o], part.geoms[o]
            assert table is not None
            body, geoms = scene.object_body(target), geoms_of(table, scene.variant(target), scene.size(target))
            for j, i in enumerate(layout.link_id):
                link, name = links[i], layout.links[i].body
                is_open = not use_part.is_gated or scene.is_touching(name, target.name)
                if radius[j] == -np.inf or target.body == name or not is_open:
                    continue
                q = link.pos + link.rotation @ layout.pos[j]
                rotation[j, k] = body.rotation.T @ link.rotation
                offset[j, k] = body.rotation.T @ (link.pos - body.pos)
                distance[j, k], gradient = distance_to(geoms, body.rotation.T @ (q - body.pos))
                outward[j, k] = link.rotation.T @ body.rotation @ gradient
                depth, deepest = radius[j] - distance[j, k], felt.depth[j]
                felt.depth[j] = max(depth, deepest)
                if depth > (deepest + TIE if deepest > 0 else 0.0):
                    normal[j] = outward[j, k]
                    velocity[j] = link.rotation.T @ (body.velocity_at(q) - link.velocity_at(q))
                    angular[j] = link.rotation.T @ (body.angvel - link.angvel)
        return felt

    def fields(self, part: ContactDepthPart) -> set[str]:
        is_moving = any("motion" in use.wants for use in part.uses)
        is_gated = any(use.is_gated for use in part.uses)
        return {*(["body_linvel", "body_angvel"] if is_moving else []), *(["contact_found"] if is_gated else [])}

    def is_light(self, part: ContactDepthPart) -> bool:
        shapes = {shape for table in part.geoms if table is not None for shape in table.shapes}
        return shapes <= SHAPES.keys() and all(set(use.wants) <= {"distance"} for use in part.uses)

    def explain(self, part: ContactDepthPart[np.ndarray], use: int, objects: Sequence[PairedObject]) -> list[str]:
        use_part = part.uses[use]
        query, felt = part.queries[use_part.query], []
        for o in (query.objects[o] for o in use_part.objects):
            table, target = part.geoms[o], objects[o]
            variants = [f"{target.num_variants} variants"] if target.num_variants > 1 else []
            size = ["its size given per environment"] if target.is_sized else []
            felt.append(target.name if table is None else f"{target.name} ({', '.join([*table.shapes, *variants, *size])})")
        gate = "where MuJoCo has the pair in contact" if use_part.is_gated else "wherever a probe reaches"
        extra = " with " + " and ".join(use_part.wants) if use_part.wants else ""
        probes = f"{query.pos.shape[1]} probes (query {use_part.query}){extra}"
        return [f"depth of {probes} in {', '.join(felt) or 'nothing'}, {gate}"]

    def account(self, part: ContactDepthPart[np.ndarray], objects: Sequence[PairedObject]) -> dict[str, list[str]]:
        lines = []
        for target, table in zip(objects, part.geoms, strict=True):
            if table is not None:
                name, count = target.name, target.num_variants
                lines += account_of_geoms(table, [f"{name}, variant {i}" if count > 1 else name for i in range(count)])
        return {"meshes": lines} if lines else {}


CONTACT_DEPTH = _ContactDepth()


def _table(planning: Planning, name: str, uses: Sequence[Use]) -> GeomTable[np.ndarray] | None:
    """Return the geoms of an object with their distances; None if nobody measures them, or a mesh cannot be baked."""
    from tgdsl.quantities.bake import geom_distance, geom_table  # compilers alone bake meshes

    sensed, margins = planning.sensed[name], []
    for use in uses:
        radius = planning.layout.radius[use.taxels]
        if name in use.request.objects and use.request.wants_distance(radius):
            margins.append(max(float(use.request.reach(radius).max()), use.request.range) + use.largest_shift)
    if not margins:
        return None
    cases, count = [], len(sensed.variants)
    try:
        for i, geoms in enumerate(sensed.variants):
            which = f" ({i + 1} of {count} variants)" if count > 1 else ""
            planning.progress(f"object {name}: distances{which}")
            cases.append([geom_distance(geom, sensed.distance, max(margins), f"object {name}") for geom in geoms])
    except BakeError as error:
        planning.report(("objects", name), str(error), "")
        return None
    return geom_table(cases)


def _query(
    planning: Planning, number: int, uses: Sequence[Use], tables: Mapping[str, GeomTable]
) -> tuple[ProbeQuery[np.ndarray], list[DepthUse[np.ndarray]]]:
    """Return the query of uses at the same probes, and the uses' parts."""
    names_of_objects, taxels = [target.name for target in planning.objects], uses[0].taxels
    radius, bodies, result = planning.layout.radius[taxels], planning.bodies_of(taxels), []
    felt_by = [[n for n in use.request.objects if n in names_of_objects and use.request.wants_distance(radius)] for use in uses]
    felt = list(dict.fromkeys(name for names in felt_by for name in names))
    pair = planning.pair_table(felt, taxels)
    for use, names in zip(uses, felt_by, strict=True):
        request, objects = use.request, [felt.index(name) for name in names]
        allowed = {(p.link, p.object) for p in planning.allowed(request)}
        can_meet = np.array([[(body, name) in allowed for body in bodies] for name in names], dtype=bool)
        reach = np.where(can_meet.reshape(len(names), len(bodies)), request.reach(radius), -np.inf)
        search = _search(planning, names, request.wants, pair[objects], tables)
        result.append(DepthUse(number, tuple(objects), request.is_gated, request.wants, use.radius_noise, reach, search))
    return ProbeQuery(tuple(names_of_objects.index(name) for name in felt), uses[0].pos, pair), result


def _search(
    planning: Planning, names: Sequence[str], wants: Sequence[str], pair: np.ndarray, tables: Mapping[str, GeomTable]
) -> SearchPart[np.ndarray] | None:
    """Return the inputs of the kernel's search; None where it cannot answer."""
    if any(name not in tables for name in names):
        return None  # which has been reported
    if not is_searchable([shape for name in names for shape in tables[name].shapes], wants):
        return None
    targets = [target for name in names for target in planning.objects if target.name == name]
    pairs = (pair + np.array([target.first_pair for target in targets])[:, None]).astype(np.int32)
    if any(target.num_variants > 1 or target.is_sized for target in targets):
        return SearchPart(pairs, None, None)
    objects = []
    for table in (tables[name] for name in names):
        size, pos, rotation = (torch.from_numpy(np.asarray(part)) for part in (table.size, table.pos, table.rotation))
        objects.append(Geoms(table.shapes, table.is_centred, size, pos, rotation, None, None, (None,) * len(table.shapes)))
    spheres, geoms = geom_tables(objects)
    return SearchPart(pairs, spheres.numpy(), geoms.numpy())
