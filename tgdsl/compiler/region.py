"""Part of a surface: where its faces look, boxes, spheres and geoms, and where such a part reaches farthest.

Shapes: `n` faces or points, `m` corners of polygons or points on them, `k` what is left of `n`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

LENGTH_TOLERANCE = 1e-7
"""Points this close to a region's border belong to it [m]: float32 mesh files round by about as much."""
ANGLE_TOLERANCE = 1e-9
"""The same for angles [rad]."""


@dataclass(frozen=True, eq=False)
class Region:
    """Part of a surface: the intersection of parts, all in the body frame.

    Attributes:
        is_geom: Which of the surface's geoms belong to it; None: all.
        facings: Unit direction and largest angle [rad] between it and the outward normal.
        boxes: Lower and upper corner [m].
        spheres: Centre and radius [m].
    """

    is_geom: Bool[np.ndarray, " geom"] | None
    facings: tuple[tuple[Float[np.ndarray, " 3"], float], ...]
    boxes: tuple[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]], ...]
    spheres: tuple[tuple[Float[np.ndarray, " 3"], float], ...]

    @property
    def is_everything(self) -> bool:
        """Whether nothing is left out."""
        return self.is_geom is None and not (self.facings or self.boxes or self.spheres)

    def has_faces(self, normals: Float[np.ndarray, "n 3"], geom: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return which faces may belong, by their outward unit normals (body frame) and geoms."""
        is_in = np.ones(len(normals), dtype=bool) if self.is_geom is None else self.is_geom[geom]
        for direction, within in self.facings:
            sine = np.linalg.norm(np.cross(normals, direction), axis=1)
            is_in = is_in & (np.arctan2(sine, normals @ direction) <= within + ANGLE_TOLERANCE)
        return is_in

    def has_points(self, pos: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Return which points of such faces belong, by position (body frame) [m]."""
        is_in = np.ones(pos.shape[:-1], dtype=bool)
        for low, high in self.boxes:
            is_in &= ((pos >= low - LENGTH_TOLERANCE) & (pos <= high + LENGTH_TOLERANCE)).all(axis=-1)
        for center, radius in self.spheres:
            is_in &= np.linalg.norm(pos - center, axis=-1) <= radius + LENGTH_TOLERANCE
        return is_in

    def clipped(self, corners: Float[np.ndarray, "n 3 3"]) -> tuple[Float[np.ndarray, "k m 3"], Int[np.ndarray, " k"]]:
        """Return what boxes, and the boxes around spheres, leave of faces: convex polygons and the face of each.

        Polygons with fewer than `m` corners repeat their last.
        """
        polygons, owner = corners, np.arange(len(corners))
        for bounds in (*self.boxes, *((center - radius, center + radius) for center, radius in self.spheres)):
            for side, bound in zip((-1.0, 1.0), bounds, strict=True):
                for axis in range(3):
                    polygons, kept = _clipped(polygons, axis, side, bound[axis])
                    owner = owner[kept]
        return polygons, owner

    def extremes(
        self, corners: Float[np.ndarray, "n 3 3"], normals: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "2 3"]
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Return the points where the part of a face in the region can reach farthest along some axes.

        Args:
            corners: The faces' corners (body frame) [m].
            normals: Their unit normals (body frame).
            axes: Unit vectors (body frame).

        Returns:
            The points, and for each a point within its face, both in the body frame [m].
        """
        polygons, owner = self.clipped(corners)
        found = [polygons]
        for center, radius in self.spheres:
            found.append(_rim(polygons, center, radius))
            found.append(_disc(corners[owner], normals[owner], axes, center, radius))
        points = np.concatenate(found, axis=1)
        inner = np.broadcast_to(polygons.mean(axis=1, keepdims=True), points.shape)
        is_in = self.has_points(points)  # false for NaN
        return points[is_in], inner[is_in]


def _clipped(
    polygons: Float[np.ndarray, "n m 3"], axis: int, side: float, bound: float
) -> tuple[Float[np.ndarray, "k m+1 3"], Int[np.ndarray, " k"]]:
    """Return convex polygons cut at a plane, and which are left; a polygon with few corners repeats its last."""
    height = side * (polygons[..., axis] - bound)
    height = np.where(np.abs(height) <= LENGTH_TOLERANCE, 0.0, height)
    polygons = polygons.copy()
    polygons[..., axis] = np.where(height == 0.0, bound, polygons[..., axis])
    next_height, following = np.roll(height, -1, axis=1), np.roll(polygons, -1, axis=1)
    is_cut = height * next_height < 0
    share = np.divide(height, height - next_height, out=np.zeros_like(height), where=is_cut)
    cut = polygons + share[..., None] * (following - polygons)
    cut[..., axis] = bound
    count, size = height.shape
    points = np.stack([polygons, cut], axis=2).reshape(count, 2 * size, 3)
    is_kept = np.stack([height <= 0, is_cut], axis=2).reshape(count, 2 * size)
    num = is_kept.sum(axis=1)
    order = np.argsort(~is_kept, axis=1, kind="stable")
    slot = np.minimum(np.arange(size + 1), np.maximum(num - 1, 0)[:, None])
    kept = np.flatnonzero(num)
    return np.take_along_axis(points, np.take_along_axis(order, slot, 1)[..., None], 1)[kept], kept


def _rim(polygons: Float[np.ndarray, "n m 3"], center: Float[np.ndarray, " 3"], radius: float) -> Float[np.ndarray, "n k 3"]:
    """Return where the edges of polygons pass through a sphere; NaN where they do not."""
    start, along = polygons - center, np.roll(polygons, -1, axis=1) - polygons
    a, b = (along**2).sum(-1), (start * along).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b**2 - a * ((start**2).sum(-1) - radius**2))
        share = np.concatenate([(-b - root) / a, (-b + root) / a], axis=1)
    share = np.where((share >= 0) & (share <= 1), share, np.nan)
    return np.tile(polygons, (1, 2, 1)) + share[..., None] * np.tile(along, (1, 2, 1))


def _disc(
    corners: Float[np.ndarray, "n 3 3"],
    normals: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "2 3"],
    center: Float[np.ndarray, " 3"],
    radius: float,
) -> Float[np.ndarray, "n 4 3"]:
    """Return where the disc that a sphere cuts out of a face's plane reaches farthest along ±axes; NaN off the face."""
    height = ((corners[:, 0] - center) * normals).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        disc_radius = np.sqrt(radius**2 - height**2)
        axes = np.concatenate([axes, -axes])
        toward = axes - (normals @ axes.T)[..., None] * normals[:, None]
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    points = (center + height[:, None] * normals)[:, None] + disc_radius[:, None, None] * toward
    along = np.roll(corners, -1, axis=1) - corners
    inward = np.cross(normals[:, None], along)
    offset = np.einsum("nkpx,nkx->npk", points[:, None] - corners[:, :, None], inward)
    is_on = (offset >= 0).all(axis=-1) | (offset <= 0).all(axis=-1)
    return np.where(is_on[..., None], points, np.nan)
