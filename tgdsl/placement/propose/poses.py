"""Poses of a hand: some joints are set, the others follow by what binds them: mimic joints, tendons, closed loops.

The bound joints are found by Newton's method on the residuals of MuJoCo's equalities, in steps from the start.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.placement.propose.hands import Hand, KinematicTree

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
            self.equalities = []  # they do not hold at the start: each joint by itself says more
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
        return self.data

    @cached_property
    def independent(self) -> list[int]:
        """Joints that can be set each by itself: with limits before without, driven before not, near to the base before far."""
        if not self.equalities:
            return list(self.joints)
        self.data.qpos[:] = self.start
        mujoco.mj_fwdPosition(self.model, self.data)
        _, sizes, rows = np.linalg.svd(self._jacobian()[:, self.dofs], full_matrices=False)
        basis = list(rows[sizes > INDEPENDENT * max(float(sizes.max(initial=0.0)), 1e-9)])
        place = {int(dof): i for i, dof in enumerate(self.dofs)}
        driven, result = _driven(self.model), []
        for joint in sorted(self.joints, key=lambda j: (not self.model.jnt_limited[j], j not in driven, self._depth(j), j)):
            row = np.zeros(len(self.dofs))
            row[place[int(self.model.jnt_dofadr[joint])]] = 1.0
            for other in basis:
                row -= (row @ other) * other
            if (size := float(np.linalg.norm(row))) > INDEPENDENT:
                basis.append(row / size)
                result.append(joint)
        return sorted(result)

    def _depth(self, joint: int) -> int:
        return len(self.tree.path(self.tree.segment[int(self.model.jnt_bodyid[joint])]))

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
