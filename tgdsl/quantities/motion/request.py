"""Motion of links: where each is and how it moves, in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from tgdsl.geometry.planes import Rot, Vec
from tgdsl.quantities.base import Request


class BodyMotion(NamedTuple):
    """Poses and velocities of the bodies of a sensor's links, in order; planes (env, body).

    Attributes:
        rotation: Rotates body vectors into the world.
        pos: Position of each body's frame [m].
        linvel: Velocity of the frame's origin, in world axes [m/s].
        angvel: Angular velocity, in world axes [rad/s].
    """

    rotation: Rot
    pos: Vec
    linvel: Vec
    angvel: Vec


@dataclass(frozen=True, eq=False)
class LinkMotion(Request[BodyMotion]):
    """Asks where the bodies of a sensor's links are and how they move."""
