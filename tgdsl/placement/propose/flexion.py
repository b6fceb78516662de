"""The palmar side of each link, guessed from how the joints flex; None where that is not clear.

A joint that moves one way only closes toward the end of its range at which the fingertips are nearer to one another and to
the palm. A link's palmar side faces where its own joint then carries it; the palm's faces the fingertips as they close.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.placement.propose.hands import Hand, KinematicTree

ONE_SIDED = 3.0
"""A joint bends one way if its range from the start is this many times longer on one side than on the other."""
MIN_CLOSING = 0.03
"""Least share by which the fingertips must draw nearer for an end of a joint's range to count as closed."""
MIN_BEND = np.radians(30.0)
"""A hinge that turns by less than this does not close a finger, but shapes a palm."""
MIN_LEVER = 0.25
"""A link whose centre is nearer to its hinge than this share of the square root of its surface turns in place."""
LINK_SNAP, PALM_SNAP = np.radians(30.0), np.radians(40.0)
"""A direction this close to an axis of the link's frame is taken to be that axis; a palm's that is farther is not taken."""

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class Flexion:
    """Which way each joint of a hand flexes."""

    def __init__(self, tree: KinematicTree, hand: Hand):
        """Look at each joint of the fingers by itself, the others half closed and then closed."""
        self.tree, self.hand = tree, hand
        self.data = mujoco.MjData(tree.model)
        inner = {s for body in hand.fingers for s in tree.path(tree.segment[body])} - set(tree.path(hand.base))
        self.bending = {s: joint for s in sorted(inner - hand.looped) if (joint := _bending(tree, s)) is not None}
        self.others = tree.model.qpos0.copy()
        for joint in self.bending.values():
            self.others[tree.model.jnt_qposadr[joint]] = tree.model.jnt_range[joint].mean()
        half = {joint: self._gain(joint) for joint in self.bending.values()}
        for joint, gain in half.items():
            self.others[tree.model.jnt_qposadr[joint]] = _end(tree, joint, gain)
        gains = {joint: (gain, self._gain(joint)) for joint, gain in half.items()}
        self.closed = {joint: _end(tree, joint, sum(pair)) for joint, pair in gains.items() if _is_clear(*pair)}

    def direction(self, body: int) -> tuple[float, ...] | None:
        """Return where the palmar side of a body faces, in its frame; None if that is not clear."""
        if body == self.hand.palm:
            return self._palm_direction()
        joint = self.bending.get(self.tree.segment[body])
        if joint is None or joint not in self.closed:
            return None
        model, data = self.tree.model, self._posed(self.tree.model.qpos0)
        along = data.xaxis[joint]
        if int(model.jnt_type[joint]) == _HINGE:
            along = np.cross(along, self._centre(body) - data.xanchor[joint])
            if np.linalg.norm(along) < MIN_LEVER * np.sqrt(self.tree.area[body]):
                return None
        low, high = model.jnt_range[joint]
        along = along * (1.0 if self.closed[joint] > 0.5 * (low + high) else -1.0)
        return _snapped(data.xmat[body].reshape(3, 3).T @ along, LINK_SNAP, keeps_oblique=True)

    def _palm_direction(self) -> tuple[float, ...] | None:
        palm = self.hand.palm
        tips = [tip for tip in self.hand.tips if self._is_closing(tip)]
        if palm is None or not tips or 2 * len(tips) < len(self.hand.tips):
            return None
        half, nearly, whole = (self._toward(palm, tips, share) for share in (0.5, 0.75, 1.0))
        direction = _snapped(nearly, PALM_SNAP, keeps_oblique=False)
        # Fingers that curl around cross the palm's plane where no palm is modelled in their way: no side is clear then.
        is_clear = direction is not None and min(half @ direction, whole @ direction) > 0.5
        return direction if is_clear else None

    def _toward(self, palm: int, tips: list[int], share: float) -> Float[np.ndarray, " 3"]:
        """Return the direction from the palm to the middle of tips in the palm's frame, all joints closed by a share."""
        pose = self.tree.model.qpos0.copy()
        for joint, end in self.closed.items():
            opened = self.tree.model.jnt_range[joint].sum() - end
            pose[self.tree.model.jnt_qposadr[joint]] = (1.0 - share) * opened + share * end
        data = self._posed(pose)
        toward = data.xmat[palm].reshape(3, 3).T @ (np.mean([self._centre(tip) for tip in tips], axis=0) - self._centre(palm))
        return toward / max(float(np.linalg.norm(toward)), 1e-9)

    def _is_closing(self, tip: int) -> bool:
        """Return whether all joints that bend a tip's finger are known to close, and there is one."""
        joints = {self.bending[s] for s in self.tree.path(self.tree.segment[tip]) if s in self.bending}
        return bool(joints) and joints <= self.closed.keys()

    def _gain(self, joint: int) -> float:
        """Return the share by which the tips draw nearer as a joint goes from the low to the high end of its range."""
        at_low, at_high = (self._openness(joint, float(end)) for end in self.tree.model.jnt_range[joint])
        return (at_low - at_high) / max(at_low, at_high, 1e-9)

    def _openness(self, joint: int, value: float) -> float:
        """Return the mean distance of the tips that a joint moves from those that it does not, and from the palm [m]."""
        pose = self.others.copy()
        pose[self.tree.model.jnt_qposadr[joint]] = value
        self._posed(pose)
        segment = self.tree.segment[int(self.tree.model.jnt_bodyid[joint])]
        is_moved = {tip: segment in self.tree.path(self.tree.segment[tip]) for tip in self.hand.tips}
        fixed = [self._centre(tip) for tip in self.hand.tips if not is_moved[tip]]
        fixed += [self._centre(self.hand.palm)] if self.hand.palm is not None else []
        moved = [self._centre(tip) for tip in self.hand.tips if is_moved[tip]]
        return float(np.mean([np.linalg.norm(one - two) for one in moved for two in fixed])) if moved and fixed else 0.0

    def _posed(self, qpos: Float[np.ndarray, " qpos"]) -> mujoco.MjData:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.tree.model, self.data)
        return self.data

    def _centre(self, body: int) -> Float[np.ndarray, " 3"]:
        return self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ self.tree.centroid[body]


def _end(tree: KinematicTree, joint: int, gain: float) -> float:
    return float(tree.model.jnt_range[joint, 1 if gain > 0 else 0])


def _is_clear(half: float, whole: float) -> bool:
    """Return whether two gains, with the other joints half closed and closed, agree, or one by far outweighs the other."""
    small, large = sorted((abs(half), abs(whole)))
    return large > MIN_CLOSING and (half * whole > 0 or small < 0.5 * large)


def _bending(tree: KinematicTree, segment: int) -> int | None:
    """Return the only joint of a segment that moves one way from the start, within limits."""
    found = []
    for joint in tree.joints(segment):
        model = tree.model
        if int(model.jnt_type[joint]) not in (_HINGE, _SLIDE) or not model.jnt_limited[joint]:
            continue
        if int(model.jnt_type[joint]) == _HINGE and np.ptp(model.jnt_range[joint]) < MIN_BEND:
            continue
        down, up = np.abs(model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]])
        if max(down, up) >= ONE_SIDED * min(down, up):
            found.append(joint)
    return found[0] if len(found) == 1 else None


def _snapped(direction: Float[np.ndarray, " 3"], angle: float, keeps_oblique: bool) -> tuple[float, ...] | None:
    """Return the axis of the frame that is near a direction; if none is, the direction itself or None."""
    direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) >= np.cos(angle):
        return tuple(float(np.sign(direction[axis])) if i == axis else 0.0 for i in range(3))
    return tuple(round(float(x), 2) + 0.0 for x in direction) if keeps_oblique else None
