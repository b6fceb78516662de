"""Part of a surface: by its faces' directions, boxes, spheres and geoms; and the extreme points of such a part.

Shapes: `n` faces or points, `m` corners of polygons or points on them, `k` remaining ones of `n`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.errors import SampleError, did_you_mean
from tgdsl.fields.models import Selection
from tgdsl.fields.regions import Facing, InBox, InSphere, OnGeoms, RegionPart
from tgdsl.surfaces.surface import Surface, face_areas

LENGTH_TOLERANCE = 1e-6  # points this close to a region's border belong to it [m]: about the rounding of float32 mesh files
ANGLE_TOLERANCE = 1e-4
"""The same for the normals of faces a millimetre wide [rad]: a chamfer of 45° is within 45°, however its corners round."""
Covered = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]  # returns which points of the body frame [m] are covered


@dataclass(frozen=True, eq=False)
class Region:
    """Part of a surface: the intersection of parts, all in the body frame."""

    is_geom: Bool[np.ndarray, " geom"] | None  # which of the surface's geoms belong to it; None: all
    # unit direction and largest angle [rad] between it and the outward normal
    facings: tuple[tuple[Float[np.ndarray, " 3"], float], ...]
    boxes: tuple[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]], ...]  # lower and upper corner [m]
    spheres: tuple[tuple[Float[np.ndarray, " 3"], float], ...]  # centre and radius [m]
    is_covered: Covered | None = None  # returns which points are left out because other solids cover them; None: none

    @staticmethod
    def of(surface: Surface, parts: Sequence[RegionPart], is_covered: Covered | None = None) -> Region:
        """Return the region that a user specified on a link's surface, without the parts that other solids cover.

        Raises:
            SampleError: If the link has no such geom.
        """
        is_geom = None
        for part in parts:
            if isinstance(part, OnGeoms):
                mask = _geom_mask(surface, part.geoms)
                is_geom = mask if is_geom is None else is_geom & mask
        return Region(
            is_geom=is_geom,
            facings=tuple((unit(np.array(part.facing)), part.within) for part in parts if isinstance(part, Facing)),
            boxes=tuple((np.array(part.box.min), np.array(part.box.max)) for part in parts if isinstance(part, InBox)),
            spheres=tuple((np.array(part.sphere.center), part.sphere.radius) for part in parts if isinstance(part, InSphere)),
            is_covered=is_covered,
        )

    @property
    def is_everything(self) -> bool:
        """Whether nothing is left out."""
        return self.is_geom is None and self.is_covered is None and not (self.facings or self.boxes or self.spheres)

    def has_faces(self, normals: Float[np.ndarray, "n 3"], geom: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return which faces may belong to it, by their outward unit normals (body frame) and geoms."""
        is_in = np.ones(len(normals), dtype=bool) if self.is_geom is None else self.is_geom[geom]
        for direction, within in self.facings:
            sine = np.linalg.norm(np.cross(normals, direction), axis=1)
            is_in = is_in & (np.arctan2(sine, normals @ direction) <= within + ANGLE_TOLERANCE)
        return is_in

    def has_points(self, pos: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Return which points of such faces belong to it, by position (body frame) [m]."""
        is_in = self.is_within(pos)
        if self.is_covered is not None:
            is_in[is_in] = ~self.is_covered(pos[is_in])
        return is_in

    def is_within(self, pos: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Return which points are in all boxes and spheres, whether covered or not."""
        is_in = np.ones(pos.shape[:-1], dtype=bool)
        for low, high in self.boxes:
            is_in &= ((pos >= low - LENGTH_TOLERANCE) & (pos <= high + LENGTH_TOLERANCE)).all(axis=-1)
        for center, radius in self.spheres:
            is_in &= np.linalg.norm(pos - center, axis=-1) <= radius + LENGTH_TOLERANCE
        return is_in

    def clipped(self, corners: Float[np.ndarray, "n 3 3"]) -> tuple[Float[np.ndarray, "k m 3"], Int[np.ndarray, " k"]]:
        """Return faces clipped to the boxes, and to the boxes around spheres: convex polygons and the face of each.

        Polygons with fewer than `m` corners repeat their last.
        """
        polygons, owner = corners, np.arange(len(corners))
        for bounds in (*self.boxes, *((center - radius, center + radius) for center, radius in self.spheres)):
            for side, bound in zip((-1.0, 1.0), bounds, strict=True):
                for axis in range(3):
                    polygons, rows = _clipped(polygons, axis, side, bound[axis])
                    owner = owner[rows]
        return polygons, owner

    def extremes(
        self, corners: Float[np.ndarray, "n 3 3"], normals: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "2 3"]
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Return candidates for the extreme points of each face's part in the region, covered or not, along some axes.

        Each comes with a point within its face. Normals and axes are unit vectors, all in the body frame [m].
        """
        polygons, owner = self.clipped(corners)
        candidates = [polygons]
        for center, radius in self.spheres:
            candidates.append(_rim(polygons, center, radius))
            candidates.append(_disc(corners[owner], normals[owner], axes, center, radius))
        points = np.concatenate(candidates, axis=1)
        inner = np.broadcast_to(polygons.mean(axis=1, keepdims=True), points.shape)
        is_in = self.is_within(points)  # false for NaN
        return points[is_in], inner[is_in]


def _clipped(
    polygons: Float[np.ndarray, "n m 3"], axis: int, side: float, bound: float
) -> tuple[Float[np.ndarray, "k m+1 3"], Int[np.ndarray, " k"]]:
    """Return convex polygons cut at a plane, and the rows that remain; a polygon with few corners repeats its last."""
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
    rows = np.flatnonzero(num)
    return np.take_along_axis(points, np.take_along_axis(order, slot, 1)[..., None], 1)[rows], rows


def _rim(polygons: Float[np.ndarray, "n m 3"], center: Float[np.ndarray, " 3"], radius: float) -> Float[np.ndarray, "n k 3"]:
    """Return the intersections of polygons' edges with a sphere; NaN where there is none."""
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
    """Return the extreme points along ±axes of the disc that a sphere cuts from a face's plane; NaN off the face."""
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


def clip(surface: Surface, parts: Sequence[RegionPart]) -> Surface:
    """Return a surface clipped to a region: whole faces, and what boxes leave of others.

    Raises:
        SampleError: If the region holds nothing of the surface, or is a sphere: a box has straight edges to cut along.
    """
    region = Region.of(surface, parts)
    if region.spheres:
        raise SampleError("a sphere does not cut faces straight", "use facing, box or geoms")
    faces = np.flatnonzero(region.has_faces(surface.face_normals, surface.face_geom))
    polygons, owner = region.clipped(surface.corners[faces])
    fans = [np.stack([polygons[:, 0], polygons[:, k], polygons[:, k + 1]], axis=1) for k in range(1, polygons.shape[1] - 1)]
    corners = np.concatenate(fans)
    geom = np.tile(surface.face_geom[faces][owner], len(fans))
    size = face_areas(corners)
    corners, geom = corners[size > 0], geom[size > 0]
    if not len(corners):
        raise SampleError("the region holds nothing of the link's surface", "widen it")
    return Surface(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), geom, surface.geoms)


def _geom_mask(surface: Surface, selection: Selection) -> Bool[np.ndarray, " geom"]:
    """Return the mask of a selection's geoms, by any of their names."""

    def matching(patterns: tuple[str, ...]) -> Bool[np.ndarray, " geom"]:
        return np.array(
            [any(fnmatchcase(name, pattern) for name in names for pattern in patterns) for names in surface.geoms],
            dtype=bool,
        )

    included = matching(selection.include)
    if not included.any():
        patterns_text = ", ".join(f'"{pattern}"' for pattern in selection.include)
        names = [name for names in surface.geoms for name in names]
        hint = did_you_mean(selection.include[0], names, "named geoms on this link")
        raise SampleError(f"no geom or mesh of this link matches {patterns_text}", hint)
    mask = included & ~matching(selection.exclude)
    if not mask.any():
        raise SampleError("`exclude` leaves none of the geoms that `include` takes", "exclude less")
    return mask


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return vectors over their lengths."""
    # The largest component first: the square of a tiny or huge one is not representable.
    scaled = vectors / np.abs(vectors).max(axis=-1, keepdims=True)
    return scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
