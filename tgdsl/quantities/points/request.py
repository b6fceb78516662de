"""Points: sampled on each object's outer surface, and measured against the links' own surfaces.

The value is, by object, where each link that may meet it sees its points: see `points.ObjectPoints`.
"""

from __future__ import annotations

from dataclasses import dataclass

from tgdsl.quantities.base import Request
from tgdsl.quantities.points.points import ObjectPoints


@dataclass(frozen=True, eq=False)
class Points(Request[dict[str, ObjectPoints]]):
    """Asks for points of objects. Where a gate is closed they are nowhere: their distance is +∞.

    Attributes:
        num_points: Points of each object.
        range: Distance from a link's surface up to which it is needed [m].
    """

    num_points: int = 5000
    range: float = 0.0
