"""The question every contact sensor asks: how deep is a probe in which object, which way is out, how does it move.

Two steps: `measure` finds the distance of every probe to every object, once, and `feel` makes of it what one sensor feels, of
which there may be several with different gates, objects and needs. `search.search` does both where a GPU's kernel can.

Shapes: `env` environments, `pair` (link, object) pairs, `taxel` probes, `geom` geoms of an object, `case` 1, or `env` if the
object differs between environments. A pair's planes are small, a taxel's are not, so everything that depends on the pair alone
is formed first and gathered once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.bvh import TriangleMesh, nearest
from tgdsl.geometry.grid import METHODS, Grid
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.geometry.shapes import SHAPES
from tgdsl.quantities.contacts.contacts import Contacts
from tgdsl.quantities.moments.moments import Moments


class Motion(NamedTuple):
    """Motion of an object relative to a link, in the link's frame, as a velocity field v(x) = linear + angular × x.

    Attributes:
        linear: Velocity of the object's material at the link's origin, less the link's own [m/s].
        angular: Relative angular velocity [rad/s].
        turn: The link's own angular velocity [rad/s].
    """

    linear: Vec
    angular: Vec
    turn: Vec


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
        pair: For each object, index of each probe's pair among the pairs of that object.
    """

    pos: Vec
    pair: Int[Tensor, "object taxel"]


class RaycastSurface(NamedTuple):
    """Triangles that are queried at run time, one mesh per variant, and the distance [m] up to which they are told apart."""

    meshes: tuple[TriangleMesh, ...]
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
        is_absent: Which geoms an environment's object lacks; None if none does.
        variant: Which variant each environment has; None if all are alike.
        surfaces: Grid or triangles of each geom that is no primitive.
    """

    name: str
    first_pair: int
    num_pairs: int
    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]
    size: Float[Tensor, "case geom 3"]
    pos: Float[Tensor, "case geom 3"]
    rotation: Float[Tensor, "case geom 9"]
    is_absent: Bool[Tensor, "case geom"] | None
    variant: Int[Tensor, " env"] | None
    surfaces: tuple[Grid | RaycastSurface | None, ...]


class Near(NamedTuple):
    """How near each probe is to one object's surface.

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


class Distance(NamedTuple):
    """Signed distance of each probe to one object's surface [m], and its gradient in the link's frame: planes (env, taxel).

    The distance is infinite where the pair is out of question: an inactive probe, or a link and itself.
    """

    value: Tensor
    gradient: Vec


class Frame(NamedTuple):
    """How an object sees the link: a place on the link, rotated and shifted, is in the object's frame; planes (env, taxel).

    Attributes:
        rotation: Rotates link vectors into the object's frame.
        offset: The link's origin in the object's frame [m].
    """

    rotation: Rot
    offset: Vec


class Felt(NamedTuple):
    """The answer, at the geom that each probe is deepest in; planes of shape (env, taxel), in the link's frame.

    Attributes:
        depth: Penetration depth max(0, radius − distance) [m].
        normal: Unit normal out of the object; zero where the depth is zero. None if no sensor wants it.
        velocity: Velocity of the object's material at the probe relative to the probe [m/s]; None if not wanted.
        angular: Angular velocity of the object relative to the link [rad/s]; None if not wanted.
        distances: Distance to each object, by its name; empty if not wanted.
        frames: How each object sees the link, by its name; empty if not wanted.
        contacts: The solver's contacts on the bodies that carry the probes; None if not wanted.
        moments: Moments of each object's surface, by its name, see `moments`; empty if not wanted, as the next two.
        motions: Motion of each object relative to the link; only with moments.
        area: Area of each object's outer surface, planes left out [m²], (case, 1).
        points: Points of each object that some link may meet, by its name: a `points.Meeting`; empty if not wanted.
    """

    depth: Tensor
    normal: Vec | None
    velocity: Vec | None
    angular: Vec | None
    distances: dict[str, Distance]
    frames: dict[str, Frame]
    contacts: Contacts | None
    moments: dict[str, Moments]
    motions: dict[str, Motion]
    area: dict[str, Tensor]
    points: dict[str, Any]


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
        gate: 0 where a pair may be felt, −∞ where it may not; None if nothing is gated.

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
        parts += planes.rotate_back(link_rotation, turn)
    is_moving = len(parts) > 12
    parts += [] if gate is None else [gate + 0.0 * parts[9]]  # of the same numbers, so that it is formed beside the others
    # Stacked, they are stored once per pair; a compiler that fuses would else form them anew for every taxel.
    parts = torch.stack([part.to(dtype) for part in parts], dim=1).unbind(1)
    motion = Motion(planes.vec(parts[12:15]), planes.vec(parts[15:18]), planes.vec(parts[18:21])) if is_moving else None
    return Pairs(planes.rot(parts[:9]), planes.vec(parts[9:12]), motion, None if gate is None else parts[-1])


def measure(pairs: Pairs, probes: Probes, objects: Sequence[FeltObject]) -> tuple[Near, ...]:
    """Return how near all probes are to each object, in the order of `probes.pair`.

    Not-a-number in a pose comes out as not-a-number.
    """
    found = []
    for target, pair in zip(objects, probes.pair, strict=True):
        own = slice(target.first_pair, target.first_pair + target.num_pairs)
        distance, gradient = _distance(pairs, probes, target, own, pair)
        found.append(Near(target.name, own, pair, distance, gradient))
    return tuple(found)


def feel(
    pairs: Pairs,
    probes: Probes,
    near: Sequence[Near],
    reach: Float[Tensor, "object *env taxel"],
    needs: Collection[str],
    contacts: Contacts | None = None,
) -> Felt:
    """Return what the probes feel; the deepest object wins, the first among equals.

    Args:
        pairs: Relative poses of all pairs of the plan.
        probes: The probes.
        near: The objects that are felt, the first of equals first.
        reach: Radius of each probe towards each of them [m]; −∞ where the probe is inactive or the pair cannot meet.
        needs: Which optional parts of the answer are wanted here: "normal", "motion", "distance", "frame".
        contacts: Handed through.

    Returns:
        Depth and what is wanted besides, at each probe.
    """
    num_envs = pairs.offset[0].shape[0]
    zero = pairs.offset[0].new_zeros((num_envs, probes.pos[0].shape[0]))
    depth, normal, linear, angular = zero, (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
    with_normal, with_motion = "normal" in needs, "motion" in needs and pairs.motion is not None
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
        if "distance" in needs:
            value = torch.where(radius.isnan(), radius, target.distance)
            value = torch.where(radius == -torch.inf, torch.inf, value)
            distances[target.name] = Distance(value, target.gradient)
        if "frame" in needs:
            rotation = planes.rot(at_probes(part, target.pairs, target.pair) for part in pairs.rotation)
            frames[target.name] = Frame(rotation, gathered(pairs.offset, target.pairs, target.pair))
        depth = torch.maximum(depth, reached)
    velocity = planes.add(linear, planes.cross(angular, probes.pos)) if with_motion else None
    return Felt(
        depth=depth,
        normal=normal if with_normal else None,
        velocity=velocity,
        angular=angular if with_motion else None,
        distances=distances,
        frames=frames,
        contacts=contacts,
        moments={},
        motions={},
        area={},
        points={},
    )


def _distance(pairs: Pairs, probes: Probes, target: FeltObject, own: slice, pair: Tensor) -> tuple[Tensor, Vec]:
    """Return signed distance [m] to the union of an object's geoms, and its gradient in the link's frame."""
    frames = []
    for g in range(len(target.shapes)):
        rotation, offset = _link_in_geom(pairs, own, target, g)
        every = slice(None)
        turn, shift = ([at_probes(part, every, pair) for part in parts] for parts in (rotation, offset))
        frames.append(Frame(planes.rot(turn), planes.vec(shift)))
    return _union(probes.pos, frames, target)


def body_distance(point: Vec, target: FeltObject) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points in a body's own frame to the union of its geoms, and its gradient there."""
    frames = []
    for g, is_centred in enumerate(target.is_centred):
        turn = planes.rot(target.rotation[:, g, None].unbind(-1))
        xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
        offset = planes.vec(-part for part in planes.rotate_back(turn, planes.split(target.pos[:, g, None])))
        frames.append(None if is_centred else Frame((xx, yx, zx, xy, yy, zy, xz, yz, zz), offset))
    return _union(point, frames, target)


def _union(point: Vec, frames: Sequence[Frame | None], target: FeltObject) -> tuple[Tensor, Vec]:
    """Return signed distance [m] to the nearest geom, the first among equals, and its gradient in the points' frame.

    `frames` say how each geom sees the points; None: they are in its frame already.
    """
    return united((_in_frame(point, frame, target, g) for g, frame in enumerate(frames)), target.is_absent)


def united(geoms: Iterable[tuple[Tensor, Vec]], is_absent: Bool[Tensor, "case geom"] | None) -> tuple[Tensor, Vec]:
    """Return the least of the distances to an object's geoms [m], the first among equals, and its gradient.

    Args:
        geoms: Signed distance to each geom [m] and its gradient, planes (case, …, point).
        is_absent: Which geoms a case lacks; None if none does.
    """
    least, outward = None, None
    for g, (distance, gradient) in enumerate(geoms):
        if is_absent is not None:
            distance = torch.where(is_absent[:, g, None], torch.inf, distance)
        if least is None or outward is None:
            least, outward = distance, gradient
        else:
            outward = planes.where(distance < least - planes.tie(), gradient, outward)
            least = torch.minimum(least, distance)
    assert least is not None and outward is not None
    return least, outward


def _in_frame(point: Vec, frame: Frame | None, target: FeltObject, g: int) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points to a geom that sees them as a frame says, and its gradient in the points' frame."""
    if frame is None:
        return _to_geom(point, target, g)
    distance, gradient = _to_geom(planes.add(planes.rotate(frame.rotation, point), frame.offset), target, g)
    return distance, planes.rotate_back(frame.rotation, gradient)


def _to_geom(point: Vec, target: FeltObject, g: int) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points in a geom's frame to it, and its gradient there."""
    shape, surface = target.shapes[g], target.surfaces[g]
    if isinstance(surface, Grid):
        return METHODS[shape](point, surface)
    if isinstance(surface, RaycastSurface):
        which = target.variant[:, None] if target.variant is not None and len(surface.meshes) > 1 else None
        return nearest(point, surface.meshes, surface.max_distance, which)
    return SHAPES[shape](point, planes.split(target.size[:, g, None]))


def _link_in_geom(pairs: Pairs, own: slice, target: FeltObject, g: int) -> tuple[Rot, Vec]:
    rotation = planes.rot(part[:, own] for part in pairs.rotation)
    offset = planes.vec(part[:, own] for part in pairs.offset)
    if target.is_centred[g]:
        return rotation, offset
    geom_rotation = planes.rot(target.rotation[:, g, None].unbind(-1))
    moved = planes.sub(offset, planes.split(target.pos[:, g, None]))
    return planes.transpose_times(geom_rotation, rotation), planes.rotate_back(geom_rotation, moved)


def gathered(vector: Vec, own: slice, pair: Tensor) -> Vec:
    """Return a vector of the pairs (env, pair) for each probe: those of an object, and which of them each probe's is."""
    return planes.vec(at_probes(part, own, pair) for part in vector)


def at_probes(part: Float[Tensor, "env pairs"], own: slice, pair: Int[Tensor, " taxel"]) -> Float[Tensor, "env taxel"]:
    """Return a plane of the pairs for each probe; where an object has one pair alone, nothing is looked up."""
    part = part[:, own]
    return part.expand(-1, pair.shape[0]) if part.shape[1] == 1 else part[:, pair]
