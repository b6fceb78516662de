"""Contact depth: how deep each probe is in which object, which way is out, how that moves; and how far each surface is.

Shapes: `env` environments, `taxel` probes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request
from tgdsl.quantities.geoms.distance import Frame


class Distance(NamedTuple):
    """Signed distance of each probe to one object's surface [m], and its gradient in the link's frame: planes (env, taxel).

    The distance is infinite where the pair is out of question: an inactive probe, or a link and itself.
    """

    value: Tensor
    gradient: Vec


class Penetration(NamedTuple):
    """What probes meet, at the geom that each is deepest in; planes of shape (env, taxel), in the link's frame.

    Attributes:
        pos: Where the probes are [m], planes (taxel,).
        depth: Penetration depth max(0, radius − distance) [m].
        normal: Unit normal out of the object; zero where the depth is zero. None if not asked for.
        velocity: Velocity of the object's material at the probe relative to the probe [m/s]; None if not asked for.
        angular: Angular velocity of the object relative to the link [rad/s]; None if not asked for.
        distances: Distance to each object, by its name; empty if not asked for.
        frames: How each object sees the link, by its name; empty if not asked for.
    """

    pos: Vec
    depth: Tensor
    normal: Vec | None
    velocity: Vec | None
    angular: Vec | None
    distances: dict[str, Distance]
    frames: dict[str, Frame]


@dataclass(frozen=True, eq=False)
class ContactDepth(Request[Penetration]):
    """Asks how deep probes are in objects: the deepest object wins, the first among equals.

    Attributes:
        radius: How far from each taxel objects are felt [m], (taxel,); None: the probes' own. Inactive probes feel nothing.
        range: Distance from an object's surface up to which it is needed [m], if more than the radius.
        normal: Whether the normal is asked for.
        motion: Whether the velocities are.
        distance: Whether the distances to all objects are.
        frame: Whether the frames are.
    """

    radius: Float[np.ndarray, " taxel"] | None = None
    range: float = 0.0
    normal: bool = False
    motion: bool = False
    distance: bool = False
    frame: bool = False
    is_within_radii: ClassVar[bool] = True

    @property
    def wants(self) -> tuple[str, ...]:
        """What is asked for beside the depth."""
        return tuple(name for name in ("distance", "frame", "motion", "normal") if getattr(self, name))

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same probes have in common if they are one: objects, gate and radii."""
        return type(self), self.objects, self.is_gated, None if self.radius is None else self.radius.tobytes()

    def merged(self, other: Request) -> ContactDepth:
        """Return a request for what both ask for."""
        assert isinstance(other, ContactDepth)
        wants = dict.fromkeys((*self.wants, *other.wants), True)
        return dataclasses.replace(self, range=max(self.range, other.range), **wants)

    def join_key(self) -> tuple[Any, ...]:
        """Return what requests at different probes have in common if they can be joined: all but radii and range."""
        return type(self), self.objects, self.is_gated, self.wants, self.radius is None

    def joined(self, others: Sequence[Request]) -> ContactDepth:
        """Return one request for several sensors' probes, each with its own radii."""
        every = [self, *(other for other in others if isinstance(other, ContactDepth))]
        radii = [own.radius for own in every if own.radius is not None]
        radius = np.concatenate(radii) if radii else None
        return dataclasses.replace(self, radius=radius, range=max(own.range for own in every))

    def wants_distance(self, radius: Float[np.ndarray, " taxel"]) -> bool:
        """Return whether distances are measured for it: not where no probe reaches anywhere, unless they are asked for."""
        return self.distance or bool((self.reach(radius) > -np.inf).any())

    def reach(self, radius: Float[np.ndarray, " taxel"]) -> Float[np.ndarray, " taxel"]:
        """Return how far from each taxel objects are felt [m], for probes of these radii; −∞ for inactive ones."""
        return np.where(radius > 0, radius if self.radius is None else self.radius, -np.inf)
