"""Signed distance sampled on a regular grid, interpolated between the nodes, and its unit gradient.

A point outside the grid reads the value at the nearest point of the grid's box plus the way there. By the triangle
inequality that is never less than the true distance, nor less than the way to the box: far points read far. A point that is
not a number reads NaN and has a fixed gradient; one at infinity counts as `far` away from the box along that axis.

Shapes: `node` nodes of all grids; `x`, `y`, `z` nodes of one along the axes, two or more each; `*point` broadcasts with points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry.planes import Vec, length_and_direction, split, tie, vec

Count = int | Int[Tensor, "*point"]
Pair = tuple[Tensor, Tensor]
Nodes = tuple[Pair, Pair] | tuple[Pair, Pair, Pair, Pair]
"""Weight of each node along an axis, and the weight's derivative. Tuples of known length: checks of lists do not compile."""
Weights = Callable[[Tensor], Nodes]


class Grid(NamedTuple):
    """Signed distance at the nodes of one or several grids, negative inside; each point is looked up in one grid.

    Counts that are the same for all points may be Python's: a compiler then makes them part of the code.
    """

    values: Float[Tensor, " node"]  # signed distance at the nodes [m], grid after grid, z running fastest
    first: Count  # index of a point's grid's node (0, 0, 0)
    num: tuple[Count, Count, Count]  # number of its nodes along each axis
    origin: Vec  # place of its node (0, 0, 0) in the geom's frame [m]
    cell: Float[Tensor, "*point"]  # spacing of its nodes [m], alike along all axes


def one_grid(values: Float[Tensor, "x y z"], origin: Float[Tensor, " 3"], cell: Float[Tensor, ""]) -> Grid:
    """Return one grid, from its values at the nodes [m], the place of node (0, 0, 0) [m] and the spacing [m]."""
    x, y, z = values.shape
    return Grid(values.reshape(-1), 0, (x, y, z), split(origin), cell)


def trilinear(point: Vec, grid: Grid) -> tuple[Tensor, Vec]:
    """Return distance [m] and unit gradient from the eight nodes around a point (geom's frame [m]).

    The distance is continuous, its gradient jumps at the faces of the cells. Error O(cell²) where the field is smooth.
    """
    return _interpolate(point, grid, _linear_weights, first=0)


def tricubic(point: Vec, grid: Grid) -> tuple[Tensor, Vec]:
    """Return distance [m] and unit gradient from the 64 nodes around a point (geom's frame [m]).

    Cubic convolution with a = −1/2, the Catmull-Rom spline along each axis (Keys, *Cubic convolution interpolation for
    digital image processing*, IEEE Trans. ASSP 29, 1981, equation 15). The distance has a continuous gradient; its error is
    O(cell³) where the field is smooth. Beyond the border the outermost nodes repeat, so the outermost layer of cells is
    less precise: grids carry one cell more than their points need.
    """
    return _interpolate(point, grid, _cubic_weights, first=-1)


METHODS = {"trilinear": trilinear, "tricubic": tricubic}  # how a grid is interpolated, by the name that a Plan gives it


def _linear_weights(t: Tensor) -> Nodes:
    one = torch.ones_like(t)
    return (1 - t, -one), (t, one)


def _cubic_weights(t: Tensor) -> Nodes:
    """Return weight and its derivative for nodes −1, 0, 1 and 2, at 0 ≤ t ≤ 1 between nodes 0 and 1."""
    return (
        (0.5 * t * (t * (2 - t) - 1), 0.5 * (t * (4 - 3 * t) - 1)),
        (0.5 * (t * t * (3 * t - 5) + 2), 0.5 * t * (9 * t - 10)),
        (0.5 * t * (t * (4 - 3 * t) + 1), 0.5 * (t * (8 - 9 * t) + 1)),
        (0.5 * t * t * (t - 1), 0.5 * t * (3 * t - 2)),
    )


def _interpolate(point: Vec, grid: Grid, weights: Weights, first: int) -> tuple[Tensor, Vec]:
    """Interpolate between the nodes `first`, `first` + 1, … counted from the cell's lower corner."""
    place = [(part - start) / grid.cell for part, start in zip(point, grid.origin, strict=True)]
    inside = [within(part, num - 1) for part, num in zip(place, grid.num, strict=True)]
    # A point within `tie` of the next cell counts as in it, so a point at rest on a face of cells keeps its gradient.
    # NaN becomes an arbitrary integer; the clamp after the conversion makes it a valid index.
    slack = tie() / grid.cell
    lower = vec(within((part + slack).floor().long(), num - 2) for part, num in zip(inside, grid.num, strict=True))
    along_x, along_y, along_z = (weights(part - corner) for part, corner in zip(inside, lower, strict=True))
    value, *slopes = _sum_over_nodes(grid, lower, (along_x, along_y, along_z), first)
    way, direction = length_and_direction(
        vec(((part - near) * grid.cell).clamp(-far(), far()) for part, near in zip(place, inside, strict=True))
    )
    is_far = way > 0
    gradient = (
        torch.where(part == near, slope / grid.cell, 0.0) + torch.where(is_far, out, 0.0)
        for part, near, slope, out in zip(place, inside, slopes, direction, strict=True)
    )
    distance = value + way
    _, gradient = length_and_direction(vec(torch.where(distance.isnan(), 0.0, part) for part in gradient))
    return distance, gradient


def far() -> float:
    """Return how far [m] a point counts as outside along an axis at most: the square of that is still a float32."""
    return 1e15


def within(place: Tensor, last: Count) -> Tensor:
    """Clamp a coordinate or an index along an axis to the range from 0 to the last; NaN stays NaN."""
    return place.clamp(0, last) if isinstance(last, int) else torch.minimum(place.clamp(min=0), last.to(place.dtype))


def _sum_over_nodes(
    grid: Grid, lower: Vec, along: tuple[Nodes, Nodes, Nodes], first: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the weighted sum [m] and its derivatives along the axes [m per cell], one axis after the other."""
    _, num_y, num_z = grid.num
    strides = (num_y * num_z, num_z, 1)
    index = [
        [within(corner + first + k, num - 1) * stride for k in range(len(nodes))]
        for corner, nodes, num, stride in zip(lower, along, grid.num, strides, strict=True)
    ]
    index[0] = [ix + grid.first for ix in index[0]]
    total = [torch.zeros_like(along[0][0][0]) for _ in range(4)]
    for (wx, dx), ix in zip(along[0], index[0], strict=True):
        sheet = [torch.zeros_like(wx) for _ in range(3)]
        for (wy, dy), iy in zip(along[1], index[1], strict=True):
            row = [grid.values[ix + iy + iz] for iz in index[2]]
            line = sum(wz * value for (wz, _), value in zip(along[2], row, strict=True))
            slope = sum(dz * value for (_, dz), value in zip(along[2], row, strict=True))
            sheet = [sheet[0] + wy * line, sheet[1] + dy * line, sheet[2] + wy * slope]
        total = [total[0] + wx * sheet[0], total[1] + dx * sheet[0], total[2] + wx * sheet[1], total[3] + wx * sheet[2]]
    return total[0], total[1], total[2], total[3]
