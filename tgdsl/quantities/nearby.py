"""Surfaces near each probe: the moments of every object's surface, in the link's frame.

Shapes: `env` environments, `taxel` probes, `case` 1, or `env` if the object differs between environments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.quantities.base import Request
from tgdsl.quantities.moment_sums import MomentField, Moments, PointCloud, cloud_moments, field_moments, plane_moments
from tgdsl.quantities.pairs import Motion, PairedObject, Pairs, gathered
from tgdsl.tensors.operations import Operation


class SurfaceMoments(NamedTuple):
    """Moments of surfaces near each probe, in its link's frame; planes (env, taxel)."""

    pos: Vec  # where the probes are [m], planes (taxel,)
    none: Tensor  # zero at each probe
    moments: dict[str, Moments]  # moments of each object's surface about each probe, by the object's name
    motions: dict[str, Motion]  # motion of each object relative to the link; empty if not asked for
    area: dict[str, Tensor]  # area of each object's outer surface, planes left out [m²], (case, 1)


@dataclass(frozen=True, eq=False)
class MomentsRequest(Request[SurfaceMoments]):
    """Asks for moments of objects' surfaces around probes. They are never gated."""

    radius: float | None = None  # sensing radius of all active probes [m]; None: that of each in the layout
    # "field": from a baked field; "points": by a sum over sampled points. Planes are exact in both.
    backend: Literal["field", "points"] = "field"
    num_points: int = 5000  # points of each object
    tolerance: float = 0.005  # root mean square error of a field as a fraction of full scale
    # error that 99.9 % of S0's gradients by place may have, as a fraction of the largest; None: any
    gradient_tolerance: float | None = None
    max_bytes: int = 64 * 2**20  # largest size of all fields of an object, or of its lists of points [bytes]
    with_area: bool = False  # whether the area of the felt objects is wanted, so that there must be one
    motion: bool = False  # whether the objects' motions are asked for
    is_within_radii: ClassVar[bool] = True

    def merged(self, other: Request) -> MomentsRequest:
        """Return a request for what both ask for: they are alike."""
        return self


class Plane(NamedTuple):
    """A plane in its object's frame: rotates plane vectors, whose z is its normal, into it; its origin [m]."""

    rotation: Rot
    pos: Vec


class MomentSource(NamedTuple):
    """One object, and the source of its moments."""

    target: PairedObject  # the object
    pair: Int[Tensor, " taxel"]  # index of each probe's pair among its own
    # sensing radius of each probe towards it [m], (taxel,) or (env, taxel); 0 where the probe is inactive or is on the object
    # itself
    radius: Float[Tensor, "*env taxel"]
    # by how much that is more than the radius that a field is of [m], (env, taxel); None: nothing
    shift: Float[Tensor, "env taxel"] | None
    surface: MomentField | PointCloud | None  # its outer surface without planes; None if it has planes alone
    planes: tuple[Plane, ...]  # its planes
    area: Float[Tensor, "case 1"]  # area of its outer surface, planes left out [m²]


def surface_moments(pairs: Pairs, pos: Vec, sources: Sequence[MomentSource]) -> SurfaceMoments:
    """Return the moments of objects about probes, their motions if pairs have them, and their areas.

    `pos` is where the probes are in their links' frames [m].
    """
    result: dict[str, Moments] = {}
    motions: dict[str, Motion] = {}
    for source in sources:
        name, object_pairs = source.target.name, source.target.pairs
        result[name] = FELT_MOMENTS(pairs, object_pairs, pos, source)
        if pairs.motion is not None:
            linear, angular, turn = (gathered(part, object_pairs, source.pair) for part in pairs.motion)
            motions[name] = Motion(linear, angular, turn)
    none = pairs.offset[0].new_zeros((pairs.offset[0].shape[0], pos[0].shape[0]))
    return SurfaceMoments(pos, none, result, motions, {source.target.name: source.area for source in sources})


def felt_moments(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> Moments:
    """Return the moments of an object at the probes, in their links' frames."""
    rotation = planes.rot(part[:, own][:, source.pair] for part in pairs.rotation)
    point = planes.add(planes.rotate(rotation, pos), gathered(pairs.offset, own, source.pair))
    moments = _moments(point, source)
    return Moments(moments.mass, planes.rotate_back(rotation, moments.first))


def _moments(point: Vec, source: MomentSource) -> Moments:
    """Return the moments of an object at points in its frame."""
    parts = []
    if isinstance(source.surface, MomentField):
        near = field_moments(point, source.surface, source.shift)
        if source.shift is not None:  # to first order S0 becomes negative near the edge of the sensing ball
            near = near._replace(mass=torch.clamp(near.mass, min=0))
        # The field knows no radius: an inactive probe asks one that is not its own.
        is_active = source.radius > 0
        none = torch.zeros_like(near.mass)
        parts.append(Moments(torch.where(is_active, near.mass, 0.0), planes.where(is_active, near.first, (none, none, none))))
    elif source.surface is not None:
        parts.append(cloud_moments(point, source.surface, source.radius))
    for plane in source.planes:
        local = planes.rotate_back(plane.rotation, planes.sub(point, plane.pos))
        near = plane_moments(local, source.radius)
        parts.append(Moments(near.mass, planes.rotate(plane.rotation, near.first)))
    mass, first = parts[0]
    for part in parts[1:]:
        mass, first = mass + part.mass, planes.add(first, part.first)
    return Moments(mass, first)


def _by_kernel(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> Moments:
    from tgdsl.quantities import nearby_kernel

    assert isinstance(source.surface, MomentField)
    return nearby_kernel.felt_moments(pairs, own, pos, source.pair, source.radius, source.shift, source.surface)


def _inputs(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> list[Tensor]:
    shift = [] if source.shift is None else [source.shift]
    return [source.radius, *pos, *pairs.rotation, *pairs.offset, *shift]


def _is_one_field(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> bool:
    return isinstance(source.surface, MomentField) and not source.surface.is_smooth and not source.planes


FELT_MOMENTS = Operation("felt_moments", felt_moments, _by_kernel, _inputs, _is_one_field)
