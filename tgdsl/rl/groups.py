"""Groups of observations that tasks share.

Source: Chung et al., *Tactile Genesis*, appendix, "Observation groups".

Shapes: `env` environments, `feature` numbers of a group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.rl.draws import Draws
from tgdsl.rl.features import GoalPart
from tgdsl.rl.rotations import Quat, between, inverse, product, six_numbers
from tgdsl.rl.spec import ProprioSpec
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
        """Return its state by name: live tensors, (env, joint) [rad, rad/s]."""
        return {"before": self._before, "value": self.value}


def proprio(now: Now | HandNow, vel_scale: float = 1.0) -> Float[Tensor, "env feature"]:
    """Return positions [rad], velocities [rad/s] times a factor, and last action of the joints that the policy moves."""
    return torch.cat([now.joint_pos, vel_scale * now.joint_vel, now.action], dim=1)


def noisy_proprio(now: Now, spec: ProprioSpec, draws: Draws, count: Int[Tensor, " env"]) -> Float[Tensor, "env feature"]:
    """Return `proprio` with noise."""
    if spec.pos_noise or spec.vel_noise:
        pos, vel = draws.normal("proprio", count, 2 * now.joint_pos.shape[1]).to(now.joint_pos).chunk(2, dim=1)
        now = replace(now, joint_pos=now.joint_pos + spec.pos_noise * pos, joint_vel=now.joint_vel + spec.vel_noise * vel)
    return proprio(now, spec.vel_scale)


def priv_proprio(now: Now) -> Float[Tensor, "env feature"]:
    """Return exact `proprio` and the object's force on each link, in the link's frame [N], link by link."""
    return torch.cat([proprio(now), now.link_force.flatten(1)], dim=1)


def goal(parts: Sequence[GoalPart], wanted: Quat, quat: Quat) -> Float[Tensor, "env feature"]:
    """Return parts of a goal, the orientation `wanted` of an object that now has `quat`: see `PlacedTaskSpec.goal`."""
    values = {
        "orientation": lambda: six_numbers(wanted),
        "difference": lambda: six_numbers(product(wanted, inverse(quat))),
        "angle": lambda: between(wanted, quat)[:, None],
    }
    return torch.cat([values[part]() for part in parts], dim=1)


def object_state(now: Now) -> Float[Tensor, "env feature"]:
    """Return the object's position [m], six numbers of its orientation, velocity [m/s] and angular velocity [rad/s]."""
    body = now.object
    return torch.cat([body.pos, six_numbers(body.quat), body.linvel, body.angvel], dim=1)


def object_props(now: Now) -> Float[Tensor, "env feature"]:
    """Return the object's friction, mass [kg] and the distance from each probe to its surface [m]."""
    return torch.cat([now.friction[:, None], now.mass[:, None], now.distance], dim=1)
