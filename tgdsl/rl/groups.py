"""Groups of observations that tasks share.

Source: Chung et al., *Tactile Genesis*, appendix, "Observation groups".

Shapes: `env` environments, `feature` numbers of a group.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.rl.rotations import six_numbers
from tgdsl.rl.task import HandNow, Now


class MeasuredVelocity:
    """Joint velocities as an XHand1's driver has them: `tgdsl.runtime.xhand1.source.VelocityFilter`, of all environments.

    Attributes:
        value: The velocities after the last positions [rad/s].
    """

    def __init__(self, joint_pos: Float[Tensor, "env joint"], control_step: float, time_constant: float = 0.02):
        self._before, self.value = joint_pos.clone(), torch.zeros_like(joint_pos)
        self._control_step = control_step
        self._share = -math.expm1(-control_step / time_constant)

    def update(self, joint_pos: Float[Tensor, "env joint"]) -> None:
        """Take the positions of the next control step [rad]."""
        self.value += self._share * ((joint_pos - self._before) / self._control_step - self.value)
        self._before.copy_(joint_pos)

    def begin(self, chosen: Bool[Tensor, " env"], joint_pos: Float[Tensor, "env joint"]) -> None:
        """Begin again at rest in some environments."""
        self.value.masked_fill_(chosen[:, None], 0.0)
        self._before.copy_(torch.where(chosen[:, None], joint_pos, self._before))

    def memory(self) -> dict[str, Tensor]:
        return {"before": self._before, "value": self.value}


def proprio(now: Now | HandNow, joint_vel: Float[Tensor, "env joint"] | None = None) -> Float[Tensor, "env feature"]:
    """Return positions [rad], velocities [rad/s] and last action of the joints that the policy moves.

    Args:
        now: The instant.
        joint_vel: Velocities in place of the instant's [rad/s].
    """
    return torch.cat([now.joint_pos, now.joint_vel if joint_vel is None else joint_vel, now.action], dim=1)


def priv_proprio(now: Now, own: Float[Tensor, "env shared"]) -> Float[Tensor, "env feature"]:
    """Return `proprio`, which is `own` and exact, and the object's force on each link, in its frame [N], link by link."""
    return torch.cat([own, now.link_force.flatten(1)], dim=1)


def object_state(now: Now) -> Float[Tensor, "env feature"]:
    """Return the object's position [m], six numbers of its orientation, velocity [m/s] and angular velocity [rad/s]."""
    body = now.object
    return torch.cat([body.pos, six_numbers(body.quat), body.linvel, body.angvel], dim=1)


def object_props(now: Now) -> Float[Tensor, "env feature"]:
    """Return the object's friction, mass [kg] and the distance from each probe to its surface [m]."""
    return torch.cat([now.friction[:, None], now.mass[:, None], now.distance], dim=1)
