"""What an object in front of a palm or a link can come to: not what is behind other bodies fixed to it, or beside the hand.

Lengths are in metres. Heights are along the palm's inner side; a place is beside the hand if it is outside the convex outline
of all that the fingers sweep as they close, seen from in front of the palm.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from tgdsl.placement.propose.flexion import Flexion
from tgdsl.placement.propose.hands import KinematicTree, anchor
from tgdsl.surfaces.rays import OrthographicView, first_hits, frame
from tgdsl.surfaces.surface import Surface

WITHIN_DEG = 75  # largest angle between a normal and the inner side of its link [deg]
RASTER = 40  # rays along the longer side of a surface
GAP = 2e-4  # what is closer in front of a surface than this is not in front of it [m]
MIN_SHARE = 0.1  # least share of what faces an inner side, and of a link's surface, to be believed
MARGIN, LEVEL, TOWER, AHEAD = 0.15, 0.2, 0.25, 0.1
"""Shares of a finger's length: how far beside its fingers a hand ends, how much parts of a palm differ in height, how high
above the joints of the fingers a tower is, and how far beside the middle of a palm the fingers must begin to be ahead of it."""
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
    others = [
        tree.surface[other].placed(turn @ (data.xpos[other] - data.xpos[body]), turn @ data.xmat[other].reshape(3, 3))
        for other in tree.bodies[tree.segment[body]]
        if other != body
    ]
    ahead = first_hits(OrthographicView.of(Surface.joined(others), axes), uv[is_facing]).depth if others else np.inf
    return pos, np.broadcast_to(ahead >= hits.depth[is_facing] - GAP, len(pos))


def hidden(flexion: Flexion) -> list[int]:
    """Return the bodies of a hand whose inner side is behind other bodies that are fixed to them."""
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
    """A palm and what is fixed to it, seen from where an object comes.

    Attributes:
        flexion: The hand.
    """

    def __init__(self, flexion: Flexion):
        """Find the outline of what the fingers sweep."""
        self.flexion, tree, hand = flexion, flexion.tree, flexion.hand
        assert hand.palm is not None
        facing = flexion.palm_side(hand.palm).facing
        self.axes = None if facing is None else frame(tree.start.xmat[hand.palm].reshape(3, 3) @ facing)
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
        """Return how far along its inner side a body is no tower beside the hand, in its frame; None if it has none."""
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
        """Return whether points of a body are free, their places along `axes` [m], and whether they are beside the hand."""
        facing, data = self.flexion.palm_side(body).facing, self.flexion.tree.start
        if facing is None:
            return np.zeros(0, bool), np.zeros((0, 3)), np.zeros(0, bool)
        pos, is_free = front_of(self.flexion.tree, body, facing)
        assert self.axes is not None
        place = (data.xpos[body] + pos @ data.xmat[body].reshape(3, 3).T) @ self.axes.T
        beyond = (place[:, :2] @ self.outline[:, :2].T + self.outline[:, 2]).max(axis=1, initial=-np.inf)
        return is_free, place, beyond > self.margin
