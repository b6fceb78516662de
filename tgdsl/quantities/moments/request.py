"""Moments: how much of each object's outer surface is within a probe's radius, and where.

Shapes: `env` environments, `taxel` probes, `case` 1, or `env` if the object differs between environments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

from torch import Tensor

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request
from tgdsl.quantities.moments.moments import Moments
from tgdsl.quantities.pairs import Motion


class SurfaceMoments(NamedTuple):
    """What is near each probe, in its link's frame; planes (env, taxel).

    Attributes:
        pos: Where the probes are [m], planes (taxel,).
        none: Zero at each probe.
        moments: Moments of each object's surface about each probe, by the object's name.
        motions: Motion of each object relative to the link; empty if not asked for.
        area: Area of each object's outer surface, planes left out [m²], (case, 1).
    """

    pos: Vec
    none: Tensor
    moments: dict[str, Moments]
    motions: dict[str, Motion]
    area: dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class MomentsRequest(Request[SurfaceMoments]):
    """Asks for moments of objects' surfaces, within the probes' own radii. They are never gated.

    Attributes:
        backend: "field": from a baked field; "points": by a sum over sampled points. Planes are exact in both.
        num_points: Points of each object.
        tolerance: Root mean square error of a field as a fraction of full scale.
        gradient_tolerance: Error that 99.9 % of S0's gradients by place may have, as a fraction of the largest; None: any.
        max_bytes: Largest size of all fields of an object, or of its lists of points [bytes].
        with_area: Whether the area of the felt objects is wanted, so that there must be one.
        motion: Whether the objects' motions are asked for.
    """

    backend: Literal["field", "points"] = "field"
    num_points: int = 5000
    tolerance: float = 0.005
    gradient_tolerance: float | None = None
    max_bytes: int = 64 * 2**20
    with_area: bool = False
    motion: bool = False
    is_within_radii: ClassVar[bool] = True

    def merged(self, other: Request) -> MomentsRequest:
        """Return a request for what both ask for: they are alike."""
        return self
