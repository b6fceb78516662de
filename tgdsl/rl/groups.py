"""Groups of observations that tasks share.

Source: Chung et al., *Tactile Genesis*, appendix, "Observation groups".

Shapes: `env` environments, `feature` numbers of a group.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.rl.rotations import six_numbers
from tgdsl.rl.task import Now


def proprio(now: Now) -> Float[Tensor, "env feature"]:
    """Return positions [rad], velocities [rad/s] and last action of the joints that the policy moves."""
    return torch.cat([now.joint_pos, now.joint_vel, now.action], dim=1)


def priv_proprio(now: Now, own: Float[Tensor, "env shared"]) -> Float[Tensor, "env feature"]:
    """Return `proprio`, which is `own`, and the object's force on each link, in its frame [N], link by link."""
    return torch.cat([own, now.link_force.flatten(1)], dim=1)


def object_state(now: Now) -> Float[Tensor, "env feature"]:
    """Return the object's position [m], six numbers of its orientation, velocity [m/s] and angular velocity [rad/s]."""
    own = now.object
    return torch.cat([own.pos, six_numbers(own.quat), own.linvel, own.angvel], dim=1)


def object_props(now: Now) -> Float[Tensor, "env feature"]:
    """Return the object's friction, mass [kg] and the distance from each probe to its surface [m]."""
    return torch.cat([now.friction[:, None], now.mass[:, None], now.distance], dim=1)
