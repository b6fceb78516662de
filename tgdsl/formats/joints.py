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
    joints: tuple[str, ...]  # names of the hinges and slides that it acts on: one, or those of its fixed tendon


@dataclass(frozen=True)
class RobotJoints:
    """A robot's joints and actuators."""

    # names of its hinges and slides: first the actuated ones, in the order of the actuators, then the others
    joints: tuple[str, ...]
    num_actuated: int  # how many of them have an actuator
    slides: frozenset[str]  # those that are slides
    others: tuple[str, ...]  # names of its ball and free joints
    actuators: tuple[Actuator, ...]  # its actuators, in the model's order


def robot_joints(robot: Model, scene: Model) -> RobotJoints:
    """Return the joints of a robot's bodies as they are in a scene, and the scene's actuators that act on these bodies."""
    model, bodies = scene.compiled, set(robot.bodies[1:])
    robot_ids = [i for i in range(model.njnt) if model.body(model.jnt_bodyid[i]).name in bodies]
    scalar_ids = [i for i in robot_ids if model.jnt_type[i] in (_SLIDE, _HINGE)]
    actuators, driven = [], []
    for i in range(model.nu):
        joints = [joint for joint in _joints_of(model, i) if joint in robot_ids]
        if joints or _bodies_of(model, i) & bodies:
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


def _joints_of(model: mujoco.MjModel, actuator: int) -> Sequence[int]:
    """Return the joints that an actuator acts on directly or by a fixed tendon."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in _JOINT_DRIVES:
        return [target]
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        return []
    path = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
    is_joint = model.wrap_type[path] == mujoco.mjtWrap.mjWRAP_JOINT
    return np.asarray(model.wrap_objid[path])[is_joint].tolist()


def _bodies_of(model: mujoco.MjModel, actuator: int) -> set[str]:
    """Return the bodies that an actuator without joints acts on: by sites, a spatial tendon, or adhesion."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind == mujoco.mjtTrn.mjTRN_BODY:
        results = [target]
    elif kind in _SITE_DRIVES:
        results = [int(model.site_bodyid[target])]
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
        path = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
        is_site = model.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE
        results = model.site_bodyid[np.asarray(model.wrap_objid[path])[is_site]].tolist()
    else:
        results = []
    return {model.body(i).name for i in results}
