"""Which end of each joint's range closes a hand, and the evidence against it.

The evidence, in the order in which it decides:

1. A finger curls: a hinge whose range bends away from its start, in the sense of rotation of another hinge of its finger that
   bends too, closes at the far end. A tip that then moves away from the others, as a thumb's may, is reported but does not
   count: distances depend on the pose of the rest of the hand, the curl of a finger does not. A joint that drives all fingers
   closes where the tips approach each other: fingers may be curled at the start.
2. The tips approach: any other joint closes at the end at which its tips are clearly nearer to the other chains' tips and to
   the palm, with the other joints half closed and closed; a slide, and the only hinge of a chain, even against its range. A
   hinge of a curling finger that has its range against it stays undecided.
   A jaw that turns against a fixed jaw closes at the end next to it, see `jaws`.
3. The range alone: the only hinge of a chain closes at the far end of a range that bends away from its start; that is weak.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.placement.propose.hands import MAX_FINGER, Hand, KinematicTree

STEPS, ITERATIONS = 8, 12  # steps from the start to a pose, and iterations in each
RESIDUAL = 1e-5  # largest residual of an equality in a pose [m or rad]
INDEPENDENT = 1e-3  # least share of a joint's motion that the equalities must leave free
MIN_OVERLAP = 0.5
"""Least share of a driven joint's way that its limits must allow. Below it limits and equality contradict each other, as with a
mimic joint of the wrong sign, and the equality is ignored."""
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_JOINT, _TENDON = int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)
_BODIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


class Poses:
    """The poses that a hand's joints can take.

    Attributes:
        joints: Its hinges and slides.
        start: The start, with each joint within its range.
    """

    def __init__(self, tree: KinematicTree, hand: Hand):
        """Find the start."""
        segments = [s for chain in hand.chains for s in chain]
        self.tree, self.model = tree, tree.model
        of_hand = [joint for s in segments for joint in tree.joints(s)]
        self.joints = [joint for joint in of_hand if int(self.model.jnt_type[joint]) in _SCALAR]
        self.dofs = np.flatnonzero(np.isin(self.model.dof_jntid, of_hand))
        self.equalities = self._equalities({hand.base, *segments}, set(of_hand))
        if self.equalities:
            self.model = _with_equalities_alone(tree.model)
        self.data = mujoco.MjData(self.model)
        if self.model.neq:
            self.data.eq_active[:] = np.isin(np.arange(self.model.neq), self.equalities)
        start = tree.model.qpos0.copy()
        for joint in self.joints:
            if tree.model.jnt_limited[joint]:
                at = self.at(joint)
                start[at] = np.clip(start[at], *tree.model.jnt_range[joint])
        settled = self._bound(start, self.dofs)
        if settled is None:
            self.equalities = []  # they do not hold at the start: independent joints are the better guess
        self.start = start if settled is None else settled

    def at(self, joint: int) -> int:
        return int(self.model.jnt_qposadr[joint])

    def pose(self, values: Mapping[int, float]) -> Float[np.ndarray, " qpos"]:
        """Return the pose in which independent joints have some values and the other independent ones are as at the start."""
        goal = self.start.copy()
        for joint, value in values.items():
            goal[self.at(joint)] = value
        if not self.equalities:
            return goal
        driven = [self.at(joint) for joint in self.independent]
        bound = np.setdiff1d(self.dofs, [int(self.model.jnt_dofadr[joint]) for joint in self.independent])
        pose = self.start
        for share in np.linspace(1.0 / STEPS, 1.0, STEPS):
            trial = pose.copy()
            trial[driven] = (1.0 - share) * self.start[driven] + share * goal[driven]
            settled = self._bound(trial, bound)
            if settled is None:
                break
            pose = settled
        return pose

    def kinematics(self, qpos: Float[np.ndarray, " qpos"]) -> mujoco.MjData:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        self.tree.carry_welded(self.data)
        return self.data

    @cached_property
    def independent(self) -> list[int]:
        """Joints that can be set independently: limited before unlimited, driven before free, near the base before far."""
        if not self.equalities:
            return list(self.joints)
        self.data.qpos[:] = self.start
        mujoco.mj_fwdPosition(self.model, self.data)
        _, sizes, rows = np.linalg.svd(self._jacobian()[:, self.dofs], full_matrices=False)
        basis = list(rows[sizes > INDEPENDENT * max(float(sizes.max(initial=0.0)), 1e-9)])
        place = {int(dof): i for i, dof in enumerate(self.dofs)}
        driven, result = _driven(self.model), []
        depth = {j: len(self.tree.path(self.tree.segment[int(self.model.jnt_bodyid[j])])) for j in self.joints}
        for joint in sorted(self.joints, key=lambda j: (not self.model.jnt_limited[j], j not in driven, depth[j], j)):
            row = np.zeros(len(self.dofs))
            row[place[int(self.model.jnt_dofadr[joint])]] = 1.0
            for other in basis:
                row -= (row @ other) * other
            if (size := float(np.linalg.norm(row))) > INDEPENDENT:
                basis.append(row / size)
                result.append(joint)
        return sorted(result)

    def _equalities(self, segments: set[int], joints: set[int]) -> list[int]:
        """Return the active equalities that bind joints of the hand to one another."""
        model, result = self.model, []
        for i in np.flatnonzero(model.eq_active0).tolist():
            kind, ids = int(model.eq_type[i]), (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
            if kind == _JOINT:
                # To one joint alone, it is a spring.
                is_within = ids[1] >= 0 and joints.issuperset(ids) and self._is_within_limits(i, *ids)
            elif kind == _TENDON:
                is_within = all(joints.issuperset(_of_tendon(model, t)) and _of_tendon(model, t) for t in ids if t >= 0)
            else:
                bound = {self.tree.segment[b] for b in self.tree.bound_bodies(i)} if kind in _BODIES else set()
                is_within = len(bound) == 2 and bound <= segments
            if is_within:
                result.append(i)
        return result

    def _is_within_limits(self, equality: int, driven: int, driver: int) -> bool:
        """Return whether the limits of the driven joint allow most of the way on which its driver's range takes it."""
        model = self.model
        if not (model.jnt_limited[driven] and model.jnt_limited[driver]):
            return True
        start = model.qpos0[[self.at(driven), self.at(driver)]]
        driven_to = start[0] + np.polyval(model.eq_data[equality, 4::-1], model.jnt_range[driver] - start[1])
        low, high = np.sort(driven_to)
        common = min(high, model.jnt_range[driven, 1]) - max(low, model.jnt_range[driven, 0])
        return bool(common >= MIN_OVERLAP * (high - low))

    def _bound(self, qpos: Float[np.ndarray, " qpos"], dofs: Sequence[int] | np.ndarray) -> np.ndarray | None:
        """Return a pose near another at which the equalities hold, by motion of some degrees of freedom."""
        if not self.equalities:
            return qpos
        self.data.qpos[:] = qpos
        for _ in range(ITERATIONS):
            mujoco.mj_fwdPosition(self.model, self.data)
            residual = self.data.efc_pos[: self.data.nefc]
            if not np.abs(residual).max(initial=0.0) > RESIDUAL:
                return self.data.qpos.copy()
            step = np.zeros(self.model.nv)
            step[dofs] = np.linalg.lstsq(self._jacobian()[:, dofs], -residual, rcond=1e-6)[0]
            mujoco.mj_integratePos(self.model, self.data.qpos, step, 1.0)
        return None

    def _jacobian(self) -> Float[np.ndarray, "row dof"]:
        return self.data.efc_J.reshape(-1, self.model.nv)[: self.data.nefc]


def _with_equalities_alone(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose only constraints are equalities, with a dense Jacobian."""
    model = copy.copy(model)
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_LIMIT | off.mjDSBL_FRICTIONLOSS
    model.opt.disableflags &= ~(int(off.mjDSBL_CONSTRAINT) | int(off.mjDSBL_EQUALITY))
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return model


def _driven(model: mujoco.MjModel) -> set[int]:
    """Return the joints on which an actuator acts, directly or by a fixed tendon."""
    result: set[int] = set()
    for kind, target in zip(model.actuator_trntype.tolist(), model.actuator_trnid[:, 0].tolist(), strict=True):
        if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
            result.add(target)
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            result |= _of_tendon(model, target)
    return result


def _of_tendon(model: mujoco.MjModel, tendon: int) -> set[int]:
    path = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    is_joint = model.wrap_type[path] == int(mujoco.mjtWrap.mjWRAP_JOINT)
    return {int(i) for i in model.wrap_objid[path][is_joint]}


ONE_SIDED, LEANING = 2.99, 1.49
"""A joint bends one way, or leans to one, if its range from the start is this many times longer on one side.

No ratios that people draw, as -30 to 90 degrees is: the last bits of a range shall not decide. The same holds for the angle."""
SYMMETRIC = 0.05  # limits are the same both ways if their middle is nearer to zero than half this share of the range
MIN_CLOSING = 0.03  # least share by which the tips must draw nearer for an end of a joint's range to count as closed
MIN_BEND = np.radians(29.9)  # a hinge that turns by less than this does not close a finger, but shapes a palm
PARALLEL = 0.7  # least cosine of the angle between two axes about which a finger curls
EVENLY = 0.4  # least second eigenvalue of the axes of spokes: 1/2 if evenly spread
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclass(frozen=True)
class Motion:
    """The motion of an independent joint that closes a hand."""

    opened: float  # its value when open [rad, of slides m]
    closed: float  # its value when closed
    is_curling: bool  # whether it bends a finger of several joints
    doubt: str = ""  # evidence against it; empty if there is none


class Closing:
    """The joints that close a hand.

    Attributes:
        poses: The hand's poses.
        motions: The closing motion of each joint; unclear joints are left out.
        rotations: Per joint, the hinges that turn as it moves to the high end, and the axes of these rotations in the world.
    """

    def __init__(self, tree: KinematicTree, hand: Hand):
        """Test each joint alone, with the others half closed and then closed."""
        self.tree, self.hand, self.poses = tree, hand, Poses(tree, hand)
        self.chain = {s: i for i, chain in enumerate(hand.chains) for s in chain}
        independent = self.poses.independent if hand.length <= MAX_FINGER else ()
        limited = [j for j in independent if tree.model.jnt_limited[j] and self.segment(j) in tree.carries]
        spans = {j: float(np.ptp(tree.model.jnt_range[j])) for j in limited}
        candidates = [j for j in limited if int(tree.model.jnt_type[j]) != _HINGE or spans[j] >= MIN_BEND]
        self.rotations = {joint: self._rotations(joint) for joint in candidates}
        self.lean = {joint: self._lean(joint) for joint in candidates}
        self.sense = self._curling()
        for joint in self.sense:
            if {self.chain[self.segment(hinge)] for hinge in self.rotations[joint]} == set(self.chain.values()):
                gain = self._gain(joint, {})
                self.sense[joint] = float(np.sign(gain)) if abs(gain) > MIN_CLOSING else self.sense[joint]
        self.bending = self._bending(candidates)
        middles = {joint: float(np.mean(self._range(joint))) for joint in self.bending}
        half = {joint: self._gain(joint, middles) for joint in self.bending}
        ends = {joint: self._end(joint, self.sense.get(joint) or half[joint]) for joint in self.bending}
        # Within assumed limits fingers may pass each other: their closed ends say nothing.
        whole = half if tree.doubt else {joint: self._gain(joint, ends) for joint in self.bending}
        motions = {joint: self._motion(joint, half[joint], whole[joint]) for joint in self.bending}
        self.motions = {joint: motion for joint, motion in motions.items() if motion is not None}

    def pose(self, share: float) -> Float[np.ndarray, " qpos"]:
        values = {joint: (1.0 - share) * m.opened + share * m.closed for joint, m in self.motions.items()}
        return self.poses.pose(values)

    def segment(self, joint: int) -> int:
        return self.tree.segment[int(self.tree.model.jnt_bodyid[joint])]

    def _range(self, joint: int) -> tuple[float, float]:
        low, high = self.tree.model.jnt_range[joint].tolist()
        return low, high

    def _end(self, joint: int, sense: float) -> float:
        return self._range(joint)[1 if sense > 0 else 0]

    def _sides(self, joint: int) -> tuple[float, float]:
        start = float(self.poses.start[self.poses.at(joint)])
        low, high = self._range(joint)
        return max(start - low, 0.0), max(high - start, 0.0)

    def _lean(self, joint: int) -> float:
        """Return the end toward which a hinge bends: ±1 if one way only, ±0.5 if it leans there; else, and for slides, 0."""
        down, up = self._sides(joint)
        low, high = self._range(joint)
        if abs(low + high) < SYMMETRIC * (high - low):
            return 0.0
        if int(self.tree.model.jnt_type[joint]) != _HINGE or max(down, up) < LEANING * min(down, up):
            return 0.0
        return float(np.sign(up - down)) * (1.0 if max(down, up) >= ONE_SIDED * min(down, up) else 0.5)

    def _rotations(self, joint: int) -> dict[int, Float[np.ndarray, " 3"]]:
        model, start = self.tree.model, self.poses.start
        step = 0.05 * float(np.ptp(model.jnt_range[joint]))
        down, up = self._sides(joint)
        sign = 1.0 if up > down else -1.0
        moved = (self.poses.pose({joint: float(start[self.poses.at(joint)]) + sign * step}) - start) * sign
        axes = self.poses.kinematics(start).xaxis.copy()
        hinges = [j for j in self.poses.joints if int(model.jnt_type[j]) == _HINGE]
        turned = {j: float(moved[self.poses.at(j)]) for j in hinges if abs(moved[self.poses.at(j)]) > 1e-2 * step}
        return {j: float(np.sign(angle)) * axes[j] for j, angle in turned.items()}

    def _curling(self) -> dict[int, float]:
        """Return the joints that curl a finger, with the end (±1) toward which they curl it."""
        sense: dict[int, float] = {}
        for joint, lean in self.lean.items():
            if lean and not self.is_opposed(joint):
                agreeing = [other for other in self.lean if self._is_agreeing(joint, lean, other, self.lean[other])]
                if any(max(abs(lean), abs(self.lean[other])) == 1.0 for other in agreeing):
                    sense[joint] = float(np.sign(lean))
        for joint, lean in self.lean.items():  # a hinge that leans to no side follows the hinges parallel to it
            if not lean and self.rotations[joint]:
                votes = [s for s in (1.0, -1.0) if any(self._is_agreeing(joint, s, other, sense[other]) for other in sense)]
                sense |= {joint: votes[0]} if len(votes) == 1 else {}
        return sense

    def _is_agreeing(self, one: int, sense: float, two: int, other: float) -> bool:
        """Return whether two joints, or one joint with several hinges, turn hinges of a finger in the same sense."""
        if sense * other == 0.0 or self.is_opposed(two):
            return False
        sign = float(np.sign(sense * other))
        return any(sign * cosine > PARALLEL for cosine in self._cosines(one, two))

    def is_opposed(self, joint: int) -> bool:
        return any(cosine < -PARALLEL for cosine in self._cosines(joint, joint))

    def _cosines(self, one: int, two: int) -> list[float]:
        """Return the cosines between the axes of hinges of one finger that two joints turn."""
        results = []
        for i, axis in self.rotations[one].items():
            for j, other in self.rotations[two].items():
                paths = (self.tree.path(self.segment(i)), self.tree.path(self.segment(j)))
                if i != j and (paths[0][0] in paths[1] or paths[1][0] in paths[0]):
                    results.append(float(axis @ other))
        return results

    def _bending(self, candidates: list[int]) -> list[int]:
        """Return the joints whose closed end is sought: all except the joints that spread fingers."""
        curled = {self.chain[self.segment(joint)] for joint in self.sense}
        one_way = {joint for joint in candidates if abs(self.lean[joint]) == 1.0}
        hinges = {joint for joint in candidates if int(self.tree.model.jnt_type[joint]) == _HINGE}
        free = hinges - self.sense.keys() - one_way
        spreading = self._spreading(free, one_way)
        results = []
        for joint in candidates:
            segment = self.segment(joint)
            siblings = [other for other in candidates if self.segment(other) == segment]
            rivals = [j for j in siblings if j in self.sense] or [j for j in siblings if j in one_way] or siblings
            spreads = joint in spreading or (joint in free and self.chain[segment] in curled)
            if rivals == [joint] and not spreads:
                results.append(joint)
        return results

    def _spreading(self, free: Set[int], one_way: Set[int]) -> set[int]:
        """Return the joints that spread fingers: their axes cross the axes of hinges beyond that bend one way or alike."""
        alike = {one for one in free for other in free if any(abs(cosine) > PARALLEL for cosine in self._cosines(one, other))}
        path = {other: self.tree.path(self.segment(other)) for other in one_way | alike}
        axes = []
        for joint in sorted(free):
            beyond = [other for other in path if other != joint and self.segment(joint) in path[other][1:]]
            if beyond and not any(abs(cosine) > PARALLEL for other in beyond for cosine in self._cosines(joint, other)):
                axes += [(joint, self.chain[self.segment(i)], axis) for i, axis in self.rotations[joint].items()]
        if axes and {chain for _, chain, _ in axes} == set(self.chain.values()):
            # As lines, are they spread evenly around a third direction, as spokes are?
            spread = np.linalg.eigvalsh(np.mean([np.outer(axis, axis) for _, _, axis in axes], axis=0))
            if spread[1] > EVENLY:
                return {one for one, _, _ in axes}
        return {
            one
            for one, chain, axis in axes
            if any(chain != other_chain and abs(axis @ other) > PARALLEL for _, other_chain, other in axes)
        }

    def _motion(self, joint: int, half: float, whole: float) -> Motion | None:
        # With the other joints half closed and closed: both agree, or one by far outweighs the other.
        small, large = sorted((abs(half), abs(whole)))
        is_clear = large > MIN_CLOSING and (half * whole > 0 or small < 0.5 * large)
        gain = self.hand.closes or (half + whole if is_clear else 0.0)
        sense, lean = self.sense.get(joint, 0.0), self.lean[joint] if abs(self.lean[joint]) == 1.0 else 0.0
        siblings = [j for j in self.sense if self.chain[self.segment(j)] == self.chain[self.segment(joint)]]
        doubt = self.tree.doubt
        if sense:
            if gain * sense < 0:
                doubt = f"as it curls, its tip goes {abs(gain) / 2:.0%} away from the palm and the other tips"
        elif gain and (not siblings or gain * lean >= 0):
            sense = gain
            if gain * lean < 0:
                doubt = "it starts closed: the tips part along its range"
        elif lean and not siblings and not gain and len(self.hand.chains) > 1:
            sense, doubt = lean, "the tips hardly draw nearer; only its range says where it bends"
        if not sense:
            return None
        return Motion(self._end(joint, -sense), self._end(joint, sense), joint in self.sense, doubt)

    def _gain(self, joint: int, others: Mapping[int, float]) -> float:
        """Return the share by which the tips draw nearer as a joint goes from the low to the high end of its range."""
        low, high = (self._points({**others, joint: end}) for end in self._range(joint))
        is_moved, num = np.linalg.norm(high - low, axis=1) > 1e-6, len(self.hand.tips)
        chains = [self.chain[self.tree.segment[tip]] for tip in self.hand.tips] + [-1] * (len(low) - num)
        apart = [(i, j) for i in range(num) for j in range(i + 1, len(low)) if chains[i] != chains[j]]
        pairs = [(i, j) for i, j in apart if is_moved[i] or is_moved[j]]
        if not pairs:
            return 0.0
        at_low, at_high = (float(np.mean([np.linalg.norm(p[i] - p[j]) for i, j in pairs])) for p in (low, high))
        return (at_low - at_high) / max(at_low, at_high, 1e-9)

    def _points(self, values: Mapping[int, float]) -> Float[np.ndarray, "point 3"]:
        data = self.poses.kinematics(self.poses.pose(values))
        bodies = [*self.hand.tips, *([self.hand.palm] if self.hand.palm is not None else [])]
        return np.array([self.tree.centre(body, data) for body in bodies]).reshape(-1, 3)
