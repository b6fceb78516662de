"""How much of a surface is near a point, and where: the moments of the sensing ball's weight over the surface.

For a point q with sensing radius R and a surface Σ, with weight w(p) = max(0, R − |p − q|) [m]:

    S0 = ∫_Σ w dA [m³]        S1 = ∫_Σ w (p − q) dA [m⁴]

For a rigid object both are functions of q in its frame. Three ways to have them: interpolated from a field that was computed
beforehand, summed over sampled points of the surface, and in closed form for a plane.

Shapes: `node` nodes of all fields; `channel` S0, S1 and, if they are there, their derivatives with respect to R; `row` points
of all clouds; `bin` cubes of all lattices; `slot` places of a list; `*point` broadcasts with points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.grid import Count, within
from tgdsl.geometry.planes import Rot, Vec, vec
from tgdsl.quantities.base import Request
from tgdsl.quantities.pairs import Motion, PairedObject, Pairs, gathered
from tgdsl.tensors.operations import Operation

BLOCK = 16  # candidates of each point that are summed at once where nothing fuses the sum, so that memory stays bounded


class Moments(NamedTuple):
    """Moments of the sensing ball's weight over a surface."""

    mass: Tensor  # S0 [m³]
    first: Vec  # S1, about the point [m⁴]


class MomentField(NamedTuple):
    """Moments at the nodes of one lattice, or of several; each point names the one it asks.

    They vanish on the outermost nodes, so points outside read zero. Counts that are the same for all points may be Python's: a
    compiler then makes them part of the code.
    """

    # S0 and S1 [m³, m⁴], and their derivatives with respect to R if there are 8 channels; z running fastest
    values: Float[Tensor, "node channel"]
    first: Count  # index of a point's lattice's node (0, 0, 0)
    num: tuple[Count, Count, Count]  # number of its nodes along each axis
    origin: Vec  # place of its node (0, 0, 0) in the object's frame [m]
    cell: Float[Tensor, "*point"]  # spacing of its nodes [m], alike along all axes
    # whether the values are factors of quadratic B-splines about the nodes rather than the moments there: the gradient then has
    # no jumps
    is_smooth: bool = False


class PointCloud(NamedTuple):
    """Points sampled on a surface, and for each cube of a lattice the list of those within reach of any place in it.

    Of several clouds each point asks one. The last row is a point that is out of reach of everything: it fills the lists.
    """

    points: tuple[Float[Tensor, " row"], Float[Tensor, " row"], Float[Tensor, " row"]]  # coordinates in the object's frame [m]
    weight: Float[Tensor, "*point"]  # surface that each point of the cloud stands for [m²]
    lists: Int[Tensor, "bin slot"]  # rows of `points`
    first: Count  # index of a cloud's first cube
    num: tuple[Count, Count, Count]  # number of its cubes along each axis
    origin: Vec  # lower corner of its lattice in the object's frame [m]
    cell: Float[Tensor, "*point"]  # side of a cube [m]


def field_moments(point: Vec, field: MomentField, radius_shift: Tensor | None = None) -> Moments:
    """Return moments by trilinear interpolation or splines; zero outside the lattice, not-a-number for a point that is none.

    `point` is in the object's frame [m]; the radius is `radius_shift` [m] larger than the field's, which then has 8 channels.
    """
    if field.is_smooth:
        base, weights = _spline_weights(point, field)
    else:
        base, (x, y, z) = _cell_of(point, field.origin, field.cell, field.num, last=2)
        weights = ((1 - x, x), (1 - y, y), (1 - z, z))
    _, num_y, num_z = field.num
    total = [torch.zeros_like(weights[0][0])] * (4 if radius_shift is None else 8)
    for (i, wx), (j, wy), (k, wz) in product(*(list(enumerate(along)) for along in weights)):
        index = field.first + base + (i * num_y + j) * num_z + k
        weight = wx * wy * wz
        total = [part + weight * field.values[index, c] for c, part in enumerate(total)]
    if radius_shift is not None:
        total = [part + radius_shift * slope for part, slope in zip(total[:4], total[4:], strict=True)]
    return Moments(total[0], (total[1], total[2], total[3]))


def _spline_weights(point: Vec, field: MomentField) -> tuple[Tensor, tuple[Vec, Vec, Vec]]:
    """Return the index of the lowest of the nodes around points, and the weights of three along each axis."""
    axes = zip(point, field.origin, field.num, strict=True)
    nodes = [within((part - start) / field.cell - 0.5, count - 2) for part, start, count in axes]
    lower = [within(part.floor().long(), count - 3) for part, count in zip(nodes, field.num, strict=True)]
    base = (lower[0] * field.num[1] + lower[1]) * field.num[2] + lower[2]
    along = vec(part - corner for part, corner in zip(nodes, lower, strict=True))
    x, y, z = ((0.5 * (1 - t) * (1 - t), 0.5 + t * (1 - t), 0.5 * t * t) for t in along)
    return base, (x, y, z)


def plane_moments(point: Vec, radius: Tensor) -> Moments:
    """Return the exact moments of the plane z = 0 at points in its frame [m], of sensing radii of 0 or more [m].

    With d = |z| < R: S0 = 2π ∫_d^R (R − r) r dr = π/3 (R − d)² (R + 2d), S1 = −z S0 along z.
    """
    height = torch.maximum(torch.minimum(point[2], radius), -radius)
    depth = radius - height.abs()
    mass = planes.pi() / 3 * depth * depth * (radius + 2 * height.abs())
    zero = torch.zeros_like(mass)
    return Moments(mass, (zero, zero, -height * mass))


def cloud_moments(point: Vec, cloud: PointCloud, radius: Tensor) -> Moments:
    """Return the sums over the points of a cloud; zero outside its lattice, not-a-number for a point that is none.

    `point` is in the object's frame [m]; `radius` is at most the lists' radius [m].
    """
    base, rest = _cell_of(point, cloud.origin, cloud.cell, cloud.num, last=1)
    is_outside = (rest[0] < 0) | (rest[1] < 0) | (rest[2] < 0) | (rest[0] > 1) | (rest[1] > 1) | (rest[2] > 1)
    bins = cloud.first + base
    num_slots = cloud.lists.shape[1]
    total = [torch.zeros_like(rest[0])] * 4
    # A compiler fuses gather, weight and sum into one loop, whatever the length.
    step = num_slots if torch.compiler.is_compiling() else BLOCK
    for start in range(0, num_slots, step):
        rows = cloud.lists[bins, start : start + step]
        way = vec(part[rows] - center[..., None] for part, center in zip(cloud.points, point, strict=True))
        weight = torch.relu(radius[..., None] - planes.safe_sqrt(planes.dot(way, way)))
        parts = (weight, weight * way[0], weight * way[1], weight * way[2])
        total = [part + more.sum(dim=-1) for part, more in zip(total, parts, strict=True)]
    mass, *first = (torch.where(is_outside, 0.0, cloud.weight * part) for part in total)
    return Moments(mass, vec(first))


def _cell_of(point: Vec, origin: Vec, cell: Tensor, num: tuple[Count, Count, Count], last: int) -> tuple[Tensor, Vec]:
    """Return the index of each point's cell in its lattice, and the place in it, from 0 to 1 within the lattice."""
    place = [(part - start) / cell for part, start in zip(point, origin, strict=True)]
    if last == 2:
        place = [within(part, count - 1) for part, count in zip(place, num, strict=True)]
    # NaN becomes an arbitrary integer: only the integer's own clamp makes it an index.
    lower = [within(part.floor().long(), count - last) for part, count in zip(place, num, strict=True)]
    base = (lower[0] * num[1] + lower[1]) * num[2] + lower[2]
    return base, vec(part - corner for part, corner in zip(place, lower, strict=True))


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

    radius: float | None = None  # sensing radius of all active probes [m]; None: each probe's radius in the layout
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


class Plane(NamedTuple):
    """A plane in its object's frame: rotates plane vectors, whose z is its normal, into it; its origin [m]."""

    rotation: Rot
    pos: Vec


class MomentSource(NamedTuple):
    """One object, and the source of its moments."""

    target: PairedObject
    pair: Int[Tensor, " taxel"]  # index of each probe's pair among its own
    # sensing radius of each probe towards it [m], (taxel,) or (env, taxel); 0 where the probe is inactive or is on the object
    # itself
    radius: Float[Tensor, "*env taxel"]
    # by how much that is more than the radius that a field is of [m], (env, taxel); None: nothing
    shift: Float[Tensor, "env taxel"] | None
    surface: MomentField | PointCloud | None  # its outer surface without planes; None if it has planes alone
    planes: tuple[Plane, ...]
    area: Float[Tensor, "case 1"]  # area of its outer surface, planes left out [m²]


def felt_moments(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> Moments:
    """Return the moments of an object at the probes, in their links' frames; `pos` is where these are there [m]."""
    rotation = planes.rot(part[:, own][:, source.pair] for part in pairs.rotation)
    point = planes.add(planes.rotate(rotation, pos), gathered(pairs.offset, own, source.pair))
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
        near = plane_moments(planes.rotate_back(plane.rotation, planes.sub(point, plane.pos)), source.radius)
        parts.append(Moments(near.mass, planes.rotate(plane.rotation, near.first)))
    mass, first = parts[0]
    for part in parts[1:]:
        mass, first = mass + part.mass, planes.add(first, part.first)
    return Moments(mass, planes.rotate_back(rotation, first))


def _by_kernel(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> Moments:
    from tgdsl.quantities import nearby_kernel

    assert isinstance(source.surface, MomentField)
    mass, *first = nearby_kernel.felt_moments(pairs, own, pos, source, source.surface)
    return Moments(mass, vec(first))


def _inputs(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> list[Tensor]:
    shift = [] if source.shift is None else [source.shift]
    return [source.radius, *pos, *pairs.rotation, *pairs.offset, *shift]


def _is_one_field(pairs: Pairs, own: slice, pos: Vec, source: MomentSource) -> bool:
    return isinstance(source.surface, MomentField) and not source.surface.is_smooth and not source.planes


FELT_MOMENTS = Operation("felt_moments", felt_moments, _by_kernel, _inputs, _is_one_field)
