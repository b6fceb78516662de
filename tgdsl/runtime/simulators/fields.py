"""Fields of a state that are poses, velocities and joints, gathered from MuJoCo's arrays.

Shapes: `env` environments, `body`, `joint` and `actuator` as the module's `inputs` list them.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.model_ids import element_id

POSES = ("xpos", "xquat", "cvel", "subtree_com")  # arrays that poses and velocities of bodies are read from
MOVED = {"joint_pos": "qpos", "joint_vel": "qvel", "last_action": "ctrl"}
"""Fields of a state that a physics step, or its caller, moves on, and the arrays that they are read from."""
FORCES = {"joint_effort": "qfrc_actuator"}  # fields of a state that MuJoCo leaves at the instant of the poses
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class StateReader:
    """Gathers a module's bodies, joints and actuators from arrays (env, …); each field is a new tensor.

    Attributes:
        arrays: Names of the arrays that it reads.
        moved: Names of the arrays whose values before the last physics step belong to the poses' instant.
    """

    def __init__(self, inputs: Inputs, model: mujoco.MjModel, device: torch.device):
        def index(ids: np.ndarray) -> Int[Tensor, " n"]:
            return torch.from_numpy(ids.astype(np.int64)).to(device)

        bodies, actuators = (
            np.array([element_id(model, kind, name) for name in names], dtype=np.int64)
            for kind, names in (("body", inputs.bodies), ("actuator", inputs.actuators))
        )
        joints = np.array([_scalar_joint(model, name) for name in inputs.joints], dtype=np.int64)
        dofs = model.jnt_dofadr[joints]
        columns = {"qpos": model.jnt_qposadr[joints], "qvel": dofs, "qfrc_actuator": dofs, "ctrl": actuators}
        self._bodies, self._roots, self._fields = index(bodies), index(model.body_rootid[bodies]), inputs.fields
        self._joints = {n: (array, index(columns[array])) for n, array in (MOVED | FORCES).items() if n in inputs.fields}
        self.arrays = (*POSES, *(array for array, _ in self._joints.values()))
        self.moved = tuple(array for name, (array, _) in self._joints.items() if name in MOVED)

    def read(self, arrays: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "env item ..."]]:
        """Return the fields that the module wants."""

        def take(name: str, ids: Int[Tensor, " n"]) -> Tensor:
            return arrays[name].index_select(1, ids)

        fields, values = self._fields, dict[str, Tensor]()
        if "body_pos" in fields:
            values["body_pos"] = take("xpos", self._bodies)
        if "body_quat" in fields:
            values["body_quat"] = take("xquat", self._bodies)
        if "body_linvel" in fields or "body_angvel" in fields:
            angular, linear = take("cvel", self._bodies).split(3, dim=-1)
            if "body_linvel" in fields:  # MuJoCo gives velocities at the centre of mass of a body's kinematic tree
                pos = values["body_pos"] if "body_pos" in values else take("xpos", self._bodies)
                values["body_linvel"] = linear + _cross(angular, pos - take("subtree_com", self._roots))
            if "body_angvel" in fields:
                values["body_angvel"] = angular
        return values | {name: take(array, columns) for name, (array, columns) in self._joints.items()}


def warn_of_mocap(inputs: Inputs, model: mujoco.MjModel) -> None:
    """Warn of mocap bodies whose velocity a module wants, as MuJoCo has them at rest however they are moved."""
    if not {"body_linvel", "body_angvel"} & set(inputs.fields):
        return
    mocap = [name for name in inputs.bodies if model.body_mocapid[model.body_rootid[element_id(model, "body", name)]] >= 0]
    if mocap:
        problem = "MuJoCo gives a mocap body that is moved no velocity: shear, slip and sound of its motion are not felt"
        warnings.warn(f"{problem}: {listed(mocap)}; move it by a joint, or by a weld to a mocap body", stacklevel=4)


def _cross(one: Float[Tensor, "*batch 3"], other: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    if one.is_cuda:
        return torch.linalg.cross(one, other)
    (a, b, c), (x, y, z) = one.unbind(-1), other.unbind(-1)
    return torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], dim=-1)  # rounds like NumPy's, without fused products


def _scalar_joint(model: mujoco.MjModel, name: str) -> int:
    joint = element_id(model, "joint", name)
    if int(model.jnt_type[joint]) not in _SCALAR:
        raise SimulationError(f'the joint "{name}" is a ball or free joint, expected a hinge or slide')
    return joint
