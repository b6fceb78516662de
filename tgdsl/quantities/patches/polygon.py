"""The area that contact points span: of their convex hull, or of the paper's polygon."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec

MOST_SWAPPED = 8
"""Points up to which they are sorted by swapping neighbours, which compiles to one kernel."""
Point = tuple[Tensor, Tensor, Tensor]
"""Angle, as a number that grows with it, and two coordinates [m]."""


def patch_area(away: Sequence[Vec], normal: Vec, is_used: Sequence[Tensor], is_star: bool) -> Float[Tensor, "env body object"]:
    """Return the area of the convex hull of points, projected along a normal [m²].

    The points are sorted by angle about the origin, from the one that is farthest along an axis. Of all closed polygons through
    that point which skip any of the others, the hull is the largest: with A_k twice the area swept on the way to point k,

        A_k = max over j < k of A_j + x_j y_k − y_j x_k,    area = ½ max over k of A_k + x_k y_0 − y_k x_0.

    Args:
        away: The points about a centre that lies within their hull, planes each [m].
        normal: Unit normal of the plane that they are projected to, planes.
        is_used: Which of the points count.
        is_star: Take the polygon through all points in the order of their angles instead, which the paper has. It is smaller
            wherever a point lies inside the hull.
    """
    if len(away) < 3:
        return torch.zeros_like(normal[0])
    one, other = _tangents(normal)
    flat = [
        (torch.where(used, planes.dot(point, one), 0.0), torch.where(used, planes.dot(point, other), 0.0))
        for point, used in zip(away, is_used, strict=True)
    ]
    points = _sorted(_with_angles(flat, is_used))
    (_, x0, y0), *rest = points
    swept = [torch.zeros_like(x0)]
    for k, (_, x, y) in enumerate(rest, start=1):
        before = range(k - 1, k) if is_star else range(k)
        swept.append(reduce(torch.maximum, [swept[j] + points[j][1] * y - points[j][2] * x for j in before]))
    closed = [total + x * y0 - y * x0 for total, (_, x, y) in zip(swept, points, strict=True)]
    return 0.5 * (closed[-1] if is_star else reduce(torch.maximum, closed)).clamp(min=0)


def _with_angles(flat: Sequence[tuple[Tensor, Tensor]], is_used: Sequence[Tensor]) -> list[Point]:
    """Return points with their angles from the one of largest x; those that do not count come last, at that one's place."""
    start_x, start_y = torch.full_like(flat[0][0], -torch.inf), torch.zeros_like(flat[0][0])
    for (x, y), used in zip(flat, is_used, strict=True):
        is_farther = used & (x > start_x)
        start_x, start_y = torch.where(is_farther, x, start_x), torch.where(is_farther, y, start_y)
    start_x = torch.where(start_x == -torch.inf, 0.0, start_x)
    start = _angle(start_x.detach(), start_y.detach())
    points = []
    for (x, y), used in zip(flat, is_used, strict=True):
        angle = _angle(x.detach(), y.detach()) - start
        angle = torch.where((x == start_x) & (y == start_y), -1.0, torch.where(angle < 0, angle + 4.0, angle))
        points.append((torch.where(used, angle, 8.0), torch.where(used, x, start_x), torch.where(used, y, start_y)))
    return points


def _sorted(points: list[Point]) -> list[Point]:
    """Return the points by angle; equal ones stay in order."""
    if len(points) > MOST_SWAPPED:
        angle, x, y = (torch.stack(part, dim=-1) for part in zip(*points, strict=True))
        angle, order = torch.sort(angle, dim=-1, stable=True)
        parts = (angle, x.gather(-1, order), y.gather(-1, order))
        return list(zip(*(part.unbind(-1) for part in parts), strict=True))
    points = list(points)
    for end in range(len(points) - 1, 0, -1):
        for i in range(end):
            low, high = points[i], points[i + 1]
            is_wrong = high[0] < low[0]
            points[i] = planes.where(is_wrong, high, low)
            points[i + 1] = planes.where(is_wrong, low, high)
    return points


def _angle(x: Tensor, y: Tensor) -> Tensor:
    """Return a number from 0 to 4 that grows with a point's angle."""
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
