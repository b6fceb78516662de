"""Fields of a state from MuJoCo's arrays, NumPy's or torch's: bodies, and where joints and actuators stand.

Shapes: `env` environments, `body` as the module's `inputs` list them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import mujoco
import numpy as np
import torch
from jaxtyping import Int

from tgdsl.errors import SimulationError, listed
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.model_ids import element_id

T = TypeVar("T", np.ndarray, torch.Tensor)
STATE_ARRAYS = ("xpos", "xquat", "cvel", "subtree_com", "sensordata")
"""Arrays of MuJoCo that poses, velocities and contacts of a state are read from."""
MOVED = {"joint_pos": "qpos", "joint_vel": "qvel", "last_action": "ctrl"}
"""Fields of a state that a physics step, or its caller, moves on, and the arrays that they are read from."""
FORCES = {"joint_effort": "qfrc_actuator"}  # fields of a state that MuJoCo leaves at the instant of the poses

_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def warn_of_mocap(inputs: Inputs, model: mujoco.MjModel) -> None:
    """Warn of mocap bodies whose velocity a module wants, as MuJoCo has them at rest however they are moved."""
    if not {"body_linvel", "body_angvel"} & set(inputs.fields):
        return
    mocap = [name for name in inputs.bodies if model.body_mocapid[model.body_rootid[element_id(model, "body", name)]] >= 0]
    if mocap:
        problem = "MuJoCo gives a mocap body that is moved no velocity: shear, slip and sound of its motion are not felt"
        warnings.warn(f"{problem}: {listed(mocap)}; move it by a joint, or by a weld to a mocap body", stacklevel=4)


class BodyFields:
    """Gathers the fields of a state that are poses and velocities of bodies."""

    def __init__(
        self,
        inputs: Inputs,
        model: mujoco.MjModel,
        *,
        index: Callable[[np.ndarray], Any],
        take: Callable[[Any, Any], Any],
        cross: Callable[[Any, Any], Any],
    ):
        """Look the bodies up; indices, rows of an array (env, row, …) and cross products are NumPy's or torch's."""
        ids = np.array([element_id(model, "body", name) for name in inputs.bodies], dtype=np.int64)
        self._bodies, self._roots = index(ids), index(model.body_rootid[ids].astype(np.int64))
        self._fields = inputs.fields
        self._take, self._cross = take, cross

    def read(self, arrays: Mapping[str, T]) -> dict[str, T]:
        """Return the fields that the module wants, (env, body, …), each an array of its own."""
        values: dict[str, T] = {}
        if "body_pos" in self._fields:
            values["body_pos"] = self._take(arrays["xpos"], self._bodies)
        if "body_quat" in self._fields:
            values["body_quat"] = self._take(arrays["xquat"], self._bodies)
        if "body_linvel" in self._fields or "body_angvel" in self._fields:
            spatial = self._take(arrays["cvel"], self._bodies)
            if "body_linvel" in self._fields:
                pos = values["body_pos"] if "body_pos" in values else self._take(arrays["xpos"], self._bodies)
                arm = pos - self._take(arrays["subtree_com"], self._roots)
                # MuJoCo gives velocities at the centre of mass of a body's kinematic tree.
                values["body_linvel"] = spatial[..., 3:] + self._cross(spatial[..., :3], arm)
            if "body_angvel" in self._fields:
                values["body_angvel"] = spatial[..., :3]
        return values


@dataclass(frozen=True, eq=False)
class JointColumns:
    """Where joints and actuators stand in a model's arrays."""

    by_array: dict[str, Int[np.ndarray, " column"]]  # columns of `qpos`, `qvel`, `qfrc_actuator` and `ctrl` that are wanted
    fields: dict[str, str]  # the fields that a module wants, and the array of each

    @classmethod
    def of(cls, inputs: Inputs, model: mujoco.MjModel) -> JointColumns:
        """Look them up."""
        joints = np.array([_joint_id(model, name) for name in inputs.joints], dtype=np.intp)
        actuators = np.array([element_id(model, "actuator", name) for name in inputs.actuators], dtype=np.intp)
        dofs = model.jnt_dofadr[joints].astype(np.intp)
        columns = {"qpos": model.jnt_qposadr[joints].astype(np.intp), "qvel": dofs, "qfrc_actuator": dofs, "ctrl": actuators}
        return cls(columns, {name: array for name, array in (MOVED | FORCES).items() if name in inputs.fields})

    @property
    def moved(self) -> dict[str, str]:
        """The fields whose values before the last physics step are needed, and the array of each."""
        return {name: array for name, array in self.fields.items() if name in MOVED}


def _joint_id(model: mujoco.MjModel, name: str) -> int:
    joint = element_id(model, "joint", name)
    if int(model.jnt_type[joint]) not in _SCALAR:
        raise SimulationError(f'the joint "{name}" is a ball or free joint, expected a hinge or slide')
    return joint
