"""Where the inner side of each link of a hand faces; None if it is not clear.

In the open pose, a link's inner side faces the direction in which the link moves as the nearest joint above it that has a lever
on it closes. A link before all closing joints takes the side of the nearest link beyond. The last links of two chains that
close on each other without curling face each other along the line on which they meet. A palm's inner side is the
one on which all fingers stand if they close above its middle; else it faces the closing tips, a fixed jaw's the moving jaw.

`PalmFront` finds the surface of a palm that an object can reach: no surface behind other fixed bodies or outside the hand.

Lengths are in metres. Heights are along the palm's inner side. A point is outside the hand if, seen from the front of the palm,
it is outside the convex outline of the fingers' sweep as they close.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from tgdsl.placement.propose.closing import Closing
from tgdsl.placement.propose.hands import Hand, KinematicTree, anchor, length_of
from tgdsl.surfaces.rays import OrthographicView, first_hits, frame
from tgdsl.surfaces.surface import Surface

MIN_LEVER = 0.25
"""A link whose centre is nearer to its hinge than this share of the square root of its surface turns in place, unless it is a
single jaw."""
LINK_SNAP, PALM_SNAP = np.radians(30.1), np.radians(40.1)
"""A direction this close to a flat side's normal, or to an axis of the link's frame, snaps to it; a palm's direction that is
farther is rejected. No angles that occur in drawings: the last bits of a pose must not decide."""
FLAT, ALIKE = 0.35, np.radians(3.1)
"""Least share of the faces that look along a direction that a flat side has, and the largest angle between normals of one."""
MAX_SIDES = 32  # faces that are tried as parts of it, from the largest on
TURNED = np.radians(15.1)  # an axis this close to a flat side's normal replaces it; the adjacent sides are excluded
STEP = 0.02  # share of its range by which a joint closes to find where a link moves
MIN_COSINE = 0.5  # least cosine between the directions in which fingers curl, if they are to decide where the palm faces
ABOVE, STANDING = 0.95, 0.8
"""Least cosine of the angle to a palm's side at which tips are above its middle, and the least height of the joints of fingers
that stand on it, as a share of the palm's own from its centre."""
PARALLEL, BESIDE = 0.99, 0.25
"""A bar next to a finger turns about an axis with at least this cosine to the finger's, nearer than this part of its length."""
ALONG = 0.3  # least cosine of the angle between where a link faces and where its own hinge carries it; else its side is weak
ALONG_HINGE = 0.7
"""Least cosine of the angle between where a link faces and the axis of a hinge beyond: fingers bend across their hinges."""
ACROSS = "its own hinge carries it across the side that it faces"
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
UNCLEAR = "which side is the inner one is not clear"  # why a link has no inner side, where nothing better is known


@dataclass(frozen=True)
class InnerSide:
    """The direction of a link's inner side."""

    facing: tuple[float, ...] | None  # direction in the link's frame; None if it is not clear
    doubt: str = ""  # evidence against it, or why it is not clear; empty if there is none


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
        self.moved = {joint: self._moving_joints(pose) for joint, pose in self.steps.items()}
        self.bars = self._bars()

    @property
    def num_closing(self) -> int:
        return len({self.closing.chain[self.closing.segment(joint)] for moved in self.moved.values() for joint in moved})

    @property
    def tips(self) -> list[int]:
        fixed = [] if self.hand.jaw is None else [self.hand.jaw]
        return [*fixed, *(tip for tip in self.hand.tips if self.tree.segment[tip] not in self.bars)]

    def motion(self) -> dict[int, tuple[float, float]]:
        poses = self.closing.poses
        moved = {joint for joints in self.moved.values() for joint in joints}
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
        return InnerSide(self._link_side(body, turned), self.closing.motions[joint].doubt)

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
        """Return single-segment chains driven together with a longer chain next to them, with that chain's first segment."""
        chains = self.hand.chains
        single, longer = ([chain[0] for chain in chains if (len(chain) == 1) == is_single] for is_single in (True, False))
        bars = {s: other for s in single for other in longer if self._is_bar(s, other)}
        return bars if len(chains) - len(bars) > 1 else {}

    def _is_bar(self, segment: int, other: int) -> bool:
        """Return whether a segment is driven together with another, about axes parallel and near to the other's."""
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
        least = 1e-3 * max(moved.values(), default=0.0)
        return [joint for joint, by in moved.items() if by > least]

    def _frames(self, pose: Float[np.ndarray, " qpos"]) -> mujoco.MjData:
        return self.closing.poses.kinematics(pose)

    def _nearest(self, segment: int) -> list[int]:
        """Return the joints that move a segment, the one that moves it nearest to itself first."""
        path, result = self.tree.path(segment), {}
        for joint, moved in self.moved.items():
            depths = [path.index(s) for s in map(self.closing.segment, moved) if s in path]
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
        return self._link_side(body, rotation.T @ along)

    def _fixed_side(self, body: int) -> InnerSide:
        """Return where a fixed jaw faces: against the moving one, as that comes to it."""
        tip = self.hand.tips[0]
        if (carried := self._carry_direction(self.tree.segment[tip])) is None:
            return InnerSide(None, UNCLEAR)
        joint, along = carried
        in_tip = self._frames(self.open).xmat[tip].reshape(3, 3).T @ along
        data = self._frames(self.shut)
        facing = -data.xmat[body].reshape(3, 3).T @ data.xmat[tip].reshape(3, 3) @ in_tip
        return InnerSide(self._link_side(body, facing), self.closing.motions[joint].doubt)

    def palm_side(self, body: int) -> InnerSide:
        """Return where a palm's inner side faces, in the frame of it or of a body that is fixed to it."""
        if (side := self._side_with_fingers(body)) is not None:
            return InnerSide(side)
        turned = self._frames(self.open).xmat[body].reshape(3, 3).copy()
        curled = self._curl_direction()
        if curled is not None and (direction := self._snapped(body, turned.T @ curled, PALM_SNAP)) is not None:
            return InnerSide(direction)
        tips = [tip for tip in self.hand.tips if self._nearest(self.tree.segment[tip])]
        if self.hand.palm is None or not tips or 2 * len(tips) < len(self.hand.tips):
            return InnerSide(None, UNCLEAR)
        # What stands on a palm, such as a camera's tower, shifts its centre: the joints of the fingers may see better.
        joints = [anchor(self.tree, chain[0]) for chain in self.hand.chains]
        for start in (self.tree.centre(self.hand.palm, self._frames(self.open)), np.mean(joints, axis=0)):
            half, nearly, whole = (self._toward(start, body, tips, share) for share in (0.5, 0.75, 1.0))
            direction = self._snapped(body, nearly, PALM_SNAP)
            # Fingers that curl around cross the palm's plane where no palm is modelled in their way: no side is clear then.
            if direction is not None and min(half @ direction, whole @ direction) > 0.5:
                return InnerSide(direction)
        return InnerSide(None, UNCLEAR)

    def _side_with_fingers(self, body: int) -> tuple[float, ...] | None:
        """Return the side of a palm on which all fingers stand, if their half closed tips are above its middle."""
        palm, chains, data = self.hand.palm, self.hand.chains, self.tree.start
        if palm is None or len(chains) < 2:
            return None
        centre = self.tree.centre(palm, data)
        half = self._toward(centre, body, self.hand.tips, 0.5)
        direction = self._snapped(body, half, PALM_SNAP)
        if direction is None or half @ direction < ABOVE * np.linalg.norm(direction):
            return None
        along = data.xmat[body].reshape(3, 3) @ direction
        height = (self.tree.points(palm, data) - centre) @ along
        roots = np.array([anchor(self.tree, chain[0]) - centre for chain in chains]) @ along
        return direction if roots.min() >= STANDING * height.max() else None

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

    def _link_side(self, body: int, direction: Float[np.ndarray, " 3"]) -> tuple[float, ...]:
        """Return the side of a link that a direction in its frame means; the direction itself if that is near to none."""
        return self._snapped(body, direction, LINK_SNAP) or _in_hundredths(direction)

    def _snapped(self, body: int, direction: Float[np.ndarray, " 3"], angle: float) -> tuple[float, ...] | None:
        """Return the flat side, else the axis of a body's frame, within an angle [rad] of a direction; None if none is."""
        side = _flat_side(self.tree.surface[body], direction / max(float(np.linalg.norm(direction)), 1e-9), angle)
        if side is None:
            return _axis_near(direction, angle)
        return _axis_near(side, TURNED) or _in_hundredths(side)

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


def _flat_side(surface: Surface, direction: Float[np.ndarray, " 3"], angle: float) -> Float[np.ndarray, " 3"] | None:
    """Return a normal of the largest flat side within an angle [rad] of a unit vector; None if none is large enough."""
    along = surface.face_normals @ direction
    near, least = along >= np.cos(angle), FLAT * surface.face_areas @ (along >= np.cos(np.radians(WITHIN_DEG)))
    normals, areas = surface.face_normals[near], surface.face_areas[near]
    for i in np.argsort(-areas, kind="stable")[:MAX_SIDES]:
        is_alike = normals @ normals[i] >= np.cos(ALIKE)
        if areas @ is_alike >= least:
            return (areas * is_alike) @ normals
    return None


def _in_hundredths(direction: Float[np.ndarray, " 3"]) -> tuple[float, ...]:
    unit = direction / max(float(np.linalg.norm(direction)), 1e-9)
    # Halves of a hundredth, and numbers just below them, are rounded up.
    rounded = np.sign(unit) * np.floor(100.0 * np.abs(unit) + 0.501) / 100.0
    return tuple((rounded + 0.0).tolist())


WITHIN_DEG = 75  # largest angle between a normal and the inner side of its link [deg]
RASTER = 40  # rays along the longer side of a surface
GAP = 2e-4  # a surface counts as in front of another from this distance on [m]
MIN_SHARE = 0.1  # least share of the surface that faces an inner side, and of a link's surface, to count
MARGIN, LEVEL, TOWER, AHEAD = 0.15, 0.2, 0.25, 0.1
"""Shares of a finger's length: a hand's margin around its fingers' sweep, the largest difference in height of a palm's parts,
a tower's least height above the fingers' joints, and the least offset of the fingers from a palm's middle to be ahead of it."""
HALF = 0.5  # a part of a palm is in front by this share, and has this share of the largest part's area


def front_of(
    tree: KinematicTree, body: int, facing: tuple[float, ...]
) -> tuple[Float[np.ndarray, "point 3"], Bool[np.ndarray, " point"]]:
    """Return evenly spaced points of a body, and whether no other body of its segment is in front of them."""
    direction = np.array(facing) / np.linalg.norm(facing)
    axes, view = frame(-direction), OrthographicView.of(tree.surface[body], frame(-direction))
    corners = view.corners[..., :2].reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    num = np.maximum(np.ceil(RASTER * (high - low) / (high - low).max()), 1.0)
    grid = [lowest + (np.arange(n) + 0.5) * (highest - lowest) / n for lowest, highest, n in zip(low, high, num, strict=True)]
    uv = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 2)
    hits = first_hits(view, uv)
    is_facing = (hits.face >= 0) & (-view.normals[hits.face] @ axes[2] >= np.cos(np.radians(WITHIN_DEG)))
    pos = np.column_stack([uv, hits.depth])[is_facing] @ axes
    data, turn = tree.start, tree.start.xmat[body].reshape(3, 3).T
    fixed = [
        tree.surface[other].placed(turn @ (data.xpos[other] - data.xpos[body]), turn @ data.xmat[other].reshape(3, 3))
        for other in tree.bodies[tree.segment[body]]
        if other != body
    ]
    ahead = first_hits(OrthographicView.of(Surface.joined(fixed), axes), uv[is_facing]).depth if fixed else np.inf
    return pos, np.broadcast_to(ahead >= hits.depth[is_facing] - GAP, len(pos))


def hidden(flexion: Flexion) -> list[int]:
    """Return the bodies of a hand whose inner side is behind other bodies fixed to them."""
    tree, result = flexion.tree, list[int]()
    for body in (*flexion.hand.mounts, *flexion.hand.fingers):
        facing = flexion.inner_side(body).facing
        if facing is not None and len(tree.bodies[tree.segment[body]]) > 1:
            _, is_free = front_of(tree, body, facing)
            if len(is_free) and is_free.mean() < MIN_SHARE:
                result.append(body)
    return result


def palm_parts(flexion: Flexion) -> list[int]:
    hand, area = flexion.hand, flexion.tree.area
    return [] if hand.palm is None else [body for body in hand.mounts if area[body] >= HALF * area[hand.palm]]


class PalmFront:
    """A palm and the bodies fixed to it, seen from the front."""

    def __init__(self, flexion: Flexion):
        """Find the outline of the fingers' sweep."""
        self.flexion, tree, hand = flexion, flexion.tree, flexion.hand
        assert hand.palm is not None
        facing = flexion.palm_side(hand.palm).facing
        self.axes = (
            None if facing is None else frame(tree.start.xmat[hand.palm].reshape(3, 3) @ facing / np.linalg.norm(facing))
        )
        if self.axes is not None:
            poses = (flexion.open, flexion.closing.pose(0.5), flexion.shut)
            swept = [tree.points(b, flexion.closing.poses.kinematics(pose)) for pose in poses for b in hand.fingers]
            self.outline = ConvexHull(np.concatenate(swept) @ self.axes[:2].T).equations
            self.margin = MARGIN * hand.length
            first = [chain[0] for chain in hand.chains]
            anchors = np.array([anchor(tree, s) for s in first]) @ self.axes.T
            self.joints = float(anchors[:, 2].max())
            ahead = anchors.mean(axis=0) - self.axes @ tree.centre(hand.palm, tree.start)
            self.ahead = np.where(np.linalg.norm(ahead[:2]) > AHEAD * hand.length, ahead * (1, 1, 0), 0.0)

    def mounts(self) -> list[int]:
        """Return the bodies fixed to a palm that are in front, those before the one that carries the fingers included."""
        tree, hand = self.flexion.tree, self.flexion.hand
        if self.axes is None:
            return hand.mounts
        assert hand.palm is not None
        free, place, _ = self._points(hand.palm)
        level = float(np.median(place[free, 2])) if free.any() else None
        heel = float((place @ self.ahead).min(initial=np.inf))
        return [body for body in tree.bodies[hand.base] if body == hand.palm or self._is_in_front(body, level, heel)]

    def _is_in_front(self, body: int, level: float | None, heel: float) -> bool:
        """Return whether a body is in front."""
        free, place, is_beside = self._points(body)
        tree, hand = self.flexion.tree, self.flexion.hand
        assert hand.palm is not None
        if body in hand.mounts:
            return not len(free) or bool((~is_beside).mean() >= MIN_SHARE)
        if level is None or not len(free) or HALF * tree.area[body] > tree.area[hand.palm]:  # a larger one is a flange
            return False
        is_level = (np.abs(place[:, 2] - level) <= LEVEL * hand.length) & (place @ self.ahead >= heel)
        return bool((free & ~is_beside & is_level).mean() >= HALF)

    def limit(self, body: int) -> float | None:
        """Return the height in its frame above which a body is a tower outside the hand [m]; None if it has no tower."""
        if self.axes is None:
            return None
        _, place, is_beside = self._points(body)
        height = place[:, 2]
        limit = self.joints + TOWER * self.flexion.hand.length
        is_high = height > limit
        least = MIN_SHARE * len(height)
        if (is_high & is_beside).sum() <= least or (is_high & ~is_beside).sum() >= least:
            return None
        return limit - float(self.flexion.tree.start.xpos[body] @ self.axes[2])

    def _points(self, body: int) -> tuple[Bool[np.ndarray, " p"], Float[np.ndarray, "p 3"], Bool[np.ndarray, " p"]]:
        """Return whether points of a body are free, their coordinates along `axes` [m], and whether they are off the hand."""
        facing, data = self.flexion.palm_side(body).facing, self.flexion.tree.start
        if facing is None:
            return np.zeros(0, bool), np.zeros((0, 3)), np.zeros(0, bool)
        pos, is_free = front_of(self.flexion.tree, body, facing)
        assert self.axes is not None
        place = (data.xpos[body] + pos @ data.xmat[body].reshape(3, 3).T) @ self.axes.T
        beyond = (place[:, :2] @ self.outline[:, :2].T + self.outline[:, 2]).max(axis=1, initial=-np.inf)
        return is_free, place, beyond > self.margin
