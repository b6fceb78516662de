"""Poisson-disk samples of a link's outer surface, chosen from a dense pool of candidates, each with its Voronoi cell's area.

A point is on the outer surface if it is in no solid component (by winding numbers) and is visible from far away: pockets
may be joined to the outside by a pinhole.

Poisson-disk samplers of pymeshlab, libigl and trimesh have no exact count and no region, and follow the mesh's order of faces.
So the pool is drawn on lines that are fixed in space (`lattice`), or on request by pymeshlab's stratified sampling of
triangles, which draws no random numbers. Dart throwing selects points in the order of their priorities: at one spacing, or, for
an exact count, at a fixed decreasing series of spacings until there are enough. Hence a mesh whose vertices are off by rounding
gives the same samples: a decision changes only where a distance equals a spacing to within the rounding, and then one or two
neighbours change with it. Sample elimination (Yuksel 2015) compares sums of eighth powers of distances: thirty times as many
of its choices change. Distances are straight lines, not paths along the surface.

Shapes: `piece` triangles cut from faces, `hit` points drawn, `pool` points of the pool, `n` some points, `taxel` the points
chosen. Everything is in the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from tgdsl.placement.sample import lattice
from tgdsl.surfaces.meshlab import Shell, stratified_points
from tgdsl.surfaces.rays import OrthographicView, frame, is_clear, sphere_directions
from tgdsl.surfaces.region import Region
from tgdsl.surfaces.surface import Surface

CANDIDATES = 20  # least number of points per sample from which an exact count is chosen
DIRECTIONS, FIRST_DIRECTIONS = 100, 10
"""View directions: a point that none of them sees is in a pocket that nothing outside can touch. Each point is first viewed
from one of the first ones. If it is hidden there, it is tested for being inside of solids, then viewed from all directions."""
PER_SAMPLE = 50  # points per sample by which the area of each sample is measured; also the density of the pool for a spacing
MIN_POOL, MAX_POOL = 10_000, 400_000  # points in a pool; more are drawn only where an exact count needs them
MANY = 30  # points from which on a piece's area is corrected for this piece alone
FIRST_SPACING, SPACING_RATIO = 0.81, 0.99
"""Of an exact count: the largest first spacing, relative to the hexagonal packing's, at which nearly all samples fit; and each
next one relative to the one before."""
ORDER = np.sqrt([0.2, 0.3, 0.5])
"""Samples are numbered along this direction, in the body frame: two change places only if they are equally far along it."""


@dataclass(frozen=True, eq=False)
class Pool:
    """Dense points on the outer surface in a region, in the order of their priorities."""

    pos: Float[np.ndarray, "pool 3"]  # position in the body frame [m]
    normal: Float[np.ndarray, "pool 3"]  # outward unit normal of the point's face, body frame
    point_area: Float[np.ndarray, " pool"]  # surface that each point stands for [m²]

    @property
    def area(self) -> float:
        """Area of the surface that the pool covers [m²]."""
        return float(self.point_area.sum())


def pool(
    shell: Shell, region: Region, seed: int, count: int | None, spacing: float | None, sampler: str = "lattice"
) -> Pool | None:
    """Return a pool dense enough for a count or a spacing; None if the region holds nothing of the outer surface."""
    face, corners = _pieces(shell.surface, region)
    area = float(_areas(corners).sum())
    limit = MAX_POOL * 4 if count is None else size(count)[1]
    point_area, drawn = area / _pool_size(0.0, count, spacing), None
    while len(face):
        num = area / point_area
        drawn = _drawn(shell, region, face, corners, point_area, seed, sampler)
        num_drawn, num_wanted = len(drawn.pos), _pool_size(drawn.area, count, spacing)
        is_hopeless = num >= limit or (count is None and num_wanted > MAX_POOL) or (not num_drawn and num >= 10 * MIN_POOL)
        if num_drawn > 0.7 * num_wanted or is_hopeless:
            break
        point_area = max(point_area * (num_drawn / num_wanted if num_drawn > 100 else 0.1), area / limit)
    return drawn if drawn is not None and len(drawn.pos) else None


def size(count: int) -> tuple[int, int]:
    return max(min(PER_SAMPLE * count, MAX_POOL), 2 * CANDIDATES * count, MIN_POOL), 4 * max(MAX_POOL, CANDIDATES * count)


def _pool_size(area: float, count: int | None, spacing: float | None) -> float:
    """Return the number of points for the pool of a region of some area [m²]."""
    if count is None:
        assert spacing is not None
        return max(PER_SAMPLE * area / spacing**2, float(MIN_POOL))
    return float(size(count)[0])


def _pieces(surface: Surface, region: Region) -> tuple[Int[np.ndarray, " piece"], Float[np.ndarray, "piece 3 3"]]:
    """Return triangles that cover what a region can hold of the faces, and the face of each."""
    face = np.flatnonzero(region.has_faces(surface.face_normals, surface.face_geom))
    polygons, owner = region.clipped(surface.corners[face])
    first = np.broadcast_to(polygons[:, :1], polygons[:, 2:].shape)
    fans = np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=2)
    face, corners = np.repeat(face[owner], fans.shape[1]), fans.reshape(-1, 3, 3)
    is_piece = _areas(corners) > 0
    return face[is_piece], corners[is_piece]


def _areas(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def _drawn(
    shell: Shell,
    region: Region,
    face: Int[np.ndarray, " piece"],
    corners: Float[np.ndarray, "piece 3 3"],
    point_area: float,
    seed: int,
    sampler: str,
) -> Pool:
    """Draw points of pieces of faces, one for at most each area [m²]; keep those in the region and on the outer surface."""
    if sampler == "pymeshlab":
        drawn = _stratified(corners, point_area, seed)
    else:
        drawn = lattice.hits(corners, lattice.pitch_below(np.sqrt(point_area)), seed)
    pos, face = drawn.pos, face[drawn.piece]
    areas = _exact(drawn, _areas(corners))
    is_kept = region.has_points(pos)
    is_kept[is_kept] = _on_outer_surface(shell, region, pos[is_kept], face[is_kept])
    return Pool(pos[is_kept], shell.surface.face_normals[face[is_kept]], areas[is_kept])


def _stratified(corners: Float[np.ndarray, "piece 3 3"], point_area: float, seed: int) -> lattice.Hits:
    """Return pymeshlab's points in random order: pymeshlab returns them in the order of the faces."""
    area = float(_areas(corners).sum())
    pos, piece = stratified_points(corners, int(np.ceil(area / point_area)))
    order = np.random.default_rng(seed).permutation(len(pos))
    return lattice.Hits(pos[order], piece[order], np.full(len(pos), area / max(len(pos), 1)))


def _exact(drawn: lattice.Hits, area: Float[np.ndarray, " piece"]) -> Float[np.ndarray, " hit"]:
    """Return areas of points that add up to their pieces' areas [m²]; a lattice's areas are off by some percent."""
    num = np.bincount(drawn.piece, minlength=len(area))
    owner = np.where(num >= MANY, np.arange(len(area)), len(area))
    drawn_area = np.bincount(owner[drawn.piece], drawn.area, minlength=len(area) + 1)
    exact_area = np.bincount(owner, area, minlength=len(area) + 1)
    exact = drawn.area * (exact_area / np.where(drawn_area > 0, drawn_area, 1.0))[owner[drawn.piece]]
    return exact * (area.sum() / exact.sum()) if len(exact) else exact


def _on_outer_surface(
    shell: Shell, region: Region, pos: Float[np.ndarray, "n 3"], face: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which points of faces are on the outside of the union of all solid components."""
    normal = shell.surface.face_normals[face]
    above, below = pos + shell.offset * normal, pos - shell.offset * normal
    component = shell.component[face]
    is_geom = np.ones(len(shell.surface.geoms), bool) if region.is_geom is None else region.is_geom
    is_out = np.ones(len(pos), dtype=bool)
    directions = sphere_directions(DIRECTIONS)
    is_seen = _visible(shell, above, normal, directions[:FIRST_DIRECTIONS], (True,))
    for solid in np.flatnonzero(shell.is_solid).tolist():
        doubtful = np.flatnonzero(is_out & ~(is_seen & shell.is_closed[solid]))  # nothing seen is inside a closed surface
        is_out[doubtful] = shell.winding(solid, above[doubtful]) < 0.5
        if is_geom[shell.surface.face_geom[shell.component == solid]].any():
            later = np.flatnonzero(is_out & (component > solid))
            is_out[later] = shell.winding(solid, below[later]) < 0.5
    left = np.flatnonzero(is_out & ~is_seen)
    is_out[left] = _visible(shell, above[left], normal[left], directions)
    return is_out


def _visible(
    shell: Shell,
    above: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "direction 3"],
    passes: tuple[bool, ...] = (True, False),
) -> Bool[np.ndarray, " n"]:
    """Return which points just above faces are visible from far away along some direction.

    The first pass views each point along the direction that is most opposed to its normal, the second along all others.
    """
    cosine = normal @ directions.T
    opposed, is_visible = cosine.argmin(axis=1), np.zeros(len(above), dtype=bool)
    for is_first in passes:
        for i, direction in enumerate(directions):
            left = np.flatnonzero(~is_visible & (cosine[:, i] < -0.05) & ((opposed == i) == is_first))
            if len(left):
                view = OrthographicView.of(shell.surface, frame(direction), shell.is_closed[shell.component])
                is_visible[left] = is_clear(view, above[left] @ view.axes.T)
    return is_visible


def choose(pool: Pool, count: int | None, spacing: float | None) -> Int[np.ndarray, " taxel"]:
    """Return the chosen points of a pool along `ORDER`: exactly `count`, or as many as fit at `spacing` [m]."""
    if count is None:
        assert spacing is not None
        taken = _dart_throwing(pool.pos, (spacing,), len(pool.pos))
    else:
        hexagonal = np.sqrt(2.0 * pool.area / (np.sqrt(3.0) * count))
        # The first is one of a fixed series too, 4 % apart: it must not follow the last bits of an area.
        first = 4.0 * np.ceil(np.log(FIRST_SPACING * hexagonal) / np.log(SPACING_RATIO) / 4.0)
        least = np.log(1e-3) / np.log(SPACING_RATIO)
        taken = _dart_throwing(pool.pos, tuple(SPACING_RATIO ** np.arange(first, first + least)), count)
    return taken[np.argsort(pool.pos[taken] @ ORDER, kind="stable")]


def _dart_throwing(pos: Float[np.ndarray, "pool 3"], spacings: tuple[float, ...], count: int) -> Int[np.ndarray, " taxel"]:
    """Select points in order that are at least a spacing [m] from all selected points; then with the next smaller spacing."""
    tree = KDTree(pos)
    gap = np.full(len(pos), np.inf)  # to the nearest point taken, if that is within the first spacing
    taken: list[int] = []
    for spacing in spacings:
        for point in np.flatnonzero(gap >= spacing).tolist():
            if gap[point] >= spacing and len(taken) < count:
                taken.append(point)
                near = np.array(tree.query_ball_point(pos[point], spacings[0]), dtype=np.int64)
                gap[near] = np.minimum(gap[near], np.linalg.norm(pos[near] - pos[point], axis=1))
        if len(taken) == count:
            break
    if len(spacings) > 1:
        taken += np.setdiff1d(np.arange(len(pos)), taken)[: count - len(taken)].tolist()
    return np.array(taken, dtype=np.int64)


def voronoi_areas(pool: Pool, chosen: Int[np.ndarray, " taxel"]) -> Float[np.ndarray, " taxel"]:
    """Return the area of each chosen point's Voronoi cell on the surface, by adding up the pool's points in it [m²]."""
    _, nearest = KDTree(pool.pos[chosen]).query(pool.pos)
    return np.bincount(nearest, pool.point_area, minlength=len(chosen))
