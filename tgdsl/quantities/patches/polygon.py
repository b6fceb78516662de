"""The area of the polygon of some points about the origin."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec

MOST_SWAPPED = 8
"""Points up to which they are sorted by swapping neighbours, which compiles to one kernel."""
Point = tuple[Tensor, Tensor, Tensor]
"""How far around it is, and its two coordinates."""


def polygon_area(away: Sequence[Vec], normal: Vec, is_used: Sequence[Tensor]) -> Float[Tensor, "env body object"]:
    """Return the area of the polygon of some points, in the order of their angles about the origin [m²].

    Of points in one direction the next by number follows.

    Args:
        away: The points, planes each [m].
        normal: Unit normal of the plane that they are projected to, planes.
        is_used: Which of the points count.
    """
    if len(away) < 3:
        return torch.zeros_like(normal[0])
    one, other = _tangents(normal)
    points = []
    for point, used in zip(away, is_used, strict=True):
        x, y = (torch.where(used, planes.dot(point, along), 0.0) for along in (one, other))
        points.append((torch.where(used, _around(x.detach(), y.detach()), 8.0), x, y))
    points = _sorted(points)
    # Those that do not count come last; they are put where the first one is.
    _, first_x, first_y = points[0]
    xs = [torch.where(place < 6.0, x, first_x) for place, x, _ in points]
    ys = [torch.where(place < 6.0, y, first_y) for place, _, y in points]
    crossed = [xs[i - 1] * ys[i] - ys[i - 1] * xs[i] for i in range(len(points))]
    return 0.5 * sum(crossed[1:], start=crossed[0]).clamp(min=0)


def _sorted(points: list[Point]) -> list[Point]:
    """Return the points by how far around they are; those that are alike stay in order."""
    if len(points) > MOST_SWAPPED:
        place, x, y = (torch.stack(part, dim=-1) for part in zip(*points, strict=True))
        place, order = torch.sort(place, dim=-1, stable=True)
        parts = (place, x.gather(-1, order), y.gather(-1, order))
        return list(zip(*(part.unbind(-1) for part in parts), strict=True))
    points = list(points)
    for end in range(len(points) - 1, 0, -1):
        for i in range(end):
            low, high = points[i], points[i + 1]
            is_wrong = high[0] < low[0]
            points[i] = planes.where(is_wrong, high, low)
            points[i + 1] = planes.where(is_wrong, low, high)
    return points


def _around(x: Tensor, y: Tensor) -> Tensor:
    """Return how far around each point is, from 0 to 4: a number that grows with its angle."""
    size = x.abs() + y.abs()
    along = x / torch.where(size > 0, size, 1.0)
    return torch.where(y >= 0, 1.0 - along, 3.0 + along)


def _tangents(normal: Vec) -> tuple[Vec, Vec]:
    """Return two directions across a normal (Duff et al., JCGT 6(1), 2017)."""
    nx, ny, nz = normal
    sign = torch.where(nz >= 0, 1.0, -1.0)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (1.0 + sign * nx * nx * a, sign * b, -sign * nx), (b, sign + ny * ny * a, -ny)
