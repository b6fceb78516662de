"""A hand that closes on an object: servos on its joints, what does not close held in place, the object between the fingers.

Nothing is asked of the hand's own actuators, which may be of any kind, act through tendons or not be there: they, springs and
dry friction rest. Each joint that closes has a servo whose force is limited to what presses with about `GRIP` times the
object's weight at the fingertips; so a joint that is loaded stops, however far its target is. Joints get the rotor inertia
that MuJoCo's soft contacts need to pass such forces on. The robot and the object weigh nothing, links do not collide with one
another, and the object moves as through oil, so that it waits for the last finger.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.errors import SimulationError, listed
from tgdsl.formats.model import Model
from tgdsl.module.module import TactileModule
from tgdsl.placement.propose.limits import angles_are_misread
from tgdsl.placement.propose.propose import closing_motion
from tgdsl.scene.mujoco_warnings import muted_mujoco
from tgdsl.scene.scene import SceneModels

_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


@dataclass(frozen=True, eq=False)
class Movement:
    """How the hand of a scene moves.

    Shapes: joints and bodies are MuJoCo's indices.
    """

    model: mujoco.MjModel  # the scene
    trees: frozenset[int]  # topmost bodies of the kinematic trees that carry taxels
    # open and closed end of each joint that closes the hand and follows no other such joint [rad, of slides m]
    ends: Mapping[int, tuple[float, float]]
    # by joint, those that an equality has follow another: that one, and the polynomial's coefficients
    follows: Mapping[int, tuple[int, Float[np.ndarray, " 5"]]]

    @cached_property
    def closing(self) -> tuple[int, ...]:
        """Joints that close the hand, those that follow such included: each after the one that it follows."""
        followers = [joint for joint in self.follows if set(leaders(joint, self.follows)) & self.ends.keys()]
        return (*self.ends, *sorted(followers, key=lambda joint: len(leaders(joint, self.follows))))

    @cached_property
    def hand(self) -> frozenset[int]:
        """Bodies of the smallest subtrees, one of each tree, that hold all that closes; an arm is none of them."""
        result: set[int] = set()
        for tree in {self._root(joint) for joint in self.closing}:
            paths = [self.path(int(self.model.jnt_bodyid[joint])) for joint in self.closing if self._root(joint) == tree]
            common = set.intersection(*map(set, paths))
            above = max(common - {int(self.model.jnt_bodyid[joint]) for joint in self.closing}, default=tree)
            result |= {body for body in range(1, self.model.nbody) if above in self.path(body)}
        return frozenset(result)

    @cached_property
    def num_joints(self) -> int:
        """Number of the hand's hinges and slides, of those that follow another only the ones that close it."""
        counted_joints = [joint for joint in self.joints if joint in self.ends or joint not in self.follows]
        return sum(self.is_scalar(joint) and int(self.model.jnt_bodyid[joint]) in self.hand for joint in counted_joints)

    @cached_property
    def joints(self) -> tuple[int, ...]:
        """All joints of the trees."""
        return tuple(joint for joint in range(self.model.njnt) if self._root(joint) in self.trees)

    @cached_property
    def held(self) -> tuple[int, ...]:
        """Joints of the trees that neither close the hand nor follow or lead another that does, nor are in a closed loop."""
        looped = self._looped()
        led = {leader for joint in self.ends for leader in leaders(joint, self.follows)}
        coupled = {*self.ends, *self.follows, *led}
        return tuple(j for j in self.joints if j not in coupled and int(self.model.jnt_bodyid[j]) not in looped)

    @cached_property
    def tips(self) -> tuple[int, ...]:
        """Bodies with geoms below the joints that close, which have no other such below them."""
        below = {int(self.model.jnt_bodyid[joint]) for joint in self.closing}
        moved = {b for b in range(self.model.nbody) if self.model.body_geomnum[b] and below & set(self.path(b))}
        return tuple(sorted(moved - {above for body in moved for above in self.path(body)[1:]}))

    def pose(self, share: float) -> Float[np.ndarray, " qpos"]:
        """Return where the joints are when the hand has closed by a share; all else is at its start."""
        result = self.model.qpos0.copy()
        for joint, (opened, closed) in self.ends.items():
            result[self.model.jnt_qposadr[joint]] = (1.0 - share) * opened + share * closed
        for joint in self.closing[len(self.ends) :]:
            leader, coefficients = self.follows[joint]
            moved = result[self.model.jnt_qposadr[leader]] - self.model.qpos0[self.model.jnt_qposadr[leader]]
            result[self.model.jnt_qposadr[joint]] += np.polynomial.polynomial.polyval(moved, coefficients)
        return result

    def path(self, body: int) -> list[int]:
        """Return a body and all above it but the world, upward."""
        results = []
        while body:
            results.append(body)
            body = int(self.model.body_parentid[body])
        return results

    def is_scalar(self, joint: int) -> bool:
        """Return whether a joint is a hinge or a slide."""
        return int(self.model.jnt_type[joint]) in (_SLIDE, _HINGE)

    def _root(self, joint: int) -> int:
        return int(self.model.body_rootid[self.model.jnt_bodyid[joint]])

    def _looped(self) -> set[int]:
        """Return the bodies between two that an equality holds together, and where their paths upward meet."""
        model, result = self.model, set[int]()
        for i in np.flatnonzero(np.isin(model.eq_type, _LOOPS) & model.eq_active0.astype(bool)):
            ids = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
            if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
                ids = int(model.site_bodyid[ids[0]]), int(model.site_bodyid[ids[1]])
            one, two = (set(self.path(max(body, 0))) for body in ids)
            result |= (one ^ two) if one and two else set()
        return result


def leaders(joint: int, follows: Mapping[int, tuple[int, Float[np.ndarray, " 5"]]]) -> list[int]:
    """Return the joint that one follows, the one that this follows, and so on; `follows` as in `Movement`."""
    results: list[int] = []
    while joint in follows and follows[joint][0] not in results:
        joint = follows[joint][0]
        results.append(joint)
    return results


def movement(scene: Model, bodies: frozenset[str]) -> Movement:
    """Return how the hand of a scene moves whose `bodies` carry sensors; nothing closes if it is not clear how."""
    model = scene.compiled
    trees = frozenset(int(model.body_rootid[model.body(name).id]) for name in bodies) - {0}
    follows = {}
    for i in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & model.eq_active0.astype(bool)):
        if (leader := int(model.eq_obj2id[i])) >= 0:
            follows[int(model.eq_obj1id[i])] = leader, model.eq_data[i, :5].copy()
    ends = {int(model.joint(name).id): pair for name, pair in closing_motion(scene).items()}
    ends = {joint: pair for joint, pair in ends.items() if int(model.body_rootid[model.jnt_bodyid[joint]]) in trees}
    driven = {joint: pair for joint, pair in ends.items() if not set(leaders(joint, follows)) & ends.keys()}
    return Movement(model, trees, driven, follows)


SHARES = np.linspace(0.0, 1.0, 9)  # how far the hand is closed: where its tips are tried, and where touch is looked for
TOWARD_PALM = (0.0, 0.2, 0.4, 0.6, -0.25, -0.5)  # how far from the tips' middle to the palm a place is tried
OPPOSED = -0.3  # two links that touch an object oppose each other if the cosine between their directions is less than this
OVERLAP = 0.1  # how deep an object may lie in the open hand where it is left, as a share of its radius
_UNBOUNDED = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


@dataclass(frozen=True)
class Grip:
    """What a hand that closes meets of an object, at the first share at which each link does."""

    overlap: float  # how deep the object lies in the open hand [m]; negative: how far it is from it
    links: frozenset[int]  # bodies that meet it
    is_opposed: bool  # whether two of these do so from opposite sides
    imbalance: float  # length of the mean of the directions from which they do

    @property
    def holds(self) -> bool:
        """Whether several links meet the object, from opposite sides."""
        return len(self.links) > 1 and self.is_opposed


class Sweep:
    """A hand that closes on an object, pose by pose."""

    def __init__(self, movement: Movement, body: int):
        self.movement, self.model, self.body = movement, movement.model, body
        self.data = mujoco.MjData(self.model)
        self.is_free = int(self.model.body_dofnum[body]) == 6 and int(self.model.body_jntnum[body]) == 1
        weld = self.model.body_weldid
        rigid = [b for b in range(self.model.nbody) if weld[b] == weld[body] and body in (*movement.path(b), 0)]
        self.object_geoms = [geom for b in rigid for geom in self._touchable(b)]
        self.hand_geoms = [geom for b in sorted(movement.hand) for geom in self._touchable(b)]
        self._posed(0.0)
        offsets = [self.data.geom_xpos[geom] - self.data.xpos[body] for geom in self.object_geoms]
        self.middle = self.data.xmat[body].reshape(3, 3).T @ np.mean(offsets, axis=0) if offsets else np.zeros(3)
        reach = [np.linalg.norm(p - np.mean(offsets, axis=0)) for p in offsets]
        self.radius = max((r + self.model.geom_rbound[g] for r, g in zip(reach, self.object_geoms, strict=True)), default=0.0)

    def place(self) -> Float[np.ndarray, " 3"] | None:
        """Return where the object's frame lies for a grip as good as any, in the world [m]; None if nowhere clear of the hand.

        First between all fingertips; if it cannot be held there, such as what is smaller than the gaps, between one fingertip
        and the palm, or two.
        """
        best, result = (False, 0, -np.inf), None
        tips = self.movement.tips
        for among in ([tips], [*((tip,) for tip in tips), *combinations(tips, 2)]):
            for candidate in self._candidates(among):
                origin = candidate - self.data.xmat[self.body].reshape(3, 3) @ self.middle
                grip = self.grip(origin)
                value = grip.is_opposed, len(grip.links), -grip.imbalance
                if grip.overlap <= 0 and grip.links and value > best:
                    best, result = value, origin
            if best[0]:
                break
        return result

    def grip(self, origin: Float[np.ndarray, " 3"] | None = None) -> Grip:
        """Return what the hand meets as it closes, the object's frame at `origin` in the world [m] or where it starts."""
        sides: dict[int, np.ndarray] = {}
        overlap = -np.inf
        for share in SHARES:
            self._posed(float(share), origin)
            middle = self.data.xpos[self.body] + self.data.xmat[self.body].reshape(3, 3) @ self.middle
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
        results = []
        base = [b for b in sorted(self.movement.hand) if self._touchable(b)]
        for share in SHARES:
            self._posed(float(share))
            for bodies in among:
                tips = np.mean([self._middle_of(body) for body in bodies], axis=0)
                palm = self._middle_of(base[0]) if base[0] not in self.movement.tips else tips
                results += [(1.0 - toward) * tips + toward * palm for toward in TOWARD_PALM]
        return results

    def _middle_of(self, body: int) -> Float[np.ndarray, " 3"]:
        geoms = self._touchable(body)
        return np.mean(self.data.geom_xpos[geoms], axis=0) if geoms else self.data.xpos[body]

    def _gap(self, geom: int) -> tuple[float, Float[np.ndarray, " 3"]]:
        """Return the distance of a geom from the object [m], and the object's nearest point."""
        best, point, ends = 1.0, np.zeros(3), np.zeros(6)
        for other in self.object_geoms:
            gap = mujoco.mj_geomDistance(self.model, self.data, other, geom, 1.0, ends)
            if gap < best:
                best, point = gap, ends[:3].copy()
        return best, point

    def _posed(self, share: float, origin: Float[np.ndarray, " 3"] | None = None) -> None:
        self.data.qpos[:] = self.movement.pose(share)
        if origin is not None and self.is_free:
            address = int(self.model.jnt_qposadr[self.model.body_jntadr[self.body]])
            self.data.qpos[address : address + 3] = origin
        mujoco.mj_kinematics(self.model, self.data)

    def _touchable(self, body: int) -> list[int]:
        first, num = int(self.model.body_geomadr[body]), int(self.model.body_geomnum[body])
        geoms = [geom for geom in range(first, first + num) if int(self.model.geom_type[geom]) not in _UNBOUNDED]
        return [geom for geom in geoms if self.model.geom_contype[geom] or self.model.geom_conaffinity[geom]] or geoms


START = "tgdsl/open"  # the keyframe with the hand open
GRIP, MOST = 1.0, 10.0  # force at the fingertips: so many times the object's weight, but at most so much [N]
FIXED_GRIP = 1.0  # the same where the object is fixed [N]
LAG = 0.2  # by how much a hinge lags its target when its servo gives all it can [rad]; a slide by this times the hand's reach
TIP_MASS = 0.05  # least inertia of a fingertip as a joint moves it [kg]
SPEED = 0.2  # how fast one finger pushes the object away [m/s]
STEPS = 0.3  # most that a servo's natural frequency turns in one physics step [rad]
NUM_GROUPS = 31  # groups of actuators that MuJoCo can disable, from 0; those in the next one always act
_EARTH = 9.81
_TORQUE_SCALE = 10


@dataclass(frozen=True)
class Servo:
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
            groups_in_use = {int(actuator.group) for i, actuator in enumerate(spec.actuators) if i not in self.resting}
            group = _resting_group(int(spec.option.disableactuator), groups_in_use)
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
    """Return the pairs of the robot's bodies that could collide."""
    # Fingers that meet before they meet the object would hold each other off it; and MuJoCo collides a link with its parent
    # where that is fixed to the world, although both overlap at the joint by design.
    model = moving.model
    excluded = {int(signature) for signature in model.exclude_signature}
    bodies = [b for b in range(1, model.nbody) if int(model.body_rootid[b]) in moving.trees and model.body_geomnum[b]]
    pairs = [(a, b) for a, b in combinations(bodies, 2) if (a << 16) + b not in excluded]
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
