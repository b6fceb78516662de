"""Where the joints and actuators that a module wants stand in a model's arrays."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Int

from tgdsl.errors import SimulationError
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.model_ids import element_id

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
        actuators = np.array([element_id(model, "actuator", name) for name in inputs.actuators], dtype=np.intp)
        dofs = model.jnt_dofadr[joints].astype(np.intp)
        columns = {"qpos": model.jnt_qposadr[joints].astype(np.intp), "qvel": dofs, "qfrc_actuator": dofs, "ctrl": actuators}
        return cls(columns, {name: array for name, array in (MOVED | FORCES).items() if name in inputs.fields})

    @property
    def moved(self) -> dict[str, str]:
        """Those fields that are to be kept from before the last physics step, and the array of each."""
        return {name: array for name, array in self.fields.items() if name in MOVED}


def _joint_id(model: mujoco.MjModel, name: str) -> int:
    joint = element_id(model, "joint", name)
    if int(model.jnt_type[joint]) not in _SCALAR:
        raise SimulationError(f'the joint "{name}" is a ball or free joint, expected a hinge or slide')
    return joint
