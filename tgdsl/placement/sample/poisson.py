"""Poisson-disk samples of a link's outer surface, chosen from a dense pool of candidates, each with its Voronoi cell's area.

A point is on the outer surface if it is in no solid component (by winding numbers) and is visible from far away: pockets
may be joined to the outside by a pinhole.

Samplers of pymeshlab and libigl are unseeded and have no exact count (libigl's blue noise of one radius on one sphere: 84 to
92 points), trimesh's rejects points within a radius; none knows a region. So the pool is drawn by NumPy: seeded, area-weighted
and stratified over the faces. An exact count is chosen from the pool by weighted sample elimination (Yuksel, "Sample
Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 34(2), 2015), a spacing by dart throwing.
Distances are straight lines, not paths along the surface.

Shapes: `piece` triangles cut from faces, `pool` points of the pool, `n` points of it, `taxel` the points chosen.
Everything is in the body frame.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from tgdsl.surfaces.meshlab import Shell
from tgdsl.surfaces.rays import OrthographicView, first_hits, frame
from tgdsl.surfaces.region import Region
from tgdsl.surfaces.surface import Surface

CANDIDATES = 10
"""Points per sample from which an exact count is chosen."""
DIRECTIONS = 100
"""Directions from which points are looked at: what none of them sees is a pocket that nothing outside can touch."""
PER_SAMPLE = 50
"""Points per sample by which the area of each sample is measured; also the density of the pool for a spacing."""
MIN_POOL, MAX_POOL = 10_000, 400_000
"""Bounds of the number of points in a pool; more are drawn only where an exact count needs them."""


@dataclass(frozen=True, eq=False)
class Pool:
    """Dense points on the outer surface in a region, each standing for the same area.

    Attributes:
        pos: Position in the body frame [m].
        normal: Outward unit normal of the point's face, body frame.
        point_area: Surface that each point stands for [m²].
    """

    pos: Float[np.ndarray, "pool 3"]
    normal: Float[np.ndarray, "pool 3"]
    point_area: float

    @property
    def area(self) -> float:
        """Area of the surface that the pool covers [m²]."""
        return self.point_area * len(self.pos)


def pool(shell: Shell, region: Region, seed: int, count: int | None, spacing: float | None) -> Pool | None:
    """Return a pool dense enough for a count or a spacing; None if the region holds nothing of the outer surface.

    It stays sparse where that would take more than `MAX_POOL` points, or where nearly all of the region lies inside.

    Args:
        shell: The clean surface.
        region: The part of it to sample.
        seed: Seed of the points.
        count: Number of samples wanted.
        spacing: Least distance of samples [m], if there is no count.
    """
    face, corners = _pieces(shell.surface, region)
    limit = 4 * max(MAX_POOL, CANDIDATES * (count or 0))
    num, drawn = int(_wanted(0.0, count, spacing)), None
    while len(face):
        drawn = _drawn(shell, region, face, corners, num, seed)
        found, wanted = len(drawn.pos), _wanted(drawn.area, count, spacing)
        is_hopeless = num == limit or (count is None and wanted > MAX_POOL) or (not found and num >= 10 * MIN_POOL)
        if found > 0.7 * wanted or is_hopeless:
            break
        num = min(int(wanted * num / found) + 1 if found > 100 else 10 * num, limit)
    return drawn if drawn is not None and len(drawn.pos) else None


def _wanted(area: float, count: int | None, spacing: float | None) -> float:
    """Return how many points the pool of a region of some area [m²] should have."""
    if count is None:
        assert spacing is not None
        return max(PER_SAMPLE * area / spacing**2, float(MIN_POOL))
    return float(max(min(PER_SAMPLE * count, MAX_POOL), 2 * CANDIDATES * count, MIN_POOL))


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
    num: int,
    seed: int,
) -> Pool:
    """Draw stratified points over pieces of faces; keep those in the region and on the outer surface."""
    rng = np.random.default_rng(seed)
    area = np.cumsum(_areas(corners))
    # One point in each of equal stretches of the cumulated area: never a bare patch, never a heap.
    drawn = np.searchsorted(area, (np.arange(num) + rng.random(num)) / num * area[-1])
    piece = np.minimum(drawn, len(face) - 1)
    root, share = np.sqrt(rng.random(num)), rng.random(num)
    weight = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=-1)
    pos, face = np.einsum("nk,nkx->nx", weight, corners[piece]), face[piece]
    is_kept = region.has_points(pos)
    pos, face = pos[is_kept], face[is_kept]
    is_kept = _on_outer_surface(shell, region, pos, face)
    return Pool(pos[is_kept], shell.surface.face_normals[face[is_kept]], float(area[-1]) / num)


def _on_outer_surface(
    shell: Shell, region: Region, pos: Float[np.ndarray, "n 3"], face: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which points of faces are on the outside of the union of all solid components.

    Where solids touch back to back neither is outside; where their faces coincide and look the same way, only the first
    component that belongs to the region keeps its points, lest the place count twice.
    """
    normal = shell.surface.face_normals[face]
    above, below = pos + shell.offset * normal, pos - shell.offset * normal
    component = shell.component[face]
    is_geom = np.ones(len(shell.surface.geoms), bool) if region.is_geom is None else region.is_geom
    is_out = np.ones(len(pos), dtype=bool)
    for solid in np.flatnonzero(shell.is_solid).tolist():
        is_out &= shell.winding(solid, above) < 0.5
        if is_geom[shell.surface.face_geom[shell.component == solid]].any():
            later = np.flatnonzero(is_out & (component > solid))
            is_out[later] = shell.winding(solid, below[later]) < 0.5
    is_out[is_out] = _visible(shell, above[is_out], normal[is_out])
    return is_out


def _visible(shell: Shell, above: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which points just above faces are visible from far away in some direction."""
    is_visible = np.zeros(len(above), dtype=bool)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(DIRECTIONS)
    # A Fibonacci lattice covers the sphere evenly; walking it in steps of 37 meets every side early.
    height = 1.0 - (2.0 * np.arange(DIRECTIONS) + 1.0) / DIRECTIONS
    ring = np.sqrt(1.0 - height**2)
    lattice = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=-1)
    for direction in lattice[37 * np.arange(DIRECTIONS) % DIRECTIONS]:
        left = np.flatnonzero(~is_visible)
        left = left[normal[left] @ direction < -0.05]
        if not len(left):
            continue
        view = OrthographicView.of(shell.surface, frame(direction))
        uvt = above[left] @ view.axes.T
        is_visible[left] = first_hits(view, uvt[:, :2]).depth >= uvt[:, 2]
    return is_visible


def choose(pool: Pool, count: int | None, spacing: float | None, seed: int) -> Int[np.ndarray, " taxel"]:
    """Return the chosen points of a pool, ascending: exactly `count`, or as many as fit at `spacing` [m]."""
    order = np.random.default_rng([seed, 1]).permutation(len(pool.pos))
    if count is None:
        assert spacing is not None
        return _dart_throwing(pool.pos, order, spacing)
    candidates = np.sort(order[: CANDIDATES * count])
    return candidates[_sample_elimination(pool.pos[candidates], count, pool.area)]


def _dart_throwing(pos: Float[np.ndarray, "pool 3"], order: Int[np.ndarray, " pool"], spacing: float) -> Int[np.ndarray, " n"]:
    """Take points in some order; reject those within `spacing` of one taken before."""
    tree = KDTree(pos)
    is_free = np.ones(len(pos), dtype=bool)
    taken = []
    for point in order:
        if is_free[point]:
            taken.append(point)
            is_free[tree.query_ball_point(pos[point], spacing)] = False
    return np.sort(np.array(taken, dtype=np.int64))


def _sample_elimination(pos: Float[np.ndarray, "n 3"], count: int, area: float) -> Int[np.ndarray, " count"]:
    """Remove the most crowded point until `count` are left (Yuksel 2015, with its α = 8, β = 0.65, γ = 1.5)."""
    reach = 2.0 * np.sqrt(area / (2.0 * np.sqrt(3.0) * count))
    floor = reach * (1.0 - (count / len(pos)) ** 1.5) * 0.65
    pairs = KDTree(pos).query_pairs(reach, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    distance = np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1)
    weight = (1.0 - np.minimum(np.maximum(distance, floor), reach) / reach) ** 8
    crowding = np.bincount(pairs[:, 0], weight, minlength=len(pos))
    starts = np.searchsorted(pairs[:, 0], np.arange(len(pos) + 1))
    heap = [(-crowding[point], point) for point in range(len(pos))]
    heapq.heapify(heap)
    is_left = np.ones(len(pos), dtype=bool)
    for _ in range(len(pos) - count):
        # Crowding only falls, so an outdated entry is too early in the queue: put it back where it belongs.
        while -heap[0][0] != crowding[heap[0][1]]:
            heapq.heapreplace(heap, (-crowding[heap[0][1]], heap[0][1]))
        _, point = heapq.heappop(heap)
        is_left[point] = False
        around = slice(starts[point], starts[point + 1])
        crowding[pairs[around, 1]] -= weight[around]
    return np.flatnonzero(is_left)


def voronoi_areas(pool: Pool, chosen: Int[np.ndarray, " taxel"]) -> Float[np.ndarray, " taxel"]:
    """Return the area of each chosen point's Voronoi cell on the surface, by counting the pool's points in it [m²]."""
    _, nearest = KDTree(pool.pos[chosen]).query(pool.pos)
    return pool.point_area * np.bincount(nearest, minlength=len(chosen))
