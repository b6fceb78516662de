"""Convex solids: primitives and convex hulls, as a simulator collides them, and the depth of points inside.

Shapes: `n` points, `k` half-spaces of a hull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.surfaces.surface import Surface

CELLS = 8  # cells along each axis into which points are sorted, if points and planes are many
CHUNK = 1 << 21  # distances from half-spaces that are in memory at once
SLACK = 1e-6  # widening of a bounding box [m]: points just outside have a small distance, not an infinite one


@dataclass(frozen=True, eq=False)
class ConvexSolid:
    """A primitive or a convex hull, somewhere in a frame."""

    shape: str  # the primitive's type, or `mesh`
    size: Float[np.ndarray, " 3"]  # its size as MuJoCo defines it [m]
    pos: Float[np.ndarray, " 3"]  # its frame's origin [m]
    rotation: Float[np.ndarray, "3 3"]  # rotates vectors of its frame into the frame that it is in
    # outward unit normals and offsets [m] of a hull's faces, in its own frame; of a primitive none
    planes: Float[np.ndarray, "k 4"]
    low: Float[np.ndarray, " 3"]  # lower corner of its bounding box, in its own frame [m]
    high: Float[np.ndarray, " 3"]  # upper corner

    def depth(self, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the distance of points inside to the surface [m].

        Outside it is negative: the point is at least as far away, and −∞ says that it is outside the bounding box.
        """
        depth = np.full(len(pos), -np.inf)
        local = (pos - self.pos) @ self.rotation
        in_box = (local >= self.low - SLACK) & (local <= self.high + SLACK)
        near = np.flatnonzero(in_box[:, 0] & in_box[:, 1] & in_box[:, 2])  # faster than a reduction over so short an axis
        if len(near):
            depth[near] = self._from_planes(local[near]) if len(self.planes) else -self._distance(local[near])
        return depth

    def is_beyond(self, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]) -> bool:
        """Return whether a box of the outer frame [m] misses the sphere around the solid's bounding box."""
        middle = self.pos + self.rotation @ (0.5 * (self.low + self.high))
        gap = np.linalg.norm(np.maximum(np.maximum(low - middle, middle - high), 0.0))
        return bool(gap > 0.5 * np.linalg.norm(self.high - self.low) + 2.0 * SLACK)

    def _from_planes(self, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the distance from the nearest face's plane, which is the surface's for points inside."""
        # Over a cell of points within r of its middle, a plane's distance changes by at most r: planes farther from the middle
        # than the nearest one by more than 2r are nearest to none of its points.
        if len(pos) * len(self.planes) <= CHUNK:
            return (self.planes[:, 3] - pos @ self.planes[:, :3].T).min(axis=1)
        step = np.maximum(np.ptp(pos, axis=0), SLACK) / CELLS
        cell = np.floor((pos - pos.min(axis=0)) / step).astype(np.int64) @ [4 * CELLS**2, 2 * CELLS, 1]
        order = np.argsort(cell, kind="stable")
        depth = np.empty(len(pos))
        for members in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1):
            middle = pos[members].mean(axis=0)
            r = np.linalg.norm(pos[members] - middle, axis=1).max()
            apart = self.planes[:, 3] - self.planes[:, :3] @ middle
            near = self.planes[apart <= apart.min() + 2.0 * r + SLACK]
            depth[members] = (near[:, 3] - pos[members] @ near[:, :3].T).min(axis=1)
        return depth

    def _distance(self, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        import torch  # takes seconds, and hulls do not need it

        from tgdsl.geometry.shapes import SHAPES

        x, y, z = torch.from_numpy(pos.T.copy())
        a, b, c = torch.from_numpy(self.size.astype(np.float64))
        return SHAPES[self.shape]((x, y, z), (a, b, c))[0].numpy()


def hull_planes(hull: Surface) -> Float[np.ndarray, "k 4"]:
    """Return outward unit normals and offsets of the planes that support a convex surface at its faces.

    The offset is the farthest vertex', not the face's: the plane of a tiny face may have any direction and would cut the solid.
    """
    normals = np.unique(hull.face_normals[hull.face_areas > 0].round(12), axis=0)
    rows = max(1, CHUNK // len(hull.vertices))
    parts = (normals[start : start + rows] for start in range(0, len(normals), rows))
    offsets = np.concatenate([(part @ hull.vertices.T).max(axis=1) for part in parts])
    return np.column_stack([normals, offsets])
