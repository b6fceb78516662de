"""Orthographic ray casting: first hits of parallel rays on a surface, and the rectangle in which they can hit a region.

Rays travel along one direction and start outside, so the first hit is on the outer surface by construction: inner
shells and overlapping geoms need no cleaning. All rays being parallel, casting is drawing triangles: everything is
expressed as (u, v, t) with u along the columns, v along the rows and t along the rays, a right-handed frame, and a ray
is a point in the (u, v) plane.

Not libigl's or trimesh's: of 2,015,232 rays along the axes onto the links of two hands `igl.AABB.intersect_ray_first` misses
124,159 and goes through the nearest face of others, Embree is float32 and asked ray by ray, and trimesh needs rtree.

Shapes: `f` faces that are not seen edge-on, `ray` rays, `pair` (face, ray) pairs whose bounding boxes meet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.surfaces.region import LENGTH_TOLERANCE, Region
from tgdsl.surfaces.surface import Surface

NEAR_PARALLEL = 0.7
"""An axis with a larger |cosine| to a direction is not used to orient vectors perpendicular to that direction."""
EDGE_ON = 1e-6  # faces with a smaller |cosine| between normal and rays are left out: their neighbours cover the same rays
ROUNDING = 1e-9
"""Widening of faces, relative to the largest coordinate, so that no ray slips between two faces that share an edge."""
RASTER = 256  # rays along the longer side of the raster that looks for the visible part of a region
_PAIRS = 1_000_000  # (face, ray) pairs tested at a time, to bound memory


@dataclass(frozen=True, eq=False)
class OrthographicView:
    """A surface in orthographic projection along a direction."""

    # rows are the unit vectors of u, v and t in the body frame, right-handed; rays travel along +t
    axes: Float[np.ndarray, "3 3"]
    face_id: Int[np.ndarray, " f"]  # index of each face into the surface's faces
    corners: Float[np.ndarray, "f 3 3"]  # (u, v, t) of each face's corners, counter-clockwise in (u, v) [m]
    # unit face normals against the rays, body frame: the side that a ray comes from is outside
    normals: Float[np.ndarray, "f 3"]
    geom: Int[np.ndarray, " f"]  # index of each face's geom
    rounding: float  # lengths below this are rounding noise [m]

    @staticmethod
    def of(
        surface: Surface, axes: Float[np.ndarray, "3 3"], is_one_sided: Bool[np.ndarray, " face"] | bool = False
    ) -> OrthographicView:
        """Return the view of a surface along `axes[2]`, without faces that are edge-on or have no area.

        One-sided faces that look along the rays are left out: on solids they are hidden.
        """
        cosine = surface.face_normals @ axes[2]
        face_id = np.flatnonzero((np.abs(cosine) > EDGE_ON) & ((cosine < 0) | np.logical_not(is_one_sided)))
        corners = surface.corners[face_id] @ axes.T
        is_front = cosine[face_id] < 0
        # A face that looks against the rays turns clockwise in (u, v), because t points away from its viewer.
        corners = np.where(is_front[:, None, None], corners[:, ::-1], corners)
        normals = np.where(is_front[:, None], 1.0, -1.0) * surface.face_normals[face_id] + 0.0  # no −0
        extent = float(np.abs(corners).max(initial=0.0))
        return OrthographicView(axes, face_id, corners, normals, surface.face_geom[face_id], ROUNDING * extent)


def sphere_directions(count: int) -> Float[np.ndarray, "direction 3"]:
    """Return a Fibonacci lattice of unit vectors, ordered so that every side is visited early."""
    place = 37 * np.arange(count) % count
    height = 1.0 - (2.0 * place + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * place
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=-1)


def reference_axes(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the first of the z, y and x axes that is not near parallel to each unit vector."""
    is_across = np.abs(directions[:, ::-1]) < NEAR_PARALLEL
    return np.eye(3)[2 - np.argmax(is_across, axis=1)]


def frame(direction: Float[np.ndarray, " 3"], columns: Float[np.ndarray, " 3"] | None = None) -> Float[np.ndarray, "3 3"]:
    """Return unit vectors along columns, rows and rays, right-handed; rows run along direction × columns.

    `columns` is a vector that is not parallel to the rays' direction; default: its reference axis.
    """
    along = reference_axes(direction[None])[0] if columns is None else columns
    across = np.cross(direction, along)
    across /= np.linalg.norm(across)
    return np.stack([np.cross(across, direction), across, direction]) + 0.0  # no −0


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of some rays."""

    face: Int[np.ndarray, " ray"]  # index into the view's faces; −1 where a ray misses
    depth: Float[np.ndarray, " ray"]  # t of the hit [m]; infinite where a ray misses


def first_hits(view: OrthographicView, uv: Float[np.ndarray, "ray 2"]) -> Hits:
    """Return what each ray hits first.

    Where several faces are hit at the same depth (a shared edge), the one that faces the ray most squarely counts, then
    the first in the surface's order. `uv` is where the rays pass through the (u, v) plane [m].
    """
    hits = [_hits(view, uv, face, ray) for face, ray in _pairs(view, uv)]
    face, ray, t = (np.concatenate([part[i] for part in hits]) for i in range(3)) if hits else (np.zeros(0, int),) * 3
    nearest = np.full(len(uv), np.inf)
    np.minimum.at(nearest, ray, t)
    is_first = t <= nearest[ray] + view.rounding
    face, ray, t = face[is_first], ray[is_first], t[is_first]
    squarely = view.normals[face] @ view.axes[2]
    order = np.lexsort((face, squarely, ray))
    ray, first = np.unique(ray[order], return_index=True)
    hit_face = np.full(len(uv), -1, dtype=np.int64)
    hit_face[ray] = face[order][first]
    nearest[ray] = t[order][first]
    return Hits(hit_face, nearest)


def is_clear(view: OrthographicView, uvt: Float[np.ndarray, "ray 3"]) -> Bool[np.ndarray, " ray"]:
    """Return which rays hit nothing before the depth `uvt[:, 2]` [m]."""
    result, (a, b, c) = np.ones(len(uvt), dtype=bool), view.corners[:, :, 2].T
    nearest = np.minimum(np.minimum(a, b), c)
    for face, ray in _pairs(view, uvt[:, :2]):
        is_before = result[ray] & (nearest[face] < uvt[ray, 2])
        _, ray, t = _hits(view, uvt[:, :2], face[is_before], ray[is_before])
        result[ray[t < uvt[ray, 2]]] = False
    return result


def _hits(
    view: OrthographicView, uv: Float[np.ndarray, "ray 2"], face: Int[np.ndarray, " pair"], ray: Int[np.ndarray, " pair"]
) -> tuple[Int[np.ndarray, " hit"], Int[np.ndarray, " hit"], Float[np.ndarray, " hit"]]:
    """Return face, ray and depth of the pairs that meet."""
    is_sparse = len(face) < len(view.corners)  # edges are computed for each pair then, for each face otherwise
    for i in range(3):
        corners, row = (view.corners[face], np.arange(len(face))) if is_sparse else (view.corners, face)
        start = corners[:, i, :2]
        along = corners[:, (i + 1) % 3, :2] - start
        inward = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
        offset = uv[ray] - start[row]
        is_inside = inward[row, 0] * offset[:, 0] + inward[row, 1] * offset[:, 1] >= -view.rounding
        face, ray = face[is_inside], ray[is_inside]
    corners = view.corners[face]
    slope = view.normals[face] @ view.axes.T
    offset = uv[ray] - corners[:, 0, :2]
    t = corners[:, 0, 2] - (slope[:, 0] * offset[:, 0] + slope[:, 1] * offset[:, 1]) / slope[:, 2]
    # Steep faces extrapolate badly across the rounding margin.
    return face, ray, np.clip(t, corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1))


def _pairs(
    view: OrthographicView, uv: Float[np.ndarray, "ray 2"]
) -> Iterator[tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]]:
    """Yield (face, ray) pairs whose bounding boxes meet, in chunks; rays are sorted into coarse squares."""
    if not len(uv):
        return
    low, high = uv.min(axis=0), uv.max(axis=0)
    side = min(RASTER, int(np.ceil(np.sqrt(len(uv)))))
    scale = side / np.maximum(high - low, max(view.rounding, np.finfo(float).tiny))

    def squares(points: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
        return np.clip(np.floor((points - low) * scale), 0, side - 1).astype(np.int64)

    of_ray = squares(uv) @ [side, 1]
    order = np.argsort(of_ray, kind="stable")
    starts = np.searchsorted(of_ray[order], np.arange(side * side + 1))
    a, b, c = view.corners[:, 0, :2], view.corners[:, 1, :2], view.corners[:, 2, :2]
    # Three times as fast as a reduction over so short an axis.
    face_low = np.minimum(np.minimum(a, b), c) - view.rounding
    face_high = np.maximum(np.maximum(a, b), c) + view.rounding
    near = np.flatnonzero(((face_low <= high) & (face_high >= low)).all(axis=1))
    first, last = squares(face_low[near]), squares(face_high[near])
    # Squares of one u are contiguous, so that each (face, u) pair is one slice of the sorted rays.
    which, u = expanded(last[:, 0] - first[:, 0] + 1)
    row = (first[which, 0] + u) * side
    begin, end = starts[row + first[which, 1]], starts[row + last[which, 1] + 1]
    chunk = np.cumsum(end - begin) // _PAIRS
    for start, stop in zip(*_runs(chunk), strict=True):
        part, step = expanded((end - begin)[start:stop])
        yield near[which[start:stop][part]], order[begin[start:stop][part] + step]


def expanded(counts: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Return each index i `counts[i]` times, and the running number within it."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)


def _runs(sorted_ids: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " run"], Int[np.ndarray, " run"]]:
    """Return start and stop of each run of equal values."""
    if not len(sorted_ids):
        return np.zeros(0, int), np.zeros(0, int)
    cuts = np.flatnonzero(np.diff(sorted_ids)) + 1
    return np.concatenate([[0], cuts]), np.concatenate([cuts, [len(sorted_ids)]])


def visible_rectangle(view: OrthographicView, region: Region) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]] | None:
    """Return the bounding rectangle, in (u, v), of all first hits in the region; None if there is no such hit.

    Without a region it is the rectangle of the projected corners. With a region it is exact if an extreme point of the region
    on some face is visible (a box's side, a sphere's rim, a corner of the mesh); where another surface hides or covers part of
    the region, it is accurate to one raster cell, 1/256 of the region's longer side.
    """
    if region.is_everything:
        corners = view.corners[:, :, :2].reshape(-1, 2)
        return (corners.min(axis=0), corners.max(axis=0)) if len(corners) else None
    faces = np.flatnonzero(region.has_faces(view.normals, view.geom))
    extremes, inner = region.extremes(view.corners[faces] @ view.axes, view.normals[faces], view.axes[:2])
    if not len(extremes):
        return None
    uv = extremes @ view.axes[:2].T
    low, high = _raster_bounds(view, region, uv.min(axis=0), uv.max(axis=0))
    is_outside = ((uv < low) | (uv > high)).any(axis=1) & region.has_points(extremes)
    # A corner can be visible although its face is hidden: test a point slightly inside the face.
    tested = extremes[is_outside] + 1e-3 * (inner[is_outside] - extremes[is_outside])
    is_seen = is_clear(view, tested @ view.axes.T - [0.0, 0.0, view.rounding + 3 * LENGTH_TOLERANCE])
    seen = uv[is_outside][is_seen]
    low, high = np.minimum(low, seen.min(axis=0, initial=np.inf)), np.maximum(high, seen.max(axis=0, initial=-np.inf))
    return (low, high) if (low <= high).all() else None


def _raster_bounds(
    view: OrthographicView, region: Region, low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"]
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Return the bounds of the rays of a fine raster whose first hit is in the region; (inf, −inf) if there is none.

    Lines of the raster are followed from each side until one has such a hit.
    """
    size = np.maximum(high - low, view.rounding)
    num = np.clip(np.ceil(RASTER * size / size.max()), 16, RASTER).astype(int)
    lines = [low[i] + (np.arange(num[i]) + 0.5) / num[i] * size[i] for i in range(2)]
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for axis, bound, outermost in ((0, low, np.min), (0, high, np.max), (1, low, np.min), (1, high, np.max)):
        across = lines[1 - axis]
        inwards = lines[axis] if bound is low else lines[axis][::-1]
        for some in np.split(inwards, [4, 16, 64]):
            uv = np.stack(np.meshgrid(some, across, indexing="ij"), axis=-1).reshape(-1, 2)[:, :: 1 - 2 * axis]
            hits = _in_region(view, region, uv)
            if len(hits):
                bound[axis] = outermost(hits[:, axis])
                break
        else:
            break
    return low, high


def _in_region(view: OrthographicView, region: Region, uv: Float[np.ndarray, "ray 2"]) -> Float[np.ndarray, "hit 2"]:
    """Return the rays whose first hit is in the region."""
    hits = first_hits(view, uv)
    uv, face, depth = (array[hits.face >= 0] for array in (uv, hits.face, hits.depth))
    pos = np.column_stack([uv, depth]) @ view.axes
    return uv[region.has_faces(view.normals[face], view.geom[face]) & region.has_points(pos)]
