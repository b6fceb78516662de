"""Joints and actuators that a module wants: where they stand in a model, and what they were before MuJoCo's last physics step.

A physics step moves `qpos` and `qvel` on, but leaves poses, velocities and contacts of bodies as they were at its start, which
is a state's instant. So they are kept from just before it; the actuators' forces are of its start as they are.

Shapes: `env` environments, `joint` and `actuator` as the module's `inputs` list them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Int

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.plan.inputs import Inputs

if TYPE_CHECKING:
    import mujoco.batch

MOVED = {"joint_pos": "qpos", "joint_vel": "qvel", "last_action": "ctrl"}
"""Fields of a state that a physics step, or its caller, moves on, and the arrays that they are read from."""
FORCES = {"joint_effort": "qfrc_actuator"}
"""Fields of a state that MuJoCo leaves at the instant of the poses."""

_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True, eq=False)
class JointColumns:
    """Where joints and actuators stand in a model's arrays.

    Attributes:
        by_array: Columns of `qpos`, `qvel`, `qfrc_actuator` and `ctrl` that are wanted.
        fields: The fields that a module wants, and the array of each.
    """

    by_array: dict[str, Int[np.ndarray, " column"]]
    fields: dict[str, str]

    @classmethod
    def of(cls, inputs: Inputs, model: mujoco.MjModel) -> JointColumns:
        """Look them up.

        Raises:
            SimulationError: If the model lacks a joint or an actuator, or a joint is no hinge or slide.
        """
        joints = np.array([_joint_id(model, name) for name in inputs.joints], dtype=np.intp)
        actuators = np.array([_actuator_id(model, name) for name in inputs.actuators], dtype=np.intp)
        dofs = model.jnt_dofadr[joints].astype(np.intp)
        columns = {"qpos": model.jnt_qposadr[joints].astype(np.intp), "qvel": dofs, "qfrc_actuator": dofs, "ctrl": actuators}
        return cls(columns, {name: array for name, array in (MOVED | FORCES).items() if name in inputs.fields})

    @property
    def moved(self) -> dict[str, str]:
        """Those fields that are to be kept from before the last physics step, and the array of each."""
        return {name: array for name, array in self.fields.items() if name in MOVED}


class KeptJoints:
    """Joints of MuJoCo's batch as they were at the instant of its poses.

    Attributes:
        is_wanted: Whether anything has to be kept from before a physics step.
    """

    def __init__(self, columns: JointColumns, batch: mujoco.batch.Batch):
        """Look at a batch that has just been made."""
        self._columns, self._batch = columns, batch
        for array in columns.fields.values():
            batch.bind(array)  # it is filled only by calls that come after its first use
        self._kept = {name: self._now(name) for name in columns.moved}
        self.is_wanted = bool(self._kept)

    def keep(self, env_ids: Int[np.ndarray, " n"] | slice = slice(None)) -> None:
        """Take note of where some environments' joints are, and of their controls: a physics step follows, or poses are new."""
        for name, kept in self._kept.items():
            kept[env_ids] = self._now(name, env_ids)

    def read(self, rows: Int[np.ndarray, " n"] | slice = slice(None)) -> dict[str, np.ndarray]:
        """Return the fields of some environments' state (default: all), (env, joint) or (env, actuator)."""
        return {n: self._kept[n][rows].copy() if n in self._kept else self._now(n, rows) for n in self._columns.fields}

    def _now(self, name: str, rows: Int[np.ndarray, " n"] | slice = slice(None)) -> np.ndarray:
        array = self._columns.fields[name]
        return np.array(getattr(self._batch, array)[rows][:, self._columns.by_array[array]], dtype=np.float64)


def _joint_id(model: mujoco.MjModel, name: str) -> int:
    try:
        joint = int(model.joint(name).id)
    except KeyError as error:
        known = [model.joint(i).name for i in range(model.njnt)]
        raise SimulationError(f'the scene has no joint "{name}"; {did_you_mean(name, known, "joints")}') from error
    if int(model.jnt_type[joint]) not in _SCALAR:
        raise SimulationError(f'the joint "{name}" is a ball or free joint, expected a hinge or slide')
    return joint


def _actuator_id(model: mujoco.MjModel, name: str) -> int:
    try:
        return int(model.actuator(name).id)
    except KeyError as error:
        known = [model.actuator(i).name for i in range(model.nu)]
        raise SimulationError(f'the scene has no actuator "{name}"; {did_you_mean(name, known, "actuators")}') from error
