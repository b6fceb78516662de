"""A hand that closes on an object: servos on its joints, what does not close held in place, the object between the fingers.

Nothing is asked of the hand's own actuators, which may be of any kind, act through tendons or not be there: they, springs and
dry friction rest. Each joint that closes has a servo whose force is limited to what presses with about `GRIP` times the
object's weight at the fingertips; so a joint that is loaded stops, however far its target is. Joints get the rotor inertia
that MuJoCo's soft contacts need to pass such forces on. The robot and the object weigh nothing, links do not collide with one
another, and the object moves as through oil, so that it waits for the last finger.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.errors import SimulationError, listed
from tgdsl.formats.model import Model
from tgdsl.module.module import TactileModule
from tgdsl.placement.propose.limits import angles_are_misread
from tgdsl.runtime.closing.moving import Movement, movement
from tgdsl.runtime.closing.place import OVERLAP, Sweep
from tgdsl.scene.mujoco_warnings import muted_mujoco
from tgdsl.scene.scene import SceneModels

START = "tgdsl/open"
"""The keyframe with the hand open."""
GRIP, MOST = 1.0, 10.0
"""Force at the fingertips: so many times the object's weight, but at most so much [N]."""
FIXED_GRIP = 1.0
"""The same where the object is fixed [N]."""
LAG = 0.2
"""By how much a hinge lags its target when its servo gives all it can [rad]; a slide by this times the hand's reach."""
TIP_MASS = 0.05
"""Least inertia of a fingertip as a joint moves it [kg]."""
SPEED = 0.2
"""How fast one finger pushes the object away [m/s]."""
STEPS = 0.3
"""Most that a servo's natural frequency turns in one physics step [rad]."""
NUM_GROUPS = 31
"""Groups of actuators that MuJoCo can disable, from 0; those in the next one always act."""
_EARTH = 9.81
_TORQUE_SCALE = 10


@dataclass(frozen=True)
class Servo:
    """A servo on a joint that closes.

    Attributes:
        joint: The joint's name.
        opened: Its open end [rad, of a slide m].
        closed: Its closed end.
        limit: Most force of the servo [N m, of a slide N].
        stiffness: Its stiffness [N m/rad, of a slide N/m].
        damping: The joint's damping [N m s/rad, of a slide N s/m].
        armature: The joint's rotor inertia [kg m², of a slide kg].
    """

    joint: str
    opened: float
    closed: float
    limit: float
    stiffness: float
    damping: float
    armature: float


class Closing:
    """How a scene's hand closes on an object.

    Attributes:
        target: The object's name.
        place: Where its body starts, in the world [m]; None: where the scene has it.
        servos: One for each joint that closes.
        num_joints: Number of the hand's joints.
        slack: Joints that follow those that close, by name.
        held: Hinges and slides that are held, by name.
        resting: Indices of actuators that rest.
        body: The object's body, if that is free.
        start: Positions of all joints at the start.
    """

    def __init__(self, moving: Movement, sweep: Sweep, target: str, place: Float[np.ndarray, " 3"] | None):
        model = moving.model
        force = min(GRIP * float(model.body_subtreemass[sweep.body]) * _EARTH, MOST) if sweep.is_free else FIXED_GRIP
        self.target, self.place, self.num_joints = target, place, moving.num_joints
        self.servos = tuple(_servo(moving, joint, force) for joint in moving.ends)
        self.slack = tuple(model.joint(joint).name for joint in moving.closing if joint not in moving.ends)
        self.held = tuple(model.joint(joint).name for joint in moving.held if moving.is_scalar(joint))
        self.resting = _acting(model, moving)
        self.body = model.body(sweep.body).name if sweep.is_free else None
        self.start = moving.pose(0.0)
        if place is not None:
            address = int(model.jnt_qposadr[model.body_jntadr[sweep.body]])
            self.start[address : address + 3] = place
        self._moving, self._drag = moving, force / SPEED

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Change a scene so that its hand can close: `BatchSimulation(touch, 1, prepare=closing.prepare, keyframe=START)`."""
        moving, model = self._moving, self._moving.model
        name_all(spec)
        for key in list(spec.keys):
            spec.delete(key)
        self._rest(spec)
        for servo in self.servos:
            _add_servo(spec, servo)
        for name in self.slack:
            _slacken(spec.joint(name))
        for name in self.held:
            spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=name)
        for joint in moving.held:
            if not moving.is_scalar(joint):  # a ball or free joint: its body is held where it starts relative to its parent
                body = model.body(model.jnt_bodyid[joint])
                weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
                weld.name1, weld.name2 = body.name, model.body(body.parentid[0]).name
                weld.data = np.where(np.arange(len(weld.data)) == _TORQUE_SCALE, 1.0, 0.0)  # a pose of zeros is the initial one
        for body in range(1, model.nbody):
            if int(model.body_rootid[body]) in moving.trees:
                spec.body(model.body(body).name).gravcomp = 1.0
        for name, other in _apart(moving):
            spec.add_exclude(bodyname1=name, bodyname2=other)
        if self.body is not None:
            spec.body(self.body).gravcomp = 1.0
            spec.body(self.body).joints[0].damping = [self._drag, 0, 0]
        spec.add_key(name=START, qpos=self.start, ctrl=self.targets(len(spec.actuators))[0])

    def targets(self, num_actuators: int) -> list[Float[np.ndarray, " actuator"]]:
        """Return the controls of the open and of the closed hand; the scene's own actuators come first and have zero."""
        rest = [0.0] * (num_actuators - len(self.servos))
        ends = [servo.opened for servo in self.servos], [servo.closed for servo in self.servos]
        return [np.array([*rest, *end]) for end in ends]

    def _rest(self, spec: mujoco.MjSpec) -> None:
        """Have actuators of the hand give no force, nor tendons that are sprung."""
        if self.resting:
            others = {int(actuator.group) for i, actuator in enumerate(spec.actuators) if i not in self.resting}
            group = _resting_group(int(spec.option.disableactuator), others)
            for i in self.resting:
                spec.actuators[i].group = group
            spec.option.disableactuator = int(spec.option.disableactuator) | 1 << group
        for tendon in spec.tendons:
            tendon.stiffness, tendon.frictionloss = [0, 0, 0], 0.0

    def __str__(self) -> str:
        where = "put between the fingers, weightless" if self.place is not None else "which stays where it is"
        return f"the hand closes on `{self.target}`, {where}; {len(self.servos)} of {self.num_joints} joints"


def closing_of(touch: TactileModule) -> Closing | str:
    """Return how the hand of a module's scene closes on the first object that it can close on, or why it does not.

    It warns of joints whose limits look like radians that were read as degrees: they hardly move.

    Raises:
        ArtifactError: If an asset of the scene is missing or has changed.
    """
    spec = SceneModels(touch.plan.scene, prepare=name_all).first()
    with muted_mujoco():
        scene = Model(Path(touch.plan.origin.robot), spec, spec.compile(), is_rounded=False)
    if angles_are_misread(scene.compiled):
        problem = f"{touch.plan.origin.robot}: no hinge turns by more than 2π degrees"
        warnings.warn(f'{problem}: is `angle="radian"` missing in its <compiler>? The hand hardly moves', stacklevel=2)
    links = {link.body for sensor in touch.plan.sensors for link in touch.plan.layout_of(sensor).links}
    moving = movement(scene, frozenset(links))
    if not moving.ends:
        is_stiff = not any(moving.is_scalar(joint) for joint in moving.joints)
        return "it has no hinge and no slide" if is_stiff else "which way its joints close is not clear"
    left = []
    for target in touch.plan.objects:
        sweep = Sweep(moving, int(scene.compiled.body(target.body).id))
        if int(scene.compiled.body_rootid[sweep.body]) in moving.trees:
            left.append(f"{target.name} is part of it")
            continue
        grip = sweep.grip()
        if (grip.holds and grip.overlap < OVERLAP * sweep.radius) or (not sweep.is_free and len(grip.links) > 0):
            return Closing(moving, sweep, target.name, None)
        if not sweep.is_free:
            left.append(f"{target.name} is fixed out of its reach")
        elif (place := sweep.place()) is not None:
            return Closing(moving, sweep, target.name, place)
        else:
            left.append(f"{target.name} does not fit between its fingers")
    return listed(left) or "there is no object"


def name_all(spec: mujoco.MjSpec) -> None:
    """Name bodies and joints that have no name."""
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints)):
        for i, element in enumerate(elements):
            element.name = element.name or f"tgdsl/{kind}/{i}"


def _servo(moving: Movement, joint: int, force: float) -> Servo:
    """Return the servo of a joint that presses with a force at the fingertips, stable at the scene's timestep."""
    model, (opened, closed) = moving.model, moving.ends[joint]
    reach = _reach(moving, joint)
    force *= 1 + _num_beyond(moving, joint)  # each joint bears what those beyond it press with
    is_slide = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    lever, lag = (1.0, LAG * reach) if is_slide else (reach, LAG)
    dof = int(model.jnt_dofadr[joint])
    armature = TIP_MASS * reach**2 if not is_slide else TIP_MASS
    link_inertia = 1.0 / max(float(model.dof_invweight0[dof]), 1e-9) - float(model.dof_armature[dof])
    inertia = armature + max(link_inertia, 0.0)
    stiffness = min(force * lever / lag, armature * (STEPS / float(model.opt.timestep)) ** 2)
    damping = 2.0 * np.sqrt(stiffness * inertia)
    return Servo(model.joint(joint).name, opened, closed, force * lever, float(stiffness), float(damping), armature)


def _reach(moving: Movement, joint: int) -> float:
    """Return how far the fingertips below a joint are from it, at most, with the hand open [m]."""
    model = moving.model
    data = mujoco.MjData(model)
    data.qpos[:] = moving.pose(0.0)
    mujoco.mj_kinematics(model, data)
    below = [tip for tip in moving.tips if int(model.jnt_bodyid[joint]) in moving.path(tip)]
    geoms = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in below]
    return max((float(np.linalg.norm(data.geom_xpos[geom] - data.xanchor[joint])) for geom in geoms), default=0.0) + 0.005


def _num_beyond(moving: Movement, joint: int) -> int:
    """Return the most joints that close beyond one on the way to a fingertip."""
    closing = {int(moving.model.jnt_bodyid[other]) for other in moving.closing}
    body = int(moving.model.jnt_bodyid[joint])
    paths = [moving.path(tip) for tip in moving.tips]
    return max((len(closing & set(path[: path.index(body)])) for path in paths if body in path), default=0)


def _apart(moving: Movement) -> tuple[tuple[str, str], ...]:
    """Return the pairs of the robot's bodies that could collide.

    Fingers that meet before they meet the object would hold each other off it; and MuJoCo collides a link with its parent
    where that is fixed to the world, although both are made to overlap at the joint.
    """
    model = moving.model
    known = {int(signature) for signature in model.exclude_signature}
    bodies = [b for b in range(1, model.nbody) if int(model.body_rootid[b]) in moving.trees and model.body_geomnum[b]]
    pairs = [(a, b) for a, b in combinations(bodies, 2) if (a << 16) + b not in known]
    return tuple((model.body(a).name, model.body(b).name) for a, b in pairs if model.body_weldid[a] != model.body_weldid[b])


def _acting(model: mujoco.MjModel, moving: Movement) -> tuple[int, ...]:
    """Return the actuators that act on the joints of a hand's trees, with the hand open."""
    data = mujoco.MjData(model)
    data.qpos[:] = moving.pose(0.0)
    mujoco.mj_fwdPosition(model, data)
    moments = np.zeros((model.nu, model.nv))
    if model.nu:
        mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    is_hand = np.isin(model.dof_jntid, moving.joints)
    return tuple(np.flatnonzero((moments[:, is_hand] != 0).any(axis=1)).tolist())


def _add_servo(spec: mujoco.MjSpec, servo: Servo) -> None:
    joint = spec.joint(servo.joint)
    _slacken(joint)
    joint.damping, joint.armature = [servo.damping, 0, 0], servo.armature
    actuator = spec.add_actuator(
        name=f"tgdsl/{servo.joint}", target=servo.joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, group=NUM_GROUPS
    )
    # Nothing of the scene's own <default> for actuators: neither gear nor a range.
    actuator.gear, actuator.inheritrange = [1, 0, 0, 0, 0, 0], 0.0
    actuator.ctrllimited = actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.set_to_position(kp=servo.stiffness)
    actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-servo.limit, servo.limit]


def _slacken(joint: mujoco.MjsJoint) -> None:
    """Free a joint of springs, friction and limits of its force."""
    joint.stiffness, joint.damping, joint.frictionloss = [0, 0, 0], [0, 0, 0], 0.0
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _resting_group(disabled: int, others: set[int]) -> int:
    """Return a group of actuators that is disabled already, by the bits of `disableactuator`, or that no other is in."""
    groups = [group for group in range(NUM_GROUPS) if disabled >> group & 1 or group not in others]
    if not groups:
        problem = f"the scene's actuators that are not the hand's are in all {NUM_GROUPS} groups"
        raise SimulationError(
            f"{problem}, and the hand's have to rest in one; leave one of the groups 0 to {NUM_GROUPS - 1} free"
        )
    return groups[0]
