"""A hand that closes on an object: servos close its joints, the rest is fixed, the object is between the fingers.

The hand's own actuators may be of any kind, act through tendons or be absent: they, springs and dry friction are disabled. Each
closing joint gets a servo. Its force limit presses the fingertips with about `GRIP` times the object's weight, so a loaded
joint stops, however far its target is. Joints get the rotor inertia that MuJoCo's soft contacts need to transmit such forces.
The robot and the object weigh nothing, links do not collide with one another, and viscous drag holds the object until the last
finger arrives.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.errors import SimulationError, listed
from tgdsl.formats.model import Model
from tgdsl.module.module import TactileModule
from tgdsl.placement.propose.hands import angles_are_misread
from tgdsl.placement.propose.propose import closing_motion
from tgdsl.scene.mujoco_warnings import muted_mujoco
from tgdsl.scene.scene import SceneModels

START = "tgdsl/open"  # the keyframe with the hand open
SERVO = "tgdsl/servo/"  # begins the names of the actuators that close the hand
SHARES = np.linspace(0.0, 1.0, 9)  # how far the hand is closed: where its tips are tried, and where touch is looked for
TOWARD_PALM = (0.0, 0.2, 0.4, 0.6, -0.25, -0.5)  # how far from the tips' middle to the palm a place is tried
OPPOSED = -0.3  # two links that touch an object oppose each other if the cosine between their directions is less than this
OVERLAP = 0.1  # how deep an object may lie in the open hand where it is left, as a share of its radius
GRIP, MOST = 1.0, 10.0  # force at the fingertips: so many times the object's weight, but at most so much [N]
FIXED_GRIP = 1.0  # the same where the object is fixed [N]
LAG = 0.2  # by how much a hinge lags its target when its servo gives all it can [rad]; a slide by this times the hand's reach
TIP_MASS = 0.05  # least inertia of a fingertip as a joint moves it [kg]
SPEED = 0.2  # how fast one finger pushes the object away [m/s]
STEPS = 0.3  # most that a servo's natural frequency turns in one physics step [rad]
NUM_GROUPS = 31  # groups of actuators that MuJoCo can disable, from 0; those in the next one always act
_EARTH = 9.81
_TORQUE_SCALE = 10
_SCALAR = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_UNBOUNDED = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


class Movement:
    """How the hand of a scene moves whose `bodies` carry sensors; nothing closes if it is not clear how.

    Joints and bodies are MuJoCo's indices.

    Attributes:
        trees: Topmost bodies of the kinematic trees that carry taxels.
        paths: By body, it and all above it but the world, upward.
        joints: All joints of the trees.
        ends: Open and closed end of each joint that closes the hand and follows no other such joint [rad, of slides m].
        closing: Joints that close the hand and their followers, each after its leader.
        held: Joints of the trees that neither close the hand nor follow or lead another that does, nor are in a closed loop.
        hand: Bodies of the smallest subtrees, one of each tree, that hold all that closes; an arm is none of them.
        tips: Bodies with geoms below the joints that close, which have no other such below them.
    """

    def __init__(self, scene: Model, bodies: frozenset[str]):
        model = self.model = scene.compiled
        self.paths: list[list[int]] = [[]]
        for body in range(1, model.nbody):
            self.paths.append([body, *self.paths[model.body_parentid[body]]])
        self.body_of: list[int] = model.jnt_bodyid.tolist()
        root_of: list[int] = model.body_rootid[model.jnt_bodyid].tolist()
        self.trees = frozenset(int(model.body_rootid[model.body(name).id]) for name in bodies) - {0}
        self.joints = tuple(joint for joint in range(model.njnt) if root_of[joint] in self.trees)
        # By follower joint of an equality: its leader, and the polynomial's coefficients.
        self._follows: dict[int, tuple[int, Float[np.ndarray, " 5"]]] = {}
        for i in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & model.eq_active0.astype(bool)):
            if (leader := int(model.eq_obj2id[i])) >= 0:
                self._follows[int(model.eq_obj1id[i])] = leader, model.eq_data[i, :5].copy()
        ends = {int(model.joint(name).id): pair for name, pair in closing_motion(scene).items()}
        ends = {joint: pair for joint, pair in ends.items() if root_of[joint] in self.trees}
        self.ends = {joint: pair for joint, pair in ends.items() if not {*self._leaders(joint)} & ends.keys()}
        followers = [joint for joint in self._follows if {*self._leaders(joint)} & self.ends.keys()]
        self.closing = (*self.ends, *sorted(followers, key=lambda joint: len(self._leaders(joint))))
        coupled = {*self.ends, *self._follows, *(leader for joint in self.ends for leader in self._leaders(joint))}
        looped = self._looped()
        self.held = tuple(joint for joint in self.joints if joint not in coupled and self.body_of[joint] not in looped)
        moved = {self.body_of[joint] for joint in self.closing}
        hand: set[int] = set()
        for tree in {root_of[joint] for joint in self.closing}:
            common = set.intersection(*(set(self.paths[body]) for body in moved if self.paths[body][-1] == tree))
            above = max(common - moved, default=tree)
            hand |= {body for body, path in enumerate(self.paths) if above in path}
        self.hand = frozenset(hand)
        below = {b for b, path in enumerate(self.paths) if model.body_geomnum[b] and moved & set(path)}
        self.tips = tuple(sorted(below - {above for body in below for above in self.paths[body][1:]}))

    @property
    def num_joints(self) -> int:
        """Number of the hand's hinges and slides; followers count only if they close it."""
        counted = [joint for joint in self.joints if joint in self.ends or joint not in self._follows]
        return sum(self.is_scalar(joint) and self.body_of[joint] in self.hand for joint in counted)

    def pose(self, share: float) -> Float[np.ndarray, " qpos"]:
        """Return where the joints are when the hand has closed by a share; all else is at its start."""
        result, start, address = self.model.qpos0.copy(), self.model.qpos0, self.model.jnt_qposadr
        for joint, (opened, closed) in self.ends.items():
            result[address[joint]] = (1.0 - share) * opened + share * closed
        for joint in self.closing[len(self.ends) :]:
            leader, coefficients = self._follows[joint]
            moved = result[address[leader]] - start[address[leader]]
            result[address[joint]] += np.polynomial.polynomial.polyval(moved, coefficients)
        return result

    def is_scalar(self, joint: int) -> bool:
        """Return whether a joint is a hinge or a slide."""
        return int(self.model.jnt_type[joint]) in _SCALAR

    def _leaders(self, joint: int) -> list[int]:
        """Return the joint that one follows, the one that this follows, and so on."""
        results: list[int] = []
        while joint in self._follows and self._follows[joint][0] not in results:
            joint = self._follows[joint][0]
            results.append(joint)
        return results

    def _looped(self) -> set[int]:
        """Return the bodies between two that an equality holds together, and where their paths upward meet."""
        model, result = self.model, set[int]()
        for i in np.flatnonzero(np.isin(model.eq_type, _LOOPS) & model.eq_active0.astype(bool)):
            ids = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
            if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
                ids = int(model.site_bodyid[ids[0]]), int(model.site_bodyid[ids[1]])
            one, two = (set(self.paths[max(body, 0)]) for body in ids)
            result |= (one ^ two) if one and two else set()
        return result


class Grip(NamedTuple):
    """What a hand that closes meets of an object, at the first share at which each link does."""

    overlap: float  # how deep the object lies in the open hand [m]; negative: how far it is from it
    links: frozenset[int]  # bodies that meet it
    is_opposed: bool  # whether two of these do so from opposite sides
    imbalance: float  # length of the mean of the directions from which they do


class Sweep:
    """A hand that closes on an object, pose by pose."""

    def __init__(self, movement: Movement, body: int):
        self.movement, self.model, self.body = movement, movement.model, body
        self.data = mujoco.MjData(self.model)
        self.is_free = int(self.model.body_dofnum[body]) == 6 and int(self.model.body_jntnum[body]) == 1
        weld = self.model.body_weldid
        rigid = [b for b in range(self.model.nbody) if weld[b] == weld[body] and body in (*movement.paths[b], 0)]
        self.object_geoms = [geom for b in rigid for geom in self._touchable(b)]
        self.hand_geoms = [geom for b in sorted(movement.hand) for geom in self._touchable(b)]
        self._pose(0.0)
        offsets = [self.data.geom_xpos[geom] - self.data.xpos[body] for geom in self.object_geoms]
        self._middle = self._rotation().T @ np.mean(offsets, axis=0) if offsets else np.zeros(3)
        reach = [np.linalg.norm(p - np.mean(offsets, axis=0)) for p in offsets]
        self.radius = max((r + self.model.geom_rbound[g] for r, g in zip(reach, self.object_geoms, strict=True)), default=0.0)

    def place(self) -> Float[np.ndarray, " 3"] | None:
        """Return where the object's frame lies for a grip as good as any, in the world [m]; None if nowhere clear of the hand.

        It tries the middle of all fingertips first. An object that cannot be held there, for example one smaller than the
        gaps, goes between one fingertip and the palm, or between two.
        """
        best, result = (False, 0, -np.inf), None
        tips = self.movement.tips
        for among in ([tips], [*((tip,) for tip in tips), *combinations(tips, 2)]):
            for candidate in self._candidates(among):
                origin = candidate - self._rotation() @ self._middle
                grip = self.grip(origin)
                value = grip.is_opposed, len(grip.links), -grip.imbalance
                if grip.overlap <= 0 and grip.links and value > best:
                    best, result = value, origin
            if best[0]:
                break
        return result

    def grip(self, origin: Float[np.ndarray, " 3"] | None = None) -> Grip:
        """Return the closing hand's contacts, with the object's frame at `origin` in the world [m] or where it starts."""
        sides: dict[int, np.ndarray] = {}
        overlap = -np.inf
        for share in SHARES:
            self._pose(float(share), origin)
            middle = self.data.xpos[self.body] + self._rotation() @ self._middle
            for geom in self.hand_geoms:
                link = int(self.model.geom_bodyid[geom])
                away = np.linalg.norm(self.data.geom_xpos[geom] - middle) - self.model.geom_rbound[geom]
                if link in sides or (share > 0 and away > self.radius):
                    continue
                gap, point = self._gap(geom)
                overlap = max(overlap, -gap) if share == 0 else overlap
                if gap < 0:
                    sides[link] = (point - middle) / max(float(np.linalg.norm(point - middle)), 1e-9)
        ways = np.array(list(sides.values())).reshape(-1, 3)
        is_opposed = bool(len(ways) and (ways @ ways.T).min() < OPPOSED)
        imbalance = float(np.linalg.norm(ways.mean(axis=0))) if len(ways) else 1.0
        return Grip(float(overlap), frozenset(sides), is_opposed, imbalance)

    def _candidates(self, among: Sequence[Sequence[int]]) -> list[Float[np.ndarray, " 3"]]:
        """Return places between fingertips, and from there toward the palm, while the hand closes."""

        def middle_of(body: int) -> Float[np.ndarray, " 3"]:
            geoms = self._touchable(body)
            return np.mean(self.data.geom_xpos[geoms], axis=0) if geoms else self.data.xpos[body]

        results = []
        base = [b for b in sorted(self.movement.hand) if self._touchable(b)]
        for share in SHARES:
            self._pose(float(share))
            for bodies in among:
                tips = np.mean([middle_of(body) for body in bodies], axis=0)
                palm = middle_of(base[0]) if base[0] not in self.movement.tips else tips
                results += [(1.0 - toward) * tips + toward * palm for toward in TOWARD_PALM]
        return results

    def _rotation(self) -> Float[np.ndarray, "3 3"]:
        return self.data.xmat[self.body].reshape(3, 3)

    def _gap(self, geom: int) -> tuple[float, Float[np.ndarray, " 3"]]:
        """Return the distance of a geom from the object [m], and the object's nearest point."""
        best, point, ends = 1.0, np.zeros(3), np.zeros(6)
        for other in self.object_geoms:
            gap = mujoco.mj_geomDistance(self.model, self.data, other, geom, 1.0, ends)
            if gap < best:
                best, point = gap, ends[:3].copy()
        return best, point

    def _pose(self, share: float, origin: Float[np.ndarray, " 3"] | None = None) -> None:
        self.data.qpos[:] = self.movement.pose(share)
        if origin is not None and self.is_free:
            address = int(self.model.jnt_qposadr[self.model.body_jntadr[self.body]])
            self.data.qpos[address : address + 3] = origin
        mujoco.mj_kinematics(self.model, self.data)

    def _touchable(self, body: int) -> list[int]:
        first, num = int(self.model.body_geomadr[body]), int(self.model.body_geomnum[body])
        geoms = [geom for geom in range(first, first + num) if int(self.model.geom_type[geom]) not in _UNBOUNDED]
        return [geom for geom in geoms if self.model.geom_contype[geom] or self.model.geom_conaffinity[geom]] or geoms


class Servo(NamedTuple):
    """A servo on a joint that closes."""

    joint: str  # the joint's name
    opened: float  # its open end [rad, of a slide m]
    closed: float  # its closed end
    limit: float  # most force of the servo [N m, of a slide N]
    stiffness: float  # its stiffness [N m/rad, of a slide N/m]
    damping: float  # the joint's damping [N m s/rad, of a slide N s/m]
    armature: float  # the joint's rotor inertia [kg m², of a slide kg]


class Closing:
    """How a scene's hand closes on an object.

    Attributes:
        target: The object's name.
        place: Where its body starts, in the world [m]; None: where the scene has it.
        servos: One for each joint that closes.
        slack: Followers of the closing joints, by name.
        held: Hinges and slides that are held, by name.
        resting: Indices of actuators that rest.
        body: The object's body, if that is free.
        start: Positions of all joints at the start.
    """

    def __init__(self, moving: Movement, sweep: Sweep, target: str, place: Float[np.ndarray, " 3"] | None):
        model = moving.model
        force = min(GRIP * float(model.body_subtreemass[sweep.body]) * _EARTH, MOST) if sweep.is_free else FIXED_GRIP
        self.target, self.place, self.num_joints = target, place, moving.num_joints
        self.start = moving.pose(0.0)
        opened = mujoco.MjData(model)
        opened.qpos[:] = self.start
        mujoco.mj_fwdPosition(model, opened)
        self.servos = tuple(_servo(moving, opened, joint, force) for joint in moving.ends)
        self.slack = tuple(model.joint(joint).name for joint in moving.closing if joint not in moving.ends)
        self.held = tuple(model.joint(joint).name for joint in moving.held if moving.is_scalar(joint))
        self.resting = _acting(moving, opened)
        self.body = model.body(sweep.body).name if sweep.is_free else None
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
        robot = [body for body in range(1, model.nbody) if int(model.body_rootid[body]) in moving.trees]
        for body in robot:
            spec.body(model.body(body).name).gravcomp = 1.0
        # Fingers that meet before they meet the object would hold each other off it; and MuJoCo collides a link with its
        # parent where that is fixed to the world, although both overlap at the joint by design.
        excluded = {int(signature) for signature in model.exclude_signature}
        for a, b in combinations([body for body in robot if model.body_geomnum[body]], 2):
            if (a << 16) + b not in excluded and model.body_weldid[a] != model.body_weldid[b]:
                spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)
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
            in_use = {int(actuator.group) for i, actuator in enumerate(spec.actuators) if i not in self.resting}
            disabled = int(spec.option.disableactuator)
            free = [group for group in range(NUM_GROUPS) if disabled >> group & 1 or group not in in_use]
            if not free:
                problem = f"the scene's actuators that are not the hand's are in all {NUM_GROUPS} groups"
                advice = f"leave one of the groups 0 to {NUM_GROUPS - 1} free"
                raise SimulationError(f"{problem}, and the hand's have to rest in one; {advice}")
            for i in self.resting:
                spec.actuators[i].group = free[0]
            spec.option.disableactuator = disabled | 1 << free[0]
        for tendon in spec.tendons:
            tendon.stiffness, tendon.frictionloss = [0, 0, 0], 0.0

    def __str__(self) -> str:
        where = "put between the fingers, without gravity" if self.place is not None else "where the scene has it"
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
    moving = Movement(scene, frozenset(links))
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
        holds = len(grip.links) > 1 and grip.is_opposed
        if (holds and grip.overlap < OVERLAP * sweep.radius) or (not sweep.is_free and len(grip.links) > 0):
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


def _servo(moving: Movement, opened: mujoco.MjData, joint: int, force: float) -> Servo:
    """Return the servo of a joint that presses with a force at the fingertips, stable at the scene's timestep."""
    model, body = moving.model, moving.body_of[joint]
    below = [tip for tip in moving.tips if body in moving.paths[tip]]
    geoms = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in below]
    distances = (float(np.linalg.norm(opened.geom_xpos[geom] - opened.xanchor[joint])) for geom in geoms)
    reach = max(distances, default=0.0) + 0.005  # of the fingertips, with the hand open [m]
    closing = {moving.body_of[other] for other in moving.closing}
    paths = [moving.paths[tip] for tip in below]
    force *= 1 + max((len(closing & set(path[: path.index(body)])) for path in paths), default=0)  # of those beyond it too
    is_slide = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    lever, lag = (1.0, LAG * reach) if is_slide else (reach, LAG)
    dof = int(model.jnt_dofadr[joint])
    armature = TIP_MASS * reach**2 if not is_slide else TIP_MASS
    link_inertia = 1.0 / max(float(model.dof_invweight0[dof]), 1e-9) - float(model.dof_armature[dof])
    inertia = armature + max(link_inertia, 0.0)
    stiffness = min(force * lever / lag, armature * (STEPS / float(model.opt.timestep)) ** 2)
    damping = 2.0 * np.sqrt(stiffness * inertia)
    return Servo(model.joint(joint).name, *moving.ends[joint], force * lever, float(stiffness), float(damping), armature)


def _acting(moving: Movement, opened: mujoco.MjData) -> tuple[int, ...]:
    """Return the actuators that act on the joints of a hand's trees, with the hand open."""
    model = moving.model
    moments = np.zeros((model.nu, model.nv))
    if model.nu:
        mujoco.mju_sparse2dense(
            moments, opened.actuator_moment, opened.moment_rownnz, opened.moment_rowadr, opened.moment_colind
        )
    is_hand = np.isin(model.dof_jntid, moving.joints)
    return tuple(np.flatnonzero((moments[:, is_hand] != 0).any(axis=1)).tolist())


def _add_servo(spec: mujoco.MjSpec, servo: Servo) -> None:
    joint = spec.joint(servo.joint)
    _slacken(joint)
    joint.damping, joint.armature = [servo.damping, 0, 0], servo.armature
    name, kind = f"{SERVO}{servo.joint}", mujoco.mjtTrn.mjTRN_JOINT
    actuator = spec.add_actuator(name=name, target=servo.joint, trntype=kind, group=NUM_GROUPS)
    # Nothing of the scene's own <default> for actuators: neither gear nor a range.
    actuator.gear, actuator.inheritrange = [1, 0, 0, 0, 0, 0], 0.0
    actuator.ctrllimited = actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.set_to_position(kp=servo.stiffness)
    actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-servo.limit, servo.limit]


def _slacken(joint: mujoco.MjsJoint) -> None:
    joint.stiffness, joint.damping, joint.frictionloss = [0, 0, 0], [0, 0, 0], 0.0
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
