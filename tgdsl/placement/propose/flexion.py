"""Where the inner side of each link of a hand faces: None where that is not clear.

A link's inner side faces where it is carried, in the open pose, as the nearest joint above it that has a lever on it closes. A
link before all joints that close takes the side of the nearest link beyond. The last links of two chains that close on each
other without curling face each other along the line on which they meet. A palm's inner side faces the tips as they close, a
fixed jaw's the moving one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from tgdsl.placement.propose.closing import Closing
from tgdsl.placement.propose.hands import Hand, KinematicTree, anchor, length_of

MIN_LEVER = 0.25
"""A link whose centre is nearer to its hinge than this share of the square root of its surface turns in place, unless it is a
single jaw."""
LINK_SNAP, PALM_SNAP = np.radians(30.1), np.radians(40.1)
"""A direction this close to an axis of the link's frame is taken to be that axis; a palm's that is farther is not taken.
No angles that people draw: the last bits of a pose shall not decide."""
STEP = 0.02  # share of its way by which a joint closes to see where a link goes
MIN_COSINE = 0.5  # least cosine of the angle between directions to which fingers curl for these to say where the palm faces
PARALLEL, BESIDE = 0.99, 0.25
"""A bar beside a finger turns about an axis with at least this cosine to the finger's, nearer than this share of its length."""
ALONG = 0.3  # least cosine of the angle between where a link faces and where its own hinge carries it; else its side is weak
ALONG_HINGE = 0.7
"""Least cosine of the angle between where a link faces and the axis of a hinge beyond: fingers bend across their hinges."""
ACROSS = "its own hinge carries it across the side that it faces"
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
UNCLEAR = "which side is the inner one is not clear"  # why a link has no inner side, where nothing better is known


@dataclass(frozen=True)
class InnerSide:
    """Where a link's inner side faces."""

    facing: tuple[float, ...] | None  # direction in the link's frame; None if it is not clear
    doubt: str = ""  # what speaks against it, or why it is not clear; empty if nothing does


class Flexion:
    """How a hand closes, and which side of each link is the inner one."""

    def __init__(self, tree: KinematicTree, hand: Hand):
        """Find which end of each joint's range is the closed one."""
        self.tree, self.hand = tree, hand
        self.closing = Closing(tree, hand)
        self.open, self.shut = self.closing.pose(0.0), self.closing.pose(1.0)
        bent = {joint: m.opened for joint, m in self.closing.motions.items() if self.closing.lean[joint]}
        self.straight = self.closing.poses.pose(bent)
        self.steps = {joint: self._step(joint) for joint in self.closing.motions}
        self.bars = self._bars()

    @property
    def num_closing(self) -> int:
        moved = {self.closing.chain[self.closing.segment(j)] for step in self.steps.values() for j in self._moving_joints(step)}
        return len(moved)

    @property
    def tips(self) -> list[int]:
        fixed = [] if self.hand.jaw is None else [self.hand.jaw]
        return [*fixed, *(tip for tip in self.hand.tips if self.tree.segment[tip] not in self.bars)]

    def motion(self) -> dict[int, tuple[float, float]]:
        poses = self.closing.poses
        moved = {j for step in self.steps.values() for j in self._moving_joints(step)}
        return {j: (float(self.open[poses.at(j)]), float(self.shut[poses.at(j)])) for j in sorted(moved)}

    def inner_side(self, body: int) -> InnerSide:
        """Return where the inner side of a body faces."""
        if body in self.hand.mounts:
            return self.palm_side(body) if self.hand.jaw is None else self._fixed_side(body)
        side = self._moving_side(body)
        return replace(side, doubt=ACROSS) if not side.doubt and self._is_across(body, side) else side

    def _moving_side(self, body: int) -> InnerSide:
        segment = self.tree.segment[body]
        if (facing := self._meeting(body)) is not None:
            return InnerSide(facing, next((self.closing.motions[joint].doubt for joint in self._nearest(segment)), ""))
        if (side := self._flexor(segment) or self._flexor(self.bars.get(segment, segment))) is None:
            return InnerSide(None, UNCLEAR)
        joint, along = side
        turned = self._frames(self.open).xmat[body].reshape(3, 3).T @ along
        return InnerSide(_link_side(turned), self.closing.motions[joint].doubt)

    def _is_across(self, body: int, side: InnerSide) -> bool:
        """Return whether hinges of a link's own have a lever on it and none carries it to its inner side or away from it."""
        data, model, segment = self._frames(self.open), self.tree.model, self.tree.segment[body]
        hinges = [j for j in self.tree.joints(segment) if int(model.jnt_type[j]) == _HINGE]
        if side.facing is None or not hinges:
            return False
        facing = data.xmat[body].reshape(3, 3) @ side.facing / np.linalg.norm(side.facing)
        carried = np.cross(data.xaxis[hinges], self.tree.middle(segment, data) - data.xanchor[hinges])
        lever = np.linalg.norm(carried, axis=1)
        has_lever = lever.min() >= MIN_LEVER * np.sqrt(self._area(segment))
        is_across = has_lever and bool((np.abs(carried @ facing) < ALONG * lever).all())
        return is_across and not any(self._is_along_hinge(segment, along) for along in carried / lever[:, None])

    def _bars(self) -> dict[int, int]:
        """Return the segments that are alone in their chain and are driven with a longer chain beside them, and its first."""
        chains = self.hand.chains
        single, longer = ([chain[0] for chain in chains if (len(chain) == 1) == is_single] for is_single in (True, False))
        bars = {s: other for s in single for other in longer if self._is_bar(s, other)}
        return bars if len(chains) - len(bars) > 1 else {}

    def _is_bar(self, segment: int, other: int) -> bool:
        """Return whether a segment is driven together with another, about axes that are parallel to and near that one's."""
        turns = [(self._turn(pose, segment), self._turn(pose, other)) for pose in self.steps.values()]
        moved = [(one, two) for one, two in turns if np.linalg.norm(one) > 1e-6]
        parallel = all(abs(one @ two) > PARALLEL * np.linalg.norm(one) * np.linalg.norm(two) > 0 for one, two in moved)
        first = [self.tree.joints(s)[:1] for s in (segment, other)]
        if not moved or not parallel or not all(first):
            return False
        one, two = (self._frames(self.open).xanchor[joints[0]].copy() for joints in first)
        return float(np.linalg.norm(one - two)) < BESIDE * length_of(self.tree, other)

    def _turn(self, pose: Float[np.ndarray, " qpos"], segment: int) -> Float[np.ndarray, " 3"]:
        joints = [joint for joint in self.tree.joints(segment) if joint in self.closing.poses.joints]
        at = [self.closing.poses.at(joint) for joint in joints]
        return (pose[at] - self.open[at]) @ self._frames(self.open).xaxis[joints] if joints else np.zeros(3)

    def _step(self, joint: int) -> Float[np.ndarray, " qpos"]:
        values = {other: motion.opened for other, motion in self.closing.motions.items()}
        values[joint] += STEP * (self.closing.motions[joint].closed - values[joint])
        return self.closing.poses.pose(values)

    def _moving_joints(self, pose: Float[np.ndarray, " qpos"]) -> list[int]:
        poses = self.closing.poses
        moved = {joint: abs(float(pose[poses.at(joint)] - self.open[poses.at(joint)])) for joint in poses.joints}
        return [joint for joint, by in moved.items() if by > 1e-3 * max(moved.values(), default=0.0)]

    def _frames(self, pose: Float[np.ndarray, " qpos"]) -> mujoco.MjData:
        return self.closing.poses.kinematics(pose)

    def _nearest(self, segment: int) -> list[int]:
        """Return the joints that move a segment, the one that moves it nearest to itself first."""
        path, result = self.tree.path(segment), {}
        for joint, pose in self.steps.items():
            depths = [path.index(s) for s in map(self.closing.segment, self._moving_joints(pose)) if s in path]
            if depths:
                result[joint] = min(depths)
        return sorted(result, key=lambda joint: (result[joint], joint))

    def _carry_direction(self, segment: int) -> tuple[int, Float[np.ndarray, " 3"]] | None:
        """Return the joint that carries a segment, with all that is fixed to it, and where to in the world in the open pose."""
        data = self._frames(self.open)
        middle, rotation = self.tree.middle(segment, data), data.xmat[segment].reshape(3, 3).copy()
        for joint in self._nearest(segment):
            data = self._frames(self.steps[joint])
            along = self.tree.middle(segment, data) - middle
            cosine = 0.5 * (np.trace(data.xmat[segment].reshape(3, 3) @ rotation.T) - 1.0)
            angle, size = float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(np.linalg.norm(along))
            lever = MIN_LEVER * np.sqrt(self._area(segment)) if self.hand.jaw is None else 0.0
            if size > 1e-9 and size >= lever * angle:
                return joint, along / size
        return None

    def _area(self, segment: int) -> float:
        return sum(self.tree.area[body] for body in self.tree.bodies[segment])

    def _flexor(self, segment: int) -> tuple[int, Float[np.ndarray, " 3"]] | None:
        """Return where a segment faces in the world in the open pose, and the joint that says so."""
        carried = self._carry_direction(segment)
        if carried is not None and not self._is_along_hinge(segment, carried[1]):
            return carried
        beyond = [s for s in self.tree.below(segment) if self.tree.bodies[s]]
        for other in sorted(beyond, key=lambda s: (len(self.tree.path(s)), s)):
            if (side := self._flexor(other)) is not None:
                along = self._frames(self.open).xmat[other].reshape(3, 3).T @ side[1]
                data = self._frames(self.straight)
                along = data.xmat[segment].reshape(3, 3).T @ data.xmat[other].reshape(3, 3) @ along
                return side[0], self._frames(self.open).xmat[segment].reshape(3, 3) @ along
        return carried

    def _is_along_hinge(self, segment: int, along: Float[np.ndarray, " 3"]) -> bool:
        data, beyond = self._frames(self.open), set(self.tree.below(segment))
        hinges = [j for j in self.motion() if self.closing.segment(j) in beyond and int(self.tree.model.jnt_type[j]) == _HINGE]
        return bool((np.abs(data.xaxis[hinges] @ along) > ALONG_HINGE).any())

    def _meeting(self, body: int) -> tuple[float, ...] | None:
        """Return where a body faces the tip of the other chain, of two that close on each other without curling."""
        segment, chain = self.tree.segment[body], self.closing.chain
        tips, jaws = self.tips, {self.tree.segment[tip] for tip in self.tips} & chain.keys()
        is_jaw = segment in jaws and len({chain[jaw] for jaw in jaws}) == 2
        if not is_jaw or not self.closing.motions or any(motion.is_curling for motion in self.closing.motions.values()):
            return None
        near = [tip for tip in tips if self.tree.segment[tip] == segment]
        far = [tip for tip in tips if chain[self.tree.segment[tip]] != chain[segment]]
        apart = []
        for pose in (self.open, self.closing.pose(1.0 - STEP), self.shut):
            data = self._frames(pose)
            mean = [np.mean([self.tree.centre(tip, data) for tip in some], axis=0) for some in (far, near)]
            apart.append(mean[0] - mean[1])
        along = apart[1] - apart[2]
        if float(np.linalg.norm(along)) < 1e-9 or along @ apart[0] < 0.5 * np.linalg.norm(along) * np.linalg.norm(apart[0]):
            return None
        rotation = self._frames(self.shut).xmat[body].reshape(3, 3)
        return _link_side(rotation.T @ along)

    def _fixed_side(self, body: int) -> InnerSide:
        """Return where a fixed jaw faces: against the moving one, as that comes to it."""
        tip = self.hand.tips[0]
        if (carried := self._carry_direction(self.tree.segment[tip])) is None:
            return InnerSide(None, UNCLEAR)
        joint, along = carried
        in_tip = self._frames(self.open).xmat[tip].reshape(3, 3).T @ along
        data = self._frames(self.shut)
        facing = -data.xmat[body].reshape(3, 3).T @ data.xmat[tip].reshape(3, 3) @ in_tip
        return InnerSide(_link_side(facing), self.closing.motions[joint].doubt)

    def palm_side(self, body: int) -> InnerSide:
        """Return where a palm's inner side faces, in the frame of it or of a body that is fixed to it."""
        turned = self._frames(self.open).xmat[body].reshape(3, 3).copy()
        curled = self._curl_direction()
        if curled is not None and (direction := _axis_near(turned.T @ curled, PALM_SNAP)) is not None:
            return InnerSide(direction)
        tips = [tip for tip in self.hand.tips if self._nearest(self.tree.segment[tip])]
        if self.hand.palm is None or not tips or 2 * len(tips) < len(self.hand.tips):
            return InnerSide(None, UNCLEAR)
        # What stands on a palm, such as a camera's tower, shifts its centre: the joints of the fingers may see better.
        joints = [anchor(self.tree, chain[0]) for chain in self.hand.chains]
        for start in (self.tree.centre(self.hand.palm, self._frames(self.open)), np.mean(joints, axis=0)):
            half, nearly, whole = (self._toward(start, body, tips, share) for share in (0.5, 0.75, 1.0))
            direction = _axis_near(nearly, PALM_SNAP)
            # Fingers that curl around cross the palm's plane where no palm is modelled in their way: no side is clear then.
            if direction is not None and min(half @ direction, whole @ direction) > 0.5:
                return InnerSide(direction)
        return InnerSide(None, UNCLEAR)

    def _curl_direction(self) -> Float[np.ndarray, " 3"] | None:
        """Return where most fingers, as they curl, carry their first bones in the open pose; None if no majority does."""
        curls, data, motion, place = [], self._frames(self.open), self.motion(), self.closing.segment
        curling = {j for joint, m in self.closing.motions.items() if m.is_curling for j in self.closing.rotations[joint]}
        for chain in self.hand.chains:
            hinges = sorted(
                (j for j in curling & motion.keys() if place(j) in chain), key=lambda j: len(self.tree.path(place(j)))
            )
            beyond = [j for j in hinges[1:] if place(hinges[0]) in self.tree.path(place(j))]
            if beyond:
                opened, closed = motion[hinges[0]]
                bone = data.xanchor[beyond[0]] - data.xanchor[hinges[0]]
                curls.append(np.cross(np.sign(closed - opened) * data.xaxis[hinges[0]], bone))
        curls = [along / max(float(np.linalg.norm(along)), 1e-9) for along in curls]
        alike = [[other for other in curls if one @ other > MIN_COSINE] for one in curls]
        most = max(alike, key=len, default=[])
        return np.mean(most, axis=0) if 2 * len(most) > len(self.hand.chains) else None

    def _toward(self, start: Float[np.ndarray, " 3"], body: int, tips: list[int], share: float) -> Float[np.ndarray, " 3"]:
        data = self._frames(self.closing.pose(share))
        toward = np.mean([self.tree.centre(tip, data) for tip in tips], axis=0) - start
        return data.xmat[body].reshape(3, 3).T @ toward / max(float(np.linalg.norm(toward)), 1e-9)


def _axis_near(direction: Float[np.ndarray, " 3"], angle: float) -> tuple[float, ...] | None:
    """Return the axis of the frame within an angle [rad] of a direction; None if none is."""
    direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
    axis = int(np.abs(direction).argmax())
    is_near = abs(direction[axis]) >= np.cos(angle)
    return tuple(float(np.sign(direction[axis])) if i == axis else 0.0 for i in range(3)) if is_near else None


def _link_side(direction: Float[np.ndarray, " 3"]) -> tuple[float, ...]:
    """Return the axis of the frame that is near a direction; if none is, its unit vector in hundredths."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-9)
    # Halves of a hundredth are rounded up, and what is just below them too.
    rounded = np.sign(unit) * np.floor(100.0 * np.abs(unit) + 0.501) / 100.0
    return _axis_near(direction, LINK_SNAP) or tuple((rounded + 0.0).tolist())
