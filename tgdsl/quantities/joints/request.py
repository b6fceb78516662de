"""The request for the motion and load of joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request


class JointDrive(NamedTuple):
    """How a sensor's joints move and are driven, in the order of its layout's links; planes (env, joint).

    Attributes:
        velocity: Velocity ω [rad/s; slides: m/s].
        effort: What the actuators exert τ [N·m; slides: N].
        place: Where the joint's anchor is in the world [m], in the dtype of the state.
    """

    velocity: Float[Tensor, "env joint"]
    effort: Float[Tensor, "env joint"]
    place: Vec


@dataclass(frozen=True, eq=False)
class Joints(Request[JointDrive]):
    """Asks how the joints of a sensor that is on joints move and are driven, and where they are."""
