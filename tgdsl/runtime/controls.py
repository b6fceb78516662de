"""Actuator controls as users hand them to a simulator."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import SimulationError, listed

FAR_BEYOND = 10.0
"""How many widths of its range a control must be beyond to be a mistake, such as one of units; less is clipped silently."""


def control_tensor(control: Tensor | np.ndarray, num_envs: int, num_actuators: int) -> Float[Tensor, "*env actuator"]:
    """Return controls, (actuator,) or (env, actuator), as a tensor without gradients; an array becomes float64."""
    values = control.detach() if isinstance(control, Tensor) else torch.from_numpy(np.array(control, dtype=np.float64))
    if tuple(values.shape) not in ((num_actuators,), (num_envs, num_actuators)):
        expected = f"({num_envs}, {num_actuators}) or ({num_actuators},)"
        raise SimulationError(f"control has shape {tuple(values.shape)}, expected {expected}")
    return values


def write_controls(
    control: Tensor | np.ndarray, ctrl: Float[Tensor, "env actuator"], refuses_unfinite: bool
) -> Bool[Tensor, "*env"]:
    """Write controls in place where they are finite; return the environments where they are not, or for all whether they are.

    Those on a GPU are looked at there; those of the host are refused if they are not finite and `refuses_unfinite`.
    """
    values = control_tensor(control, *ctrl.shape)
    is_read_here = not (values.is_cuda and ctrl.is_cuda)
    values = values.to(ctrl.device, ctrl.dtype)
    is_bad = ~torch.isfinite(values).all(dim=-1)
    if is_read_here and refuses_unfinite and (rows := torch.nonzero(is_bad.reshape(-1)).flatten().tolist()):
        raise SimulationError(f"control is not finite in environments {listed([str(row) for row in rows])}")
    ctrl.copy_(torch.where(is_bad[..., None], ctrl, values))
    return is_bad


def warn_of_range(control: Tensor | np.ndarray, model: mujoco.MjModel) -> bool:
    """Warn of the first control on the host that is far beyond its actuator's range; return whether there is one."""
    if isinstance(control, Tensor) and control.is_cuda:
        return False
    values = np.atleast_2d(control.detach().double().numpy() if isinstance(control, Tensor) else control)
    low, high = model.actuator_ctrlrange.T
    reach = np.where(model.actuator_ctrllimited, FAR_BEYOND * (high - low), np.inf)
    far = np.argwhere(np.maximum(low - values, values - high) > reach)
    if not len(far):
        return False
    env, i = far[0]
    where = f"environment {env}" if len(values) > 1 else "all environments"
    problem = f'control of actuator "{model.actuator(int(i)).name}" is {values[env, i]:g} in {where}'
    warnings.warn(f"{problem}, and MuJoCo clips it to [{low[i]:g}, {high[i]:g}]; this is said once", stacklevel=4)
    return True
