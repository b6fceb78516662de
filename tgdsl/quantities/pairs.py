"""Links and objects in pairs: how each object lies and moves as each link sees it.

Shapes: `env` environments, `body` bodies of the state, `pair` (link, object) pairs, `taxel` probes. A pair's planes are small,
a taxel's are not, so everything that depends on the pair alone is formed first and gathered once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Plane, Rot, Vec

Array = TypeVar("Array")


@dataclass(frozen=True)
class Pair:
    """A link's body and an object that its taxels may feel."""

    link: str
    object: str


@dataclass(frozen=True)
class PairedObject:
    """An object that some link may meet."""

    name: str  # its name
    body: str  # its body
    first_pair: int  # index of its first pair
    num_pairs: int  # number of its pairs
    num_variants: int  # number of its variants; 1 if it is the same in all environments
    is_sized: bool  # whether its size is part of the state
    varied: int  # its index in `inputs.objects`, the objects that differ between environments; −1 if it does not differ

    @property
    def pairs(self) -> slice:
        """Its pairs."""
        return slice(self.first_pair, self.first_pair + self.num_pairs)


@dataclass(frozen=True, eq=False)
class PairTable(Generic[Array]):
    """The Plan's pairs, sorted by object."""

    link: Array  # index of each pair's link among the bodies of the state, (pair,)
    object: Array  # index of its object's body
    gate: Array  # its place among `inputs.pairs`, whose contacts are read; 0 where no request wants to know


class Motion(NamedTuple):
    """Motion of an object relative to a link, in the link's frame, as a velocity field v(x) = linear + angular × x."""

    linear: Vec  # velocity of the object's material at the link's origin, less the link's own [m/s]
    angular: Vec  # relative angular velocity [rad/s]
    turn: Vec  # the link's own angular velocity [rad/s]


class Pairs(NamedTuple):
    """What relates each link to each object: planes of shape (env, pair), sorted by object."""

    rotation: Rot  # rotates link vectors into the object's frame
    offset: Vec  # the link's origin in the object's frame [m]
    motion: Motion | None  # relative motion, if some sensor wants it
    gate: Tensor | None  # 0 where the pair counts, −∞ where it does not; None if nothing is gated


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

    `link` and `target` are indices of bodies; `gate` is 0 where a pair counts, −∞ where it does not, None if nothing
    is gated; the velocities of the bodies' frames [m/s, rad/s] are given if motion is wanted. All in world axes.
    """
    velocities = () if linvel is None or angvel is None else (linvel, angvel)
    fields = (quat, pos, *velocities)
    parts = _related(*(field.index_select(1, bodies) for bodies in (link, target) for field in fields))
    is_moving = len(parts) > 12
    parts += [] if gate is None else [gate + 0.0 * parts[9]]  # depends on the same numbers, so one kernel forms it too
    # Stack, to materialise them once per pair: fusion would recompute them for every taxel.
    parts = torch.stack(parts, dim=1).to(dtype).unbind(1)
    motion = Motion(planes.vec(parts[12:15]), planes.vec(parts[15:18]), planes.vec(parts[18:21])) if is_moving else None
    return Pairs(planes.rot(parts[:9]), planes.vec(parts[9:12]), motion, None if gate is None else parts[-1])


def _related(*fields: Plane) -> list[Plane]:
    """Return the planes of `relate` without the gate: rotation, offset and, if there are velocities, motion."""
    half = len(fields) // 2
    (link_quat, link_pos, *link_motion), (quat, pos, *motion) = fields[:half], fields[half:]
    link_rotation, rotation = planes.rotation(link_quat), planes.rotation(quat)
    apart = planes.sub(planes.split(link_pos), planes.split(pos))
    parts = [*planes.transpose_times(rotation, link_rotation), *planes.rotate_back(rotation, apart)]
    if motion:
        (link_linear, turn), (linear, spin) = map(planes.split, link_motion), map(planes.split, motion)
        slide = planes.sub(linear, link_linear)
        for vector in (planes.add(slide, planes.cross(spin, apart)), planes.sub(spin, turn), turn):
            parts += planes.rotate_back(link_rotation, vector)
    return parts


def gathered(vector: Vec, own: slice, pair: Tensor) -> Vec:
    """Return a vector (env, pair) for each probe, given an object's pairs and the pair of each probe."""
    return planes.vec(at_probes(part, own, pair) for part in vector)


def at_probes(part: Float[Tensor, "env pairs"], own: slice, pair: Int[Tensor, " taxel"]) -> Float[Tensor, "env taxel"]:
    """Return a plane of the pairs for each probe; where an object has one pair alone, nothing is looked up."""
    part = part if own == slice(None) else part[:, own]
    return part.expand(-1, pair.shape[0]) if part.shape[1] == 1 else part.index_select(1, pair)  # on a CPU 5 × part[:, pair]


def gates(found: Tensor, place: Int[Tensor, " pair"], dtype: torch.dtype) -> Float[Tensor, "env pair"]:
    """Return 0 where a pair is in contact by the state's `contact_found`, −∞ where it is not; not-a-number where that is."""
    column = found[:, place]
    if column.dtype == torch.bool:  # ONNX has no isnan of these
        return torch.where(column, 0.0, -torch.inf).to(dtype)
    return torch.where(column > 0, 0.0, torch.where(column.isnan(), torch.nan, -torch.inf)).to(dtype)
