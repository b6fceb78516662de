"""How much of a surface is near a point, and where: the moments of the sensing ball's weight over the surface.

For a point q with sensing radius R and a surface Σ, with weight w(p) = max(0, R − |p − q|) [m]:

    S0 = ∫_Σ w dA [m³]        S1 = ∫_Σ w (p − q) dA [m⁴]

For a rigid object both are functions of q in its frame. Three ways to have them: interpolated from a field that was computed
beforehand, summed over sampled points of the surface, and in closed form for a plane.

Shapes: `node` nodes of all fields; `channel` S0, S1 and, if they are there, their derivatives with respect to R; `row` points
of all clouds; `bin` cubes of all lattices; `slot` places of a list; `*point` broadcasts with points.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.grid import Count, within
from tgdsl.geometry.planes import Vec, vec

Pair = tuple[Tensor, Tensor]
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

    Args:
        point: Points in the object's frame [m].
        field: The field.
        radius_shift: By how much the radius is larger than the field's [m], to first order; the field then has 8 channels.
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
    x, y, z = (_quadratic(part - corner) for part, corner in zip(nodes, lower, strict=True))
    return base, (x, y, z)


def _quadratic(t: Tensor) -> Vec:
    rest = 1 - t
    return 0.5 * rest * rest, 0.5 + t * rest, 0.5 * t * t


def plane_moments(point: Vec, radius: Tensor) -> Moments:
    """Return the exact moments of the plane z = 0.

    With d = |z| < R: S0 = 2π ∫_d^R (R − r) r dr = π/3 (R − d)² (R + 2d), S1 = −z S0 along z.

    Args:
        point: Points in the plane's frame [m].
        radius: Their sensing radius, 0 or more [m].
    """
    height = torch.maximum(torch.minimum(point[2], radius), -radius)
    depth = radius - height.abs()
    mass = planes.pi() / 3 * depth * depth * (radius + 2 * height.abs())
    zero = torch.zeros_like(mass)
    return Moments(mass, (zero, zero, -height * mass))


def cloud_moments(point: Vec, cloud: PointCloud, radius: Tensor) -> Moments:
    """Return the sums over the points of a cloud; zero outside its lattice, not-a-number for a point that is none.

    Args:
        point: Points in the object's frame [m].
        cloud: The cloud.
        radius: Their sensing radius, at most that of the lists [m].
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
