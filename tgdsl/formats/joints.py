"""A robot's hinges and slides in its scene, and the actuators that act on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from tgdsl.formats.model import Model

_JOINT_DRIVES = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_SITE_DRIVES = (int(mujoco.mjtTrn.mjTRN_SITE), int(mujoco.mjtTrn.mjTRN_SLIDERCRANK))
_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclass(frozen=True)
class Actuator:
    """An actuator of the robot."""

    name: str  # its name; empty if it has none
    id: int  # MuJoCo's index
    joints: tuple[str, ...]  # names of the hinges and slides that it acts on: one, or its fixed tendon's


@dataclass(frozen=True)
class RobotJoints:
    """A robot's joints and actuators."""

    joints: tuple[str, ...]  # hinges and slides: first the actuated ones, in the order of the actuators
    num_actuated: int  # how many of them have an actuator
    slides: frozenset[str]  # names of the slides among `joints`
    others: tuple[str, ...]  # names of its ball and free joints
    actuators: tuple[Actuator, ...]  # its actuators, in the model's order


def robot_joints(robot: Model, scene: Model) -> RobotJoints:
    """Return the joints of a robot's bodies as they are in a scene, and the scene's actuators that act on these bodies."""
    model, bodies = scene.compiled, set(robot.bodies[1:])
    robot_ids = [i for i in range(model.njnt) if model.body(model.jnt_bodyid[i]).name in bodies]
    scalar_ids = [i for i in robot_ids if model.jnt_type[i] in (_SLIDE, _HINGE)]
    actuators, driven = [], []
    for i in range(model.nu):
        targets, on = _targets(model, i)
        joints = [joint for joint in targets if joint in robot_ids]
        if joints or on & bodies:
            acting = [joint for joint in joints if joint in scalar_ids]
            actuators.append(Actuator(model.actuator(i).name, i, tuple(model.joint(joint).name for joint in acting)))
            driven += acting
    driven = list(dict.fromkeys(driven))
    undriven = [i for i in scalar_ids if i not in driven and model.joint(i).name]
    return RobotJoints(
        joints=tuple(model.joint(i).name for i in [*driven, *undriven]),
        num_actuated=len(driven),
        slides=frozenset(model.joint(i).name for i in scalar_ids if model.jnt_type[i] == _SLIDE),
        others=tuple(model.joint(i).name for i in robot_ids if i not in scalar_ids),
        actuators=tuple(actuators),
    )


def _targets(model: mujoco.MjModel, actuator: int) -> tuple[Sequence[int], set[str]]:
    """Return the joints that an actuator acts on, directly or by a fixed tendon, and else the bodies on which it acts."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in _JOINT_DRIVES:
        return [target], set()
    joints, bodies = [], []
    if kind == mujoco.mjtTrn.mjTRN_BODY:
        bodies = [target]
    elif kind in _SITE_DRIVES:
        bodies = [model.site_bodyid[target]]
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
        path = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
        types, ids = model.wrap_type[path], np.asarray(model.wrap_objid[path])
        joints = ids[types == mujoco.mjtWrap.mjWRAP_JOINT].tolist()
        bodies = model.site_bodyid[ids[types == mujoco.mjtWrap.mjWRAP_SITE]].tolist()
    return joints, {model.body(int(i)).name for i in bodies}
