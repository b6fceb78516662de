"""The question most contact sensors ask: how deep is a probe in which object, which way is out, how does it move.

Two steps: `measure` finds the distance of every probe to every object, once, and `penetration` makes of it what one sensor
feels, of which there may be several with different gates and objects. `search.search` does both where a GPU's kernel can.

Shapes: `env` environments, `pair` (link, object) pairs, `taxel` probes, `geom` geoms of an object.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.quantities.contact_depth.request import Distance, Penetration
from tgdsl.quantities.geoms.distance import Frame, Geoms, union_distance
from tgdsl.quantities.pairs import PairedObject, Pairs, at_probes, gathered


class Probes(NamedTuple):
    """Probes of one query; the positions are in the frame of each probe's link.

    Attributes:
        pos: Positions [m], planes of shape (taxel,).
        pair: For each object, index of each probe's pair among the pairs of that object.
    """

    pos: Vec
    pair: Int[Tensor, "object taxel"]


class Target(NamedTuple):
    """An object that probes are measured against: where its pairs are, and its geoms."""

    object: PairedObject
    geoms: Geoms


class ObjectDistance(NamedTuple):
    """How far each probe is from one object's surface.

    Attributes:
        name: The object's name.
        pairs: Its pairs among all of the plan.
        pair: Index of each probe's pair among them.
        distance: Signed distance [m], a plane (env, taxel).
        gradient: Its unit gradient in the link's frame.
    """

    name: str
    pairs: slice
    pair: Int[Tensor, " taxel"]
    distance: Tensor
    gradient: Vec


def measure(pairs: Pairs, probes: Probes, targets: Sequence[Target]) -> tuple[ObjectDistance, ...]:
    """Return how far all probes are from each object, in the order of `probes.pair`.

    Not-a-number in a pose comes out as not-a-number.
    """
    found = []
    for (target, geoms), pair in zip(targets, probes.pair, strict=True):
        distance, gradient = _distance(pairs, probes, geoms, target.pairs, pair)
        found.append(ObjectDistance(target.name, target.pairs, pair, distance, gradient))
    return tuple(found)


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
        near: The objects that are felt, the first of equals first.
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
    """Return how an object, or a geom of it, sees each probe, of how it sees the links."""
    turn, shift = ([at_probes(part, slice(None), pair) for part in parts] for parts in (rotation, offset))
    return Frame(planes.rot(turn), planes.vec(shift))


def _link_in_geom(rotation: Rot, offset: Vec, geoms: Geoms, g: int) -> tuple[Rot, Vec]:
    geom_rotation = planes.rot(geoms.rotation[:, g, None].unbind(-1))
    moved = planes.sub(offset, planes.split(geoms.pos[:, g, None]))
    return planes.transpose_times(geom_rotation, rotation), planes.rotate_back(geom_rotation, moved)
