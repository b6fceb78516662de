"""MuJoCo's joints and servos as USD's joints and drives; the angle of a USD joint is MuJoCo's `qpos`.

A USD joint holds a frame on each of its two bodies and turns about, or slides along, the common x axis. With T the child's
pose in its parent at `qpos0` (as MuJoCo keeps it), L1 the frame on the child (at the joint's anchor, x along its axis) and M(q)
the joint's own motion, the frame on the parent is L0 = T L1 M(-qpos0), so that the child stands at L0 M(q) L1⁻¹.

A USD joint has no damping, but its drive has: the drive's damping is the servo's plus the joint's, and `tgdsl:damping` holds
the joint's share. A damped joint without a servo has a drive without stiffness.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats.usd import attributes as attr
from tgdsl.formats.usd.joints import Drive
from tgdsl.formats.usd.stage import usd_modules

JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
NO_DYNAMICS, FIXED_GAIN = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtGain.mjGAIN_FIXED)
AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_AFFINE)
SCHEMAS = {attr.BALL: "SphericalJoint", attr.SLIDE: "PrismaticJoint", attr.HINGE: "RevoluteJoint"}


def add_joint(writer: attr.StageWriter, body: int, collides: bool) -> None:
    """Write the joint of a body to its parent; none if it floats freely or is placed by the user (mocap)."""
    model, count = writer.model, int(writer.model.body_jntnum[body])
    if count > 1:
        raise RobotError(
            f'{writer.file}: body "{writer.body_name(body)}" has {count} joints, and a body in USD has one to its parent; '
            "give each joint a separate body"
        )
    joint = int(model.body_jntadr[body]) if count else -1
    kind = int(model.jnt_type[joint]) if joint >= 0 else -1
    if kind == attr.FREE or model.body_mocapid[body] >= 0:
        if joint >= 0:
            attr.set_custom(writer.stage.GetPrimAtPath(writer.bodies[body]), "freejoint", model.joint(joint).name)
        return
    name = model.joint(joint).name if joint >= 0 else ""
    physics = usd_modules().UsdPhysics
    path = writer.path(writer.scope, name or f"{writer.body_name(body)}_{'fixed' if joint < 0 else 'joint'}")
    usd_joint = getattr(physics, SCHEMAS.get(kind, "FixedJoint")).Define(writer.stage, path)
    attr.set_custom(usd_joint.GetPrim(), "name", name)
    parent = int(model.body_parentid[body])
    if parent:  # a joint without its first body holds the second in the world
        usd_joint.CreateBody0Rel().SetTargets([writer.bodies[parent]])
    usd_joint.CreateBody1Rel().SetTargets([writer.bodies[body]])
    if collides:
        usd_joint.CreateCollisionEnabledAttr(True)
    _frames(writer, body, joint, usd_joint)
    if joint < 0:
        return
    if kind in (attr.SLIDE, attr.HINGE):
        usd_joint.CreateAxisAttr("X")
        low, high = model.jnt_range[joint].tolist() if model.jnt_limited[joint] else (-math.inf, math.inf)
        unit = math.degrees(1.0) if kind == attr.HINGE else 1.0
        attr.set_number(usd_joint.CreateLowerLimitAttr(), low * unit)
        attr.set_number(usd_joint.CreateUpperLimitAttr(), high * unit)
    _passive(model, joint, usd_joint.GetPrim())
    writer.joints[joint] = usd_joint


def _frames(writer: attr.StageWriter, body: int, joint: int, usd_joint: Any) -> None:
    model = writer.model
    pos, turn = np.zeros(3), Rotation.identity()
    kind = int(model.jnt_type[joint]) if joint >= 0 else -1
    if joint >= 0:
        pos = model.jnt_pos[joint]
    if kind in (attr.SLIDE, attr.HINGE):
        turn = _x_to(model.jnt_axis[joint])
    child = Rotation.from_quat(model.body_quat[body], scalar_first=True)
    parent_pos, parent_turn = model.body_pos[body] + child.apply(pos), child * turn
    rest = float(model.qpos0[model.jnt_qposadr[joint]]) if kind in (attr.SLIDE, attr.HINGE) else 0.0
    if kind == attr.SLIDE:
        parent_pos = parent_pos - parent_turn.apply([rest, 0.0, 0.0])
    elif kind == attr.HINGE:
        parent_turn = parent_turn * Rotation.from_rotvec([-rest, 0.0, 0.0])
    for number, (place, rotation) in enumerate(((parent_pos, parent_turn), (pos, turn))):
        quat = rotation.as_quat(canonical=True, scalar_first=True)
        attr.set_number(getattr(usd_joint, f"CreateLocalPos{number}Attr")(), attr.rounded(place))
        attr.set_number(getattr(usd_joint, f"CreateLocalRot{number}Attr")(), attr.rounded(quat))


def _x_to(axis: np.ndarray) -> Rotation:
    start = np.array([1.0 if axis[0] >= 0 else -1.0, 0.0, 0.0])
    turn = Rotation.from_quat([1.0 + start @ axis, *np.cross(start, axis)], scalar_first=True)
    return turn if axis[0] >= 0 else turn * Rotation.from_quat([0.0, 0.0, 0.0, 1.0], scalar_first=True)


def _passive(model: mujoco.MjModel, joint: int, prim: Any) -> None:
    """Write a joint's armature, dry friction and damping, in SI units; of the first two PhysX has attributes, USD has none."""
    first = int(model.jnt_dofadr[joint])
    for prefix, index in (("jnt", joint), ("dof", first)):
        rows = {name: row for name, row in attr.JOINT.items() if row.array.startswith(prefix)}
        attr.set_customs(prim, rows, model, attr.default_model(), index)
    start = float(model.qpos0[model.jnt_qposadr[joint]])
    if start and model.jnt_type[joint] in (attr.SLIDE, attr.HINGE):
        attr.set_custom(prim, "ref", start)
    if model.jnt_stiffness[joint] and model.jnt_type[joint] in (attr.SLIDE, attr.HINGE):
        attr.set_custom(prim, "springref", float(model.qpos_spring[model.jnt_qposadr[joint]]))
    if model.jnt_type[joint] == attr.BALL and model.jnt_limited[joint]:
        attr.set_custom(prim, "range", model.jnt_range[joint].tolist())
    physx = {"armature": model.dof_armature[first], "jointFriction": model.dof_frictionloss[first]}
    if any(physx.values()):
        prim.AddAppliedSchema("PhysxJointAPI")  # Omniverse reads the attributes only of a prim that says so
    for key, value in physx.items():
        if value:
            attribute = prim.CreateAttribute(f"physxJoint:{key}", usd_modules().Sdf.ValueTypeNames.Float, custom=True)
            attr.set_number(attribute, value)
    damping = float(model.dof_damping[first])
    if damping:
        attr.set_custom(prim, "damping", damping)
    if damping and model.jnt_type[joint] in (attr.SLIDE, attr.HINGE):
        _drive(model, joint, Drive(0.0, 0.0, math.inf), prim)


def add_drives(writer: attr.StageWriter) -> list[int]:
    """Write actuators as USD drives where possible; return the others, which need actuator prims."""
    model, joints, driven = writer.model, writer.joints, dict[int, int]()
    for actuator in range(model.nu):
        servo, joint = _servo(model, actuator), int(model.actuator_trnid[actuator, 0])
        if servo is None or joint in driven:
            continue
        driven[joint] = actuator
        _drive(model, joint, servo, joints[joint].GetPrim())
        attr.set_custom(joints[joint].GetPrim(), "actuator", model.actuator(actuator).name)
    left = [actuator for actuator in range(model.nu) if actuator not in driven.values()]
    if left or list(driven) != sorted(driven):
        for joint, actuator in driven.items():
            attr.set_custom(joints[joint].GetPrim(), "order", actuator)
    for joint in joints:
        if model.jnt_actfrclimited[joint]:
            attr.set_custom(joints[joint].GetPrim(), "actuatorfrcrange", model.jnt_actfrcrange[joint].tolist())
            if joint in driven and model.actuator_forcelimited[driven[joint]]:
                attr.set_custom(joints[joint].GetPrim(), "forcerange", model.actuator_forcerange[driven[joint]].tolist())
    return left


def _servo(model: mujoco.MjModel, actuator: int) -> Drive | None:
    """Return an actuator as a servo, or None if it is none."""
    kinds = (model.actuator_dyntype[actuator], model.actuator_gaintype[actuator], model.actuator_biastype[actuator])
    if kinds != (NO_DYNAMICS, FIXED_GAIN, AFFINE_BIAS) or model.actuator_trntype[actuator] not in JOINT_TRANSMISSIONS:
        return None
    joint = int(model.actuator_trnid[actuator, 0])
    if model.jnt_type[joint] not in (attr.SLIDE, attr.HINGE):
        return None
    gain, gear = float(model.actuator_gainprm[actuator, 0]), float(model.actuator_gear[actuator, 0])
    offset, stiffness, damping = (0.0 - model.actuator_biasprm[actuator, :3]).tolist()
    is_position, is_velocity = stiffness == gain, stiffness == 0 and damping == gain
    low, high = model.actuator_forcerange[actuator].tolist()
    more = (model.actuator_delay, model.actuator_history, model.actuator_armature, model.actuator_damping)
    if (model.actuator_forcelimited[actuator] and low != -high) or any(np.any(array[actuator]) for array in more):
        return None
    if offset or gain <= 0 or not gear or not (is_position or is_velocity):
        return None
    limits = [abs(gear) * np.abs(model.actuator_forcerange[actuator]).max()] if model.actuator_forcelimited[actuator] else []
    limits += [np.abs(model.jnt_actfrcrange[joint]).max()] if model.jnt_actfrclimited[joint] else []
    low, high = sorted((model.actuator_ctrlrange[actuator] / gear + 0.0).tolist())
    return Drive(
        stiffness=stiffness * gear**2,
        damping=damping * gear**2,
        max_force=float(min(limits, default=math.inf)),
        control=(low, high) if model.actuator_ctrllimited[actuator] else None,
        gear=gear,
    )


def _drive(model: mujoco.MjModel, joint: int, servo: Drive, prim: Any) -> None:
    """Write a servo as a joint's drive, or write it over the drive that is there."""
    is_hinge = model.jnt_type[joint] == attr.HINGE
    unit = math.radians(1.0) if is_hinge else 1.0  # an angular drive counts in degrees
    drive = usd_modules().UsdPhysics.DriveAPI.Apply(prim, "angular" if is_hinge else "linear")
    drive.CreateTypeAttr("force")
    attr.set_number(drive.CreateStiffnessAttr(), servo.stiffness * unit)
    attr.set_number(drive.CreateDampingAttr(), (servo.damping + float(model.dof_damping[model.jnt_dofadr[joint]])) * unit)
    attr.set_number(drive.CreateMaxForceAttr(), servo.max_force)
    if servo.control:
        attr.set_custom(prim, "ctrlrange", servo.control)
    if servo.gear != 1.0:
        attr.set_custom(prim, "gear", servo.gear)
