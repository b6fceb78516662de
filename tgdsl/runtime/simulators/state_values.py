"""Values that users hand to a simulator: MuJoCo's state, controls, and contacts of environments that a reset has placed.

Shapes: `env` environments, `n` environments that are chosen by index, `quat` quaternions in `qpos`.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypedDict

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.module.state import SceneState, shape_of
from tgdsl.plan.inputs import Inputs
from tgdsl.tensors.env_ids import EnvIds, broadcast_over, env_indices, is_env_mask

Control = Tensor | np.ndarray | None  # controls of a step, (actuator,) or (env, actuator); None: as they were
Numbers = Tensor | np.ndarray | Sequence[Any] | float  # of any dtype, on any device
INTEGRATED = (
    *("time", "qpos", "qvel", "act", "history", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active"),
    *("mocap_pos", "mocap_quat", "userdata"),
)
"""What the future of an environment follows from: MuJoCo's `mjSTATE_INTEGRATION`."""
_MIN_NORM = 1e-15  # MuJoCo's `mjMINVAL`: shorter quaternions have no direction, and those nearer to unit length stay
FAR_BEYOND = 10.0
"""How many widths of its range a control must be beyond to be a mistake, such as one of units; less is clipped silently."""


class StateValues(TypedDict, total=False):
    """MuJoCo's arrays of one environment's state, each as in `MjData`."""

    qpos: Numbers
    qvel: Numbers
    ctrl: Numbers
    act: Numbers
    mocap_pos: Numbers
    mocap_quat: Numbers
    time: Numbers
    qacc_warmstart: Numbers
    qfrc_applied: Numbers
    xfrc_applied: Numbers
    eq_active: Numbers
    history: Numbers
    userdata: Numbers


class NewValues(NamedTuple):
    """Values to set, in the dtype and on the device of the state."""

    values: dict[str, Tensor]  # by name, (env, …); rows of environments that are not chosen mean nothing
    is_bad: Bool[Tensor, " env"] | None = None  # values that cannot be used: not refused, as that would wait for a GPU


class StateTable:
    """The live arrays of a simulator's state, and what may be put into them."""

    def __init__(self, model: mujoco.MjModel, arrays: Mapping[str, Tensor]):
        self._arrays = {name: arrays[name] for name in INTEGRATED}
        self._num_envs, self._device = len(arrays["qpos"]), arrays["qpos"].device
        free = model.jnt_qposadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)] + 3
        balls = model.jnt_qposadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)]
        places = np.concatenate([free, balls]).astype(np.int64)[:, None] + np.arange(4)
        self._quats: Int[Tensor, "quat 4"] = torch.from_numpy(places).to(self._device)

    def rows(self, given: Mapping[str, Any], env_ids: EnvIds | None) -> NewValues:
        """Return values as rows per environment: see `Simulation.set_state`.

        Numbers on the host are checked here. Those on a GPU, and those whose environments are a mask there, are checked there:
        nothing waits, and `is_bad` is the result.
        """
        is_mask = env_ids is None or is_env_mask(env_ids, self._num_envs)
        ids = None if is_mask else env_indices(env_ids, self._num_envs)
        result, is_bad = dict[str, Tensor](), None
        for name, value in given.items():
            rows = self._checked(name, value, ids)
            is_on_host = not (rows.is_cuda or (isinstance(env_ids, Tensor) and env_ids.is_cuda))
            rows = rows.to(self._device, torch.float64)
            ndim = self._arrays[name].ndim - 1
            if ids is not None and rows.ndim > ndim:
                every = torch.zeros((self._num_envs, *rows.shape[1:]), dtype=rows.dtype, device=self._device)
                rows = every.index_copy_(0, torch.from_numpy(ids).to(self._device), rows)
            rows, unfinite, unturned = self._normalised(name, rows.expand(self._num_envs, *rows.shape[-ndim:] if ndim else ()))
            if is_on_host:
                self._refuse(f"{name} is not finite", unfinite, env_ids)
                self._refuse(f"{name} holds a quaternion of length 0", unturned, env_ids)
            else:
                is_bad = unfinite | unturned | (False if is_bad is None else is_bad)
            result[name] = rows.to(self._arrays[name].dtype)
        return NewValues(result, is_bad)

    def _checked(self, name: str, value: Any, ids: Int[np.ndarray, " n"] | None) -> Tensor:
        """Return a value as a tensor without gradients, where it is, of a shape that fits."""
        if name not in self._arrays:
            raise SimulationError(f'the state has no array "{name}"; {did_you_mean(name, self._arrays, "arrays")}')
        result = _as_tensor(name, value)
        shape = tuple(self._arrays[name].shape[1:])
        num_rows = self._num_envs if ids is None else len(ids)
        if tuple(result.shape) not in ((num_rows, *shape), shape):
            expected = (
                f"{(num_rows, *shape)}, a row {'per environment' if ids is None else 'for each index'}, or {shape} for all"
            )
            raise SimulationError(f"{name} has shape {tuple(result.shape)}, expected {expected}")
        if ids is not None and result.ndim > len(shape) and len(np.unique(ids)) < len(ids):
            twice = listed(sorted({str(env) for env in ids.tolist() if (ids == env).sum() > 1}))
            raise SimulationError(f"env_ids: environments {twice} are named more than once, and {name} has a row for each")
        return result

    def _normalised(self, name: str, value: Float[Tensor, "env ..."]) -> tuple[Tensor, Tensor, Tensor]:
        """Return a value with quaternions of unit length, where it is not finite, and where a quaternion is zero."""
        unfinite = ~torch.isfinite(value.to(self._arrays[name].dtype)).reshape(len(value), -1).all(dim=1)
        is_qpos = name == "qpos" and len(self._quats) > 0
        if not is_qpos and name != "mocap_quat":
            return value, unfinite, torch.zeros_like(unfinite)
        quats = value[:, self._quats] if is_qpos else value
        w, x, y, z = quats.unbind(dim=-1)
        norm = (w * w + x * x + y * y + z * z).sqrt()
        # As `mju_normalize4` does it, bit for bit.
        scale = torch.where((norm - 1).abs() > _MIN_NORM, 1 / norm, 1.0)
        unit = quats * scale[..., None]
        if is_qpos:
            unit = value.index_copy(1, self._quats.flatten(), unit.flatten(1))
        return unit, unfinite, (norm < _MIN_NORM).any(dim=1)

    def _refuse(self, problem: str, bad: Bool[Tensor, " env"], env_ids: EnvIds | None) -> None:
        if bad.any() and (envs := sorted({int(env) for env in env_indices(env_ids, len(bad)) if bad[env]})):
            raise SimulationError(f"{problem} in environments {listed(list(map(str, envs)))}")


def _as_tensor(name: str, value: Any) -> Tensor:
    try:
        return value.detach() if isinstance(value, Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise SimulationError(f"{name} is no array of numbers: {error}") from error


def control_tensor(control: Tensor | np.ndarray, num_envs: int, num_actuators: int) -> Float[Tensor, "*env actuator"]:
    """Return controls, (actuator,) or (env, actuator), as a tensor without gradients; an array becomes float64."""
    values = _as_tensor("control", control)
    if tuple(values.shape) not in ((num_actuators,), (num_envs, num_actuators)):
        expected = f"({num_envs}, {num_actuators}) or ({num_actuators},)"
        raise SimulationError(f"control has shape {tuple(values.shape)}, expected {expected}")
    return values


def write_controls(
    control: Tensor | np.ndarray, ctrl: Float[Tensor, "env actuator"], refuses_unfinite: bool
) -> Bool[Tensor, "*env"]:
    """Write controls in place where they are finite; return where they are not, () if one row is for all environments.

    Controls on a GPU are checked there. If `refuses_unfinite`, host controls that are not finite raise an error.
    """
    values = control_tensor(control, *ctrl.shape)
    is_on_host = not (values.is_cuda and ctrl.is_cuda)
    values = values.to(ctrl.device, ctrl.dtype)
    is_bad = ~torch.isfinite(values).all(dim=-1)
    if is_on_host and refuses_unfinite and (rows := torch.nonzero(is_bad.reshape(-1)).flatten().tolist()):
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
    warnings.warn(f"{problem}, and MuJoCo clips it to [{low[i]:g}, {high[i]:g}]; shown once", stacklevel=4)
    return True


FIELDS = (
    *("contact_found", "contact_pos", "contact_force", "contact_torque", "contact_normal", "contact_netforce"),
    "joint_effort",
)
"""Fields of a state that follow from forces."""
Contacts = str | Mapping[str, Tensor]  # the contacts of a start: "evaluate", "none" or fields, see `Simulation.reset`


class StartContacts:
    """The contacts of environments that were placed since the last step, in the place of what the simulator has."""

    def __init__(self, inputs: Inputs):
        self._inputs = inputs
        self.is_placed: Bool[Tensor, " env"] | None = None  # environments that were placed; None if none were
        self.values: dict[str, Tensor] = {}  # their contacts, by field

    def forget(self, chosen: Bool[Tensor, " env"] | None = None) -> None:
        """Forget some environments (default: all), whose contacts the simulator has evaluated."""
        if chosen is None:
            self.is_placed, self.values = None, {}
        elif self.is_placed is not None:
            self.is_placed = self.is_placed & ~chosen

    def place(self, chosen: Bool[Tensor, " env"], contacts: Contacts) -> None:
        """Note environments that were placed, and their contacts: "none", or fields of a state by name, the others zero."""
        if isinstance(contacts, str) and contacts != "none":
            raise SimulationError(f'contacts is "{contacts}"; {did_you_mean(contacts, ("evaluate", "none"), "choices")}')
        fields = {} if isinstance(contacts, str) else {n: self._fitting(n, contacts[n], chosen) for n in contacts}
        for name in {**self.values, **fields}:
            old, new = self.values.get(name), fields.get(name)
            new = torch.zeros_like(old) if new is None else new  # pyright: ignore[reportArgumentType]
            old = torch.zeros_like(new) if old is None else old
            self.values[name] = torch.where(broadcast_over(chosen, new), new, old.to(new.dtype))
        self.is_placed = chosen.clone() if self.is_placed is None else self.is_placed | chosen

    def applied_to(self, state: SceneState, is_stored: bool = True) -> SceneState:
        """Return a state in which placed environments have the contacts of their start.

        Unless `is_stored`, the stored ones are not of this state's pairs and joints, and all are zero.
        """
        if self.is_placed is None:
            return state
        values: dict[str, Any] = {}
        for name in FIELDS:
            if (now := getattr(state, name)) is not None:
                start = self.values.get(name) if is_stored else None
                value = torch.zeros_like(now) if start is None else start.to(now.device, now.dtype)
                values[name] = torch.where(broadcast_over(self.is_placed.to(now.device), now), value, now)
        return dataclasses.replace(state, **values)

    def _fitting(self, name: str, value: Tensor, chosen: Bool[Tensor, " env"]) -> Tensor:
        field_names = [field for field in FIELDS if field in self._inputs.fields]
        if name not in field_names:
            raise SimulationError(f'contacts: this module wants no "{name}"; {did_you_mean(name, field_names, "fields")}')
        shape = (len(chosen), *shape_of(name, self._inputs))
        if tuple(value.shape) not in (shape, shape[1:]):
            raise SimulationError(f"contacts: {name} has shape {tuple(value.shape)}, expected {shape} or {shape[1:]}")
        return value.to(chosen.device).expand(shape)
