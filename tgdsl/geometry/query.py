"""The question every contact sensor asks: how deep is a probe in which object, which way is out, how does it move.

Shapes: `env` environments, `pair` (link, object) pairs, `taxel` probes, `geom` geoms of an object. A pair's planes are
small, a taxel's are not, so everything that depends on the pair alone is formed first and gathered once.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.bvh import TriangleMesh, nearest
from tgdsl.geometry.grid import METHODS, Grid
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.geometry.shapes import SHAPES


class Motion(NamedTuple):
    """Motion of an object relative to a link, in the link's frame, as a velocity field v(x) = linear + angular × x.

    Attributes:
        linear: Velocity of the object's material at the link's origin, less the link's own [m/s].
        angular: Relative angular velocity [rad/s].
    """

    linear: Vec
    angular: Vec


class Pairs(NamedTuple):
    """What relates each link to each object: planes of shape (env, pair), sorted by object.

    Attributes:
        rotation: Rotates link vectors into the object's frame.
        offset: The link's origin in the object's frame [m].
        motion: Relative motion, if some sensor wants it.
        gate: 0 where the pair may be felt, −∞ where it may not; None if nothing is gated.
    """

    rotation: Rot
    offset: Vec
    motion: Motion | None
    gate: Tensor | None


class Probes(NamedTuple):
    """Probes of one query; the positions are in the frame of each probe's link.

    Attributes:
        pos: Positions [m], planes of shape (taxel,).
        reach: Radius of each probe towards each object [m]; −∞ where the probe is inactive or the pair cannot meet.
        pair: For each object, index of each probe's pair among the pairs of that object.
    """

    pos: Vec
    reach: Float[Tensor, "object taxel"]
    pair: Int[Tensor, "object taxel"]


class RaycastSurface(NamedTuple):
    """Triangles that are queried at run time, and the distance [m] up to which they are told apart."""

    mesh: TriangleMesh
    max_distance: float


class FeltObject(NamedTuple):
    """An object's geoms in its body's frame, and where its pairs are.

    Attributes:
        name: Its name.
        first_pair: Index of its first pair.
        num_pairs: Number of its pairs.
        shapes: MuJoCo's name of each geom's type.
        is_centred: Whether each geom's frame is the body's.
        size: Size of each geom as MuJoCo defines it [m].
        pos: Origin of each geom in the body frame [m].
        rotation: Rotates geom vectors into the body frame, row by row.
        surfaces: Grid or triangles of each geom that is no primitive.
    """

    name: str
    first_pair: int
    num_pairs: int
    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]
    size: Float[Tensor, "geom 3"]
    pos: Float[Tensor, "geom 3"]
    rotation: Float[Tensor, "geom 9"]
    surfaces: tuple[Grid | RaycastSurface | None, ...]


class Distance(NamedTuple):
    """Signed distance of each probe to one object's surface [m], and its gradient in the link's frame: planes (env, taxel).

    The distance is infinite where the pair is out of question: an inactive probe, or a link and itself.
    """

    value: Tensor
    gradient: Vec


class Felt(NamedTuple):
    """The answer, at the geom that each probe is deepest in; planes of shape (env, taxel), in the link's frame.

    Attributes:
        depth: Penetration depth max(0, radius − distance) [m].
        normal: Unit normal out of the object; zero where the depth is zero. None if no sensor wants it.
        velocity: Velocity of the object's material at the probe relative to the probe [m/s]; None if not wanted.
        angular: Angular velocity of the object relative to the link [rad/s]; None if not wanted.
        distances: Distance to each object, by its name; empty if not wanted.
    """

    depth: Tensor
    normal: Vec | None
    velocity: Vec | None
    angular: Vec | None
    distances: dict[str, Distance]


def relate(
    pos: Float[Tensor, "env body 3"],
    quat: Float[Tensor, "env body 4"],
    link: Int[Tensor, " pair"],
    target: Int[Tensor, " pair"],
    dtype: torch.dtype,
    linvel: Float[Tensor, "env body 3"] | None = None,
    angvel: Float[Tensor, "env body 3"] | None = None,
    gate: Tensor | None = None,
) -> Pairs:
    """Form the relative poses and motions of all pairs in the dtype of the state, then cast them.

    Args:
        pos: World positions of the bodies' frames [m].
        quat: World orientations, w, x, y, z.
        link: Body index of each pair's link.
        target: Body index of each pair's object.
        dtype: Dtype of the result.
        linvel: World velocities of the bodies' frame origins [m/s], if motion is wanted.
        angvel: World angular velocities [rad/s], if motion is wanted.
        gate: Handed through.

    Returns:
        The pairs, in `dtype`.
    """
    link_rotation, target_rotation = planes.rotation(quat[:, link]), planes.rotation(quat[:, target])
    apart = planes.sub(planes.split(pos[:, link]), planes.split(pos[:, target]))
    rotation = planes.transpose_times(target_rotation, link_rotation)
    offset = planes.rotate_back(target_rotation, apart)
    parts = [*rotation, *offset]
    if linvel is not None and angvel is not None:
        spin, turn = planes.split(angvel[:, target]), planes.split(angvel[:, link])
        slide = planes.sub(planes.split(linvel[:, target]), planes.split(linvel[:, link]))
        parts += planes.rotate_back(link_rotation, planes.add(slide, planes.cross(spin, apart)))
        parts += planes.rotate_back(link_rotation, planes.sub(spin, turn))
    # Stacked, they are stored once per pair; a compiler that fuses would else form them anew for every taxel.
    parts = torch.stack([part.to(dtype) for part in parts], dim=1).unbind(1)
    motion = Motion(planes.vec(parts[12:15]), planes.vec(parts[15:18])) if len(parts) > 12 else None
    return Pairs(planes.rot(parts[:9]), planes.vec(parts[9:12]), motion, gate)


def feel(pairs: Pairs, probes: Probes, objects: Sequence[FeltObject], needs: Collection[str]) -> Felt:
    """Query all probes against all objects; the deepest geom wins, the first among equals.

    Args:
        pairs: Relative poses of all pairs of the plan.
        probes: The probes.
        objects: The objects, in the order of `probes.reach`.
        needs: Which optional parts of the answer are wanted: "normal", "motion", "distance".

    Returns:
        Depth and what is wanted besides, at each probe. Not-a-number in a pose comes out as not-a-number.
    """
    num_envs = pairs.offset[0].shape[0]
    zero = pairs.offset[0].new_zeros((num_envs, probes.pos[0].shape[0]))
    depth, normal, linear, angular = zero, (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
    with_normal, with_motion = "normal" in needs, "motion" in needs and pairs.motion is not None
    distances: dict[str, Distance] = {}
    for i, target in enumerate(objects):
        own = slice(target.first_pair, target.first_pair + target.num_pairs)
        pair, reach = probes.pair[i], probes.reach[i]
        if pairs.gate is not None:
            reach = reach + pairs.gate[:, own][:, pair]
        distance, gradient = _distance(pairs, probes, target, own, pair)
        reached = reach - distance
        is_deeper = reached > torch.where(depth > 0, depth + planes.TIE, 0.0)
        if with_normal:
            normal = planes.where(is_deeper, gradient, normal)
        if with_motion and pairs.motion is not None:
            linear = planes.where(is_deeper, _gathered(pairs.motion.linear, own, pair), linear)
            angular = planes.where(is_deeper, _gathered(pairs.motion.angular, own, pair), angular)
        if "distance" in needs:
            distances[target.name] = Distance(torch.where(reach > -torch.inf, distance, torch.inf), gradient)
        depth = torch.maximum(depth, reached)
    velocity = planes.add(linear, planes.cross(angular, probes.pos)) if with_motion else None
    return Felt(depth, normal if with_normal else None, velocity, angular if with_motion else None, distances)


def _distance(pairs: Pairs, probes: Probes, target: FeltObject, own: slice, pair: Tensor) -> tuple[Tensor, Vec]:
    """Return signed distance [m] to the union of an object's geoms, and its gradient in the link's frame."""
    answers = []
    for g, shape in enumerate(target.shapes):
        rotation, offset = _link_in_geom(pairs, own, target, g)
        rotation = planes.rot(part[:, pair] for part in rotation)
        offset = planes.vec(part[:, pair] for part in offset)
        point = planes.add(planes.rotate(rotation, probes.pos), offset)
        surface = target.surfaces[g]
        if isinstance(surface, Grid):
            distance, gradient = METHODS[shape](point, surface)
        elif isinstance(surface, RaycastSurface):
            distance, gradient = nearest(point, surface.mesh, surface.max_distance)
        else:
            distance, gradient = SHAPES[shape](point, planes.split(target.size[g]))
        answers.append((distance, planes.rotate_back(rotation, gradient)))
    least, outward = answers[0]
    for distance, gradient in answers[1:]:
        outward = planes.where(distance < least - planes.TIE, gradient, outward)
        least = torch.minimum(least, distance)
    return least, outward


def _link_in_geom(pairs: Pairs, own: slice, target: FeltObject, g: int) -> tuple[Rot, Vec]:
    rotation = planes.rot(part[:, own] for part in pairs.rotation)
    offset = planes.vec(part[:, own] for part in pairs.offset)
    if target.is_centred[g]:
        return rotation, offset
    geom_rotation = planes.rot(target.rotation[g].unbind(0))
    moved = planes.sub(offset, planes.split(target.pos[g]))
    return planes.transpose_times(geom_rotation, rotation), planes.rotate_back(geom_rotation, moved)


def _gathered(vector: Vec, own: slice, pair: Tensor) -> Vec:
    return planes.vec(part[:, own][:, pair] for part in vector)
