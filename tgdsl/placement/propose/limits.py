"""The limits of joints as they are meant: no wider than their position servos' setpoints, and radians read as radians."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

TURN = 2.0 * np.pi  # hinges of which none turns by more than so many degrees were most likely given in radians
LEAST = 0.5  # at least one of them turns by so many radians if they were
RADIANS_AS_DEGREES = float(np.degrees(1.0))  # by how much angles are larger that were read as degrees but meant as radians
ASSUMED = np.radians(30.0)
"""How far a hinge without limits is taken to turn to either side of its start, where no joint with limits closes a hand."""
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_SERVO_BIAS, _FIXED_GAIN = int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtGain.mjGAIN_FIXED)
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def angles_are_misread(model: mujoco.MjModel) -> bool:
    """Return whether no hinge of a robot turns by more than 2π degrees, as if `angle="radian"` were missing in its file."""
    limited = model.jnt_limited.astype(bool)
    spans = np.ptp(model.jnt_range[limited & (model.jnt_type == _HINGE)], axis=1)
    if (limited & (model.jnt_type == _SLIDE)).any() or not len(spans):
        return False
    return bool(RADIANS_AS_DEGREES * spans.max() >= LEAST and spans.max() <= np.radians(TURN) * (1.0 + 1e-9))


def as_meant(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose joints have the limits that are meant; the same model if they have."""
    servos, is_misread = _servo_limits(model), angles_are_misread(model)
    if not servos and not is_misread:
        return model
    model = copy.copy(model)
    if is_misread:
        for joint in np.flatnonzero(model.jnt_type == _HINGE):
            model.jnt_range[joint] *= RADIANS_AS_DEGREES
            model.qpos0[model.jnt_qposadr[joint]] *= RADIANS_AS_DEGREES
        mujoco.mj_setConst(model, mujoco.MjData(model))  # lengths of tendons at the start
    for joint, (low, high) in servos.items():
        if model.jnt_limited[joint]:
            low, high = max(low, float(model.jnt_range[joint, 0])), min(high, float(model.jnt_range[joint, 1]))
        if low < high:
            model.jnt_limited[joint], model.jnt_range[joint] = 1, (low, high)
    return model


def with_assumed_limits(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose hinges without limits turn by `ASSUMED` to either side of their start."""
    model = copy.copy(model)
    hinges = np.flatnonzero((model.jnt_type == _HINGE) & (model.jnt_limited == 0))
    start = model.qpos0[model.jnt_qposadr[hinges]]
    model.jnt_range[hinges] = np.column_stack([start - ASSUMED, start + ASSUMED])
    model.jnt_limited[hinges] = 1
    return model


def _servo_limits(model: mujoco.MjModel) -> dict[int, tuple[float, float]]:
    """Return between which values position servos set hinges and slides [rad, of slides m]."""
    result: dict[int, tuple[float, float]] = {}
    for i in range(model.nu):
        joint, gear, bias = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0]), model.actuator_biasprm[i]
        is_servo = int(model.actuator_biastype[i]) == _SERVO_BIAS and int(model.actuator_gaintype[i]) == _FIXED_GAIN
        is_servo = is_servo and int(model.actuator_trntype[i]) in _ON_JOINT and bool(model.actuator_ctrllimited[i])
        if is_servo and bias[1] < 0.0 and gear != 0.0 and int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            # The servo rests where gain · control + bias₀ + bias₁ · gear · position vanishes.
            force = model.actuator_gainprm[i, 0] * model.actuator_ctrlrange[i] + bias[0]
            low, high = sorted((-force / (bias[1] * gear)).tolist())
            result[joint] = low, high
    return result
