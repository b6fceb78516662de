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
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.quantities.base import Request
from tgdsl.quantities.geoms import Frame, Geoms, union_distance
from tgdsl.quantities.pairs import Motion, PairedObject, Pairs, at_probes, gathered
from tgdsl.quantities.search_tables import SHAPES, Deepest, Tables, geom_tables
from tgdsl.tensors.operations import Operation


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
        """Return what two requests at the same probes have in common if they are one: objects, gate and radii."""
        return type(self), self.objects, self.is_gated, None if self.radius is None else self.radius.tobytes()

    def merged(self, other: Request) -> ContactDepth:
        """Return a request for what both ask for."""
        assert isinstance(other, ContactDepth)
        wants = dict.fromkeys((*self.wants, *other.wants), True)
        return dataclasses.replace(self, range=max(self.range, other.range), **wants)

    def join_key(self) -> tuple[Any, ...]:
        """Return the key by which requests at different probes can be joined: everything except radii and range."""
        return type(self), self.objects, self.is_gated, self.wants, self.radius is None

    def joined(self, others: Sequence[Request]) -> ContactDepth:
        """Return one request for several sensors' probes, each with its own radii."""
        every = [self, *(other for other in others if isinstance(other, ContactDepth))]
        radii = [request.radius for request in every if request.radius is not None]
        radius = np.concatenate(radii) if radii else None
        return dataclasses.replace(self, radius=radius, range=max(request.range for request in every))

    def wants_distance(self, radius: Float[np.ndarray, " taxel"]) -> bool:
        """Return whether distances are measured for it: not where no probe reaches anywhere, unless they are asked for."""
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
    """Return how far all probes are from each object, in the order of `probes.pair`.

    Not-a-number in a pose comes out as not-a-number.
    """
    results = []
    for (target, geoms), pair in zip(targets, probes.pair, strict=True):
        distance, gradient = _distance(pairs, probes, geoms, target.pairs, pair)
        results.append(ObjectDistance(target.name, target.pairs, pair, distance, gradient))
    return tuple(results)


def penetration(
    pairs: Pairs,
    probes: Probes,
    near: Sequence[ObjectDistance],
    reach: Float[Tensor, "object *env taxel"],
    wants: Collection[str],
) -> Penetration:
    """Return what the probes feel; the deepest object wins, the first among equals.

    Args:
        pairs: Relative poses of all pairs of the plan.
        probes: The probes.
        near: The objects; the first of equals wins.
        reach: Radius of each probe towards each of them [m]; −∞ where the probe is inactive or the pair cannot meet.
        wants: Which optional parts of the answer are wanted here: "normal", "motion", "distance", "frame".
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
    frames = [
        centred if is_centred else _at_probes(*_link_in_geom(rotation, offset, geoms, g), pair)
        for g, is_centred in enumerate(geoms.is_centred)
    ]
    return union_distance(probes.pos, frames, geoms)


def _at_probes(rotation: Rot, offset: Vec, pair: Tensor) -> Frame:
    turn, shift = ([at_probes(part, slice(None), pair) for part in parts] for parts in (rotation, offset))
    return Frame(planes.rot(turn), planes.vec(shift))


def _link_in_geom(rotation: Rot, offset: Vec, geoms: Geoms, g: int) -> tuple[Rot, Vec]:
    geom_rotation = planes.rot(geoms.rotation[:, g, None].unbind(-1))
    moved = planes.sub(offset, planes.split(geoms.pos[:, g, None]))
    return planes.transpose_times(geom_rotation, rotation), planes.rotate_back(geom_rotation, moved)


THRESHOLD = 5
"""Geoms from which on the kernel is used: with four boxes Inductor's code is as fast, 1.6 million probes in 0.08 ms."""
Reach = Float[Tensor, "object *env taxel"]


def is_searchable(shapes: Collection[str], wants: Collection[str]) -> bool:
    """Return whether the kernel can answer: enough geoms, all of shapes that it knows, and nothing but normal and motion."""
    is_known = all(shape in SHAPES for shape in shapes) and all(want in ("normal", "motion") for want in wants)
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

    `known` has their tables by name, as in `Tables`: `pair`, and the others where they are the same at all calls.
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
    """Return what the probes are deepest in, the first of equals; `known` as `search` has it, the pairs' gate holds."""
    pairs_of = torch.stack([pair - target.object.first_pair for pair, target in zip(known["pair"], targets, strict=True)])
    near = measure(pairs, Probes(probes.pos, pairs_of), targets)
    # What moves along x by the number of its pair tells which pair is felt.
    number = torch.arange(1, pairs.offset[0].shape[1] + 1, dtype=reach.dtype, device=reach.device).expand_as(pairs.offset[0])
    still = torch.zeros_like(number)
    motion = Motion((number, still, still), (still, still, still), (still, still, still))
    felt = penetration(pairs._replace(motion=motion), probes, near, reach, ("normal", "motion"))
    assert felt.normal is not None and felt.velocity is not None
    return Deepest(felt.depth, felt.normal, felt.velocity[0].int() - 1)


def _by_kernel(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> Deepest:
    from tgdsl.quantities.deepest_kernel import find

    spheres, geoms = (
        (known["spheres"], known["geoms"]) if "geoms" in known else geom_tables([target.geoms for target in targets])
    )
    return find(pairs, probes.pos, Tables(known["pair"], spheres, geoms), reach)


def _inputs(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> list[Tensor]:
    motion = () if pairs.motion is None else (*pairs.motion.linear, *pairs.motion.angular)
    geoms = [part for _, geom in targets for part in (geom.size, geom.pos, geom.rotation)]
    return [*pairs.offset, *pairs.rotation, *motion, *probes.pos, reach, *geoms]


DEEPEST = Operation("deepest", deepest, _by_kernel, _inputs)
