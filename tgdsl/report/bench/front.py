"""The Pareto front of points that are known to within intervals."""

from __future__ import annotations

from collections.abc import Sequence

from tgdsl.module.accuracy.errors import Interval

Point = tuple[Interval, ...]
"""What is to be small: a time, an error."""


def dominates(one: Point, other: Point) -> bool:
    """Whether a point is better in something, and worse in nothing; where intervals overlap two points are equal."""
    apart = [(a, b) for a, b in zip(one, other, strict=True) if not a.overlaps(b)]
    return bool(apart) and all(a.value < b.value for a, b in apart)


def front_of(points: Sequence[Point]) -> list[bool]:
    """Return which points no other point dominates."""
    return [not any(dominates(other, own) for other in points if other is not own) for own in points]
