"""Values of MuJoCo's state as users hand them to a simulator, one row per environment; and contacts that a reset has placed.

Shapes: `env` environments, `n` environments that are chosen by index, `quat` quaternions in `qpos`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.module.state import SceneState, shape_of
from tgdsl.plan.inputs import Inputs
from tgdsl.tensors.env_ids import EnvIds, broadcast_over, env_indices, is_env_mask

Numbers = Tensor | np.ndarray | Sequence[Any] | float  # numbers of any dtype, on any device
INTEGRATED = (
    *("time", "qpos", "qvel", "act", "history", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active"),
    *("mocap_pos", "mocap_quat", "userdata"),
)
"""What the future of an environment follows from: MuJoCo's `mjSTATE_INTEGRATION`."""
_MIN_NORM = 1e-15
"""MuJoCo's `mjMINVAL`: shorter quaternions have no direction, and those nearer to unit length stay as they are."""


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


@dataclass(frozen=True)
class Rows:
    """Values to set, in the dtype and on the device of the state."""

    values: dict[str, Tensor]  # by name, (env, …); rows of environments that are not chosen mean nothing
    # environments whose values cannot be used and were not refused, as that would wait for a GPU
    is_bad: Bool[Tensor, " env"] | None = None


class StateTable:
    """The live arrays of a simulator's state, and what may be put into them."""

    def __init__(self, model: mujoco.MjModel, arrays: Mapping[str, Tensor]):
        self._arrays = {name: arrays[name] for name in INTEGRATED}
        self._num_envs, self._device = len(arrays["qpos"]), arrays["qpos"].device
        free = model.jnt_qposadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)] + 3
        balls = model.jnt_qposadr[model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)]
        places = np.concatenate([free, balls]).astype(np.int64)[:, None] + np.arange(4)
        self._quats: Int[Tensor, "quat 4"] = torch.from_numpy(places).to(self._device)

    def rows(self, given: Mapping[str, Any], env_ids: EnvIds | None) -> Rows:
        """Return values as rows per environment.

        Numbers on the host are looked at here. Those on a GPU, and those whose environments are a mask there, are judged there:
        nothing waits, and `is_bad` is the result.

        Args:
            given: By name, one row for all environments alike; or with indices a row for each, in their order; or else
                (env, …).
            env_ids: The environments: indices, or a boolean mask; None: all.

        Raises:
            SimulationError: If there is no such array or environment, a shape does not fit, an environment is named twice, or
                numbers on the host are not finite or a quaternion of them is zero.
        """
        is_mask = env_ids is None or is_env_mask(env_ids, self._num_envs)
        ids = None if is_mask else env_indices(env_ids, self._num_envs)
        values: dict[str, Tensor] = {}
        is_bad: Bool[Tensor, " env"] | None = None
        for name, value in given.items():
            rows = self._checked(name, value, ids)
            is_read_here = not (rows.is_cuda or (isinstance(env_ids, Tensor) and env_ids.is_cuda))
            rows = rows.to(self._device, torch.float64)
            ndim = self._arrays[name].ndim - 1
            if ids is not None and rows.ndim > ndim:
                every = torch.zeros((self._num_envs, *rows.shape[1:]), dtype=rows.dtype, device=self._device)
                rows = every.index_copy_(0, torch.from_numpy(ids).to(self._device), rows)
            rows, bad = self._judged(name, rows.expand(self._num_envs, *rows.shape[-ndim:] if ndim else ()))
            if is_read_here:
                self._refuse(name, bad, env_ids)
            else:
                any_bad = bad.any(dim=0)
                is_bad = any_bad if is_bad is None else is_bad | any_bad
            values[name] = rows.to(self._arrays[name].dtype)
        return Rows(values, is_bad)

    def _checked(self, name: str, value: Any, ids: Int[np.ndarray, " n"] | None) -> Tensor:
        """Return a value as a tensor without gradients, where it is, of a shape that fits."""
        if name not in self._arrays:
            raise SimulationError(f'the state has no array "{name}"; {did_you_mean(name, self._arrays, "arrays")}')
        try:
            result = value.detach() if isinstance(value, Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise SimulationError(f"{name} is no array of numbers: {error}") from error
        shape = tuple(self._arrays[name].shape[1:])
        num_rows = self._num_envs if ids is None else len(ids)
        if tuple(result.shape) not in ((num_rows, *shape), shape):
            rows = "a row per environment" if ids is None else "a row for each index"
            raise SimulationError(
                f"{name} has shape {tuple(result.shape)}, expected {(num_rows, *shape)}, {rows}, or {shape} for all"
            )
        if ids is not None and result.ndim > len(shape) and len(np.unique(ids)) < len(ids):
            twice = sorted({str(env) for env in ids.tolist() if (ids == env).sum() > 1})
            raise SimulationError(
                f"env_ids: environments {listed(twice)} are named more than once, and {name} has a row for each"
            )
        return result

    def _judged(self, name: str, value: Float[Tensor, "env ..."]) -> tuple[Float[Tensor, "env ..."], Bool[Tensor, "2 env"]]:
        """Return a value with quaternions of unit length, and where it is not finite and where a quaternion is zero."""
        is_finite = torch.isfinite(value.to(self._arrays[name].dtype))
        is_unfinite = ~(is_finite.flatten(1).all(dim=1) if is_finite.ndim > 1 else is_finite)
        quats = None
        if name == "qpos" and len(self._quats):
            quats = value[:, self._quats]
        elif name == "mocap_quat":
            quats = value
        if quats is None:
            return value, torch.stack([is_unfinite, torch.zeros_like(is_unfinite)])
        w, x, y, z = quats.unbind(dim=-1)
        norm = (w * w + x * x + y * y + z * z).sqrt()
        # As `mju_normalize4` does it, bit for bit.
        scale = torch.where((norm - 1).abs() > _MIN_NORM, 1 / norm, 1.0)
        unit = quats * scale[..., None]
        if name == "qpos":
            unit = value.index_copy(1, self._quats.flatten(), unit.flatten(1))
        return unit, torch.stack([is_unfinite, (norm < _MIN_NORM).any(dim=1)])

    def _refuse(self, name: str, bad: Bool[Tensor, "2 env"], env_ids: EnvIds | None) -> None:
        if not bad.any():
            return
        is_named = torch.zeros(self._num_envs, dtype=torch.bool)
        is_named[torch.from_numpy(env_indices(env_ids, self._num_envs))] = True
        for problem, where in zip(("is not finite", "holds a quaternion of length 0"), bad.cpu() & is_named, strict=True):
            if where.any():
                envs = listed([str(env) for env in torch.nonzero(where).flatten().tolist()])
                raise SimulationError(f"{name} {problem} in environments {envs}")


FIELDS = (
    *("contact_found", "contact_pos", "contact_force", "contact_torque", "contact_normal", "contact_netforce"),
    "joint_effort",
)
"""Fields of a state that follow from forces."""
Contacts = str | Mapping[str, Tensor]
"""The contacts of a start, or how to get them, "evaluate" or "none": see `Simulation.reset`."""


class StartContacts:
    """The contacts of environments that were placed since the last step, in the place of what the simulator has.

    Attributes:
        is_placed: Environments that were placed; None if none were.
        values: What was stored of their contacts, by field.
    """

    def __init__(self, inputs: Inputs):
        self._inputs = inputs
        self.is_placed: Bool[Tensor, " env"] | None = None
        self.values: dict[str, Tensor] = {}

    def forget(self, chosen: Bool[Tensor, " env"] | None = None) -> None:
        """Forget some environments (default: all), whose contacts the simulator has evaluated."""
        if chosen is None:
            self.is_placed, self.values = None, {}
        elif self.is_placed is not None:
            self.is_placed = self.is_placed & ~chosen

    def place(self, chosen: Bool[Tensor, " env"], contacts: Contacts) -> None:
        """Note environments that were placed, and their contacts: "none", or fields of a state by name, the others zero."""
        given = self._given(contacts, chosen)
        for name in {**self.values, **given}:
            old, new = self.values.get(name), given.get(name)
            like = old if new is None else new
            assert like is not None
            old, new = (torch.zeros_like(like) if value is None else value for value in (old, new))
            self.values[name] = torch.where(broadcast_over(chosen, like), new, old.to(new.dtype))
        self.is_placed = chosen.clone() if self.is_placed is None else self.is_placed | chosen

    def applied_to(
        self, state: SceneState, is_stored: bool = True, rows: Int[Tensor, " n"] | slice = slice(None)
    ) -> SceneState:
        """Return a state, of all or some rows, in which placed environments have the contacts of their start.

        Unless `is_stored`, the stored ones are not of this state's pairs and joints, and all are zero.
        """
        if self.is_placed is None:
            return state
        is_placed = self.is_placed[rows]
        values: dict[str, Any] = {}
        for name in FIELDS:
            now = getattr(state, name)
            if now is not None:
                start = self.values.get(name) if is_stored else None
                value = torch.zeros_like(now) if start is None else start[rows].to(now.device, now.dtype)
                values[name] = torch.where(broadcast_over(is_placed.to(now.device), now), value, now)
        return dataclasses.replace(state, **values)

    def _given(self, contacts: Contacts, chosen: Bool[Tensor, " env"]) -> dict[str, Tensor]:
        """Return the fields that are given for the environments, (env, …)."""
        if not isinstance(contacts, str):
            return {name: self._fitting(name, contacts[name], chosen) for name in contacts}
        if contacts != "none":
            raise SimulationError(f'contacts is "{contacts}"; {did_you_mean(contacts, ("evaluate", "none"), "choices")}')
        return {}

    def _fitting(self, name: str, value: Tensor, chosen: Bool[Tensor, " env"]) -> Tensor:
        field_names = [field for field in FIELDS if field in self._inputs.fields]
        if name not in field_names:
            raise SimulationError(f'contacts: this module wants no "{name}"; {did_you_mean(name, field_names, "fields")}')
        shape = (len(chosen), *shape_of(name, self._inputs))
        if tuple(value.shape) not in (shape, shape[1:]):
            raise SimulationError(f"contacts: {name} has shape {tuple(value.shape)}, expected {shape} or {shape[1:]}")
        return value.to(chosen.device).expand(shape)
