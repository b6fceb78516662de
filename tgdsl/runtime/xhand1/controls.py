"""From a model's actuators to the hand's joints: by joint name, with the ranges of the robot file.

Shapes: `joint` the hand's joints by id, `actuator` the model's actuators.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import listed
from tgdsl.runtime.xhand1.motion import ROUNDING, MotionLimits, joint_ids
from tgdsl.runtime.xhand1.wire.errors import MotionError
from tgdsl.runtime.xhand1.wire.payloads import JOINTS, NUM_JOINTS


@dataclass(frozen=True, eq=False)
class JointControls:
    """Controls of a model that are the hand's joint angles.

    Attributes:
        actuator_id: Actuator of each joint.
        qpos_id: Place of each joint in the model's `qpos`.
    """

    actuator_id: Int[np.ndarray, " joint"]
    qpos_id: Int[np.ndarray, " joint"]

    @classmethod
    def of_model(cls, model: mujoco.MjModel) -> JointControls:
        """Return those of a model.

        Raises:
            MotionError: If the model lacks a joint of the hand, a joint has not just one actuator that takes its angle in rad,
                or there are other actuators.
        """
        joints = joint_ids(model)
        actuators = [_actuator(model, name, int(joint)) for name, joint in zip(JOINTS, joints, strict=True)]
        others = [model.actuator(i).name or str(i) for i in range(model.nu) if i not in actuators]
        if others:
            raise MotionError(f"the actuators {listed(others)} are not of the hand's joints, so a hand cannot do what they do")
        return cls(np.array(actuators), model.jnt_qposadr[joints].astype(np.int64))

    def targets(self, control: np.ndarray) -> Float[np.ndarray, " joint"]:
        """Return joint angles by joint id [rad] from controls by actuator, (actuator,) or (1, actuator).

        Raises:
            MotionError: If there are not as many.
        """
        if control.shape not in ((NUM_JOINTS,), (1, NUM_JOINTS)):
            raise MotionError(f"control has shape {control.shape}, expected (1, {NUM_JOINTS}) or ({NUM_JOINTS},)")
        return control.reshape(-1)[self.actuator_id].astype(np.float64)


def check_ranges(model: mujoco.MjModel, limits: MotionLimits) -> None:
    """Look whether motion limits stay within the robot file's.

    Raises:
        MotionError: If one does not.
    """
    ranges = model.jnt_range[joint_ids(model)]
    for name, lower, upper, (least, largest) in zip(JOINTS, limits.lower, limits.upper, ranges, strict=True):
        if lower < least - ROUNDING or upper > largest + ROUNDING:
            what = f"{name}: limits from {lower:g} to {upper:g} rad"
            raise MotionError(f"{what}, expected them within the robot file's {least:g} to {largest:g}")


def _actuator(model: mujoco.MjModel, name: str, joint: int) -> int:
    """Return the one actuator of a joint, whose control is the angle to go to [rad]."""
    is_own = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    found = np.flatnonzero(is_own)
    if len(found) != 1:
        raise MotionError(f"{name} has {len(found)} actuators, expected one")
    i = int(found[0])
    gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
    is_position = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and gain > 0 and bias[0] == 0 and bias[1] == -gain
    if not is_position or model.actuator_gear[i, 0] != 1:
        raise MotionError(f'{name}: actuator "{model.actuator(i).name}" takes no angle in rad; expected a position actuator')
    return i
