"""Even samples of a link's outer surface: clean its meshes, drop what lies inside, draw a dense pool, choose from it.

A point is on the outer surface if it is in no solid part (by winding numbers) and can be seen from far away: real
meshes hold screws and magnets as parts of their own, and pockets that are joined to the outside by a pinhole.

The only file that imports pymeshlab (GPL-3), and only when a surface is cleaned: compiled modules run without it. Its
own samplers are unseeded and miss the asked count, so the pool is drawn by NumPy: seeded, area-weighted and
stratified over the faces. An exact count is chosen from the pool by weighted sample elimination (Yuksel, "Sample
Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 34(2), 2015), a spacing by dart throwing.
Distances are straight lines, not paths along the surface.

Shapes: `f` faces, `edge` three per face, `part` connected parts of the mesh, `piece` triangles cut from faces, `pool`
points of the pool. Everything is in the body frame.
"""

from __future__ import annotations

import heapq
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tgdsl.compiler.rays import LENGTH_TOLERANCE, Region, View, first_hits, frame
from tgdsl.geometry.surface import Surface

MAX_HOLE = 0.05
"""A part is solid, so that points can be inside it, if the squared length of its border is at most this share of its
area: a sphere with a hole of an eighth of its radius is, a bowl is not."""
CANDIDATES = 10
"""Points per sample from which an exact count is chosen."""
DIRECTIONS = 100
"""Directions from which points are looked at: what none of them sees is a pocket that nothing outside can touch."""
PER_SAMPLE = 50
"""Points per sample by which the area of each sample is measured; also the density of the pool for a spacing."""
MIN_POOL, MAX_POOL = 10_000, 400_000
"""Bounds of the number of points in a pool; more are drawn only where an exact count needs them."""


@dataclass(frozen=True, eq=False)
class Shell:
    """A clean surface whose enclosed parts are gone.

    Attributes:
        surface: Its triangles; solid parts are counter-clockwise seen from outside.
        part: Connected part of each face.
        is_solid: Which parts enclose a volume.
    """

    surface: Surface
    part: Int[np.ndarray, " f"]
    is_solid: Bool[np.ndarray, " part"]

    @cached_property
    def offset(self) -> float:
        """Distance to either side of a face at which points are tested for being inside [m]."""
        return max(1e-6 * float(np.ptp(self.surface.corners.reshape(-1, 3), axis=0).max()), LENGTH_TOLERANCE)

    def solid(self, part: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Return vertices and faces of one part."""
        used, faces = np.unique(self.surface.faces[self.part == part], return_inverse=True)
        return self.surface.vertices[used], faces.reshape(-1, 3).astype(np.int64)


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


def outer_shell(surface: Surface) -> Shell:
    """Return the cleaned surface without the parts that lie wholly inside another.

    Closed parts that are inside out are turned, so that all face outward.

    Args:
        surface: The link's triangles, in the body frame.

    Raises:
        ImportError: If pymeshlab is not installed.
    """
    clean = _clean(surface)
    part = _parts(clean)
    is_solid = _solid(clean, part)
    volume = np.bincount(part, _signed_volumes(clean, part), minlength=len(is_solid))
    is_turned = (is_solid & (volume < 0))[part]
    faces = np.where(is_turned[:, None], clean.faces[:, ::-1], clean.faces)
    shell = Shell(Surface(clean.vertices, faces, clean.face_geom, clean.geoms), part, is_solid)
    is_kept = ~_enclosed(shell)[part]
    kept, part = np.unique(part[is_kept], return_inverse=True)
    return Shell(shell.surface.keep(is_kept), part, is_solid[kept])


def _clean(surface: Surface) -> Surface:
    """Weld vertices, drop faces without area or that repeat another, make windings agree; each geom by itself."""
    import pymeshlab as untyped

    pymeshlab: Any = untyped
    parts = []
    for geom in range(len(surface.geoms)):
        faces = surface.faces[surface.face_geom == geom]
        if not len(faces):
            continue
        meshes = pymeshlab.MeshSet()
        used, faces = np.unique(faces, return_inverse=True)
        vertices = surface.vertices[used]
        meshes.add_mesh(pymeshlab.Mesh(vertices, faces.reshape(-1, 3)))
        weld = 1e-7 * float(np.ptp(vertices, axis=0).max())
        meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(weld))
        meshes.meshing_remove_duplicate_faces()
        meshes.meshing_remove_null_faces()
        if _disagrees(meshes.current_mesh().face_matrix()):
            # Where more than two faces share an edge there is no coherent winding, and the file's is kept.
            with suppress(pymeshlab.PyMeshLabException):
                meshes.meshing_re_orient_faces_coherently()
        mesh = meshes.current_mesh()
        faces = mesh.face_matrix().astype(np.int64)
        face_geom = np.full(len(faces), geom, dtype=np.int64)
        parts.append(Surface(np.array(mesh.vertex_matrix()), faces, face_geom, ()))
    joined = Surface.joined(parts)
    return Surface(joined.vertices, joined.faces, joined.face_geom, surface.geoms)


def _edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "edge 2"]:
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _disagrees(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Return whether two neighbours run along their common edge in the same sense."""
    edges = _edges(faces.astype(np.int64))
    _, edge, num_faces = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    sense = np.bincount(edge.ravel(), np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return bool(((num_faces == 2) & (sense != 0)).any())


def _parts(surface: Surface) -> Int[np.ndarray, " f"]:
    """Return the connected part of each face, numbered in the order of the faces."""
    start, end = _edges(surface.faces).T
    size = len(surface.vertices)
    _, label = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (size, size)), directed=False)
    label = label[surface.faces[:, 0]]
    _, first, part = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[part]


def _solid(surface: Surface, part: Int[np.ndarray, " f"]) -> Bool[np.ndarray, " part"]:
    """Return which parts are closed but for small holes."""
    edges = np.sort(_edges(surface.faces), axis=1)
    _, first, num_faces = np.unique(edges, axis=0, return_index=True, return_counts=True)
    border = first[num_faces == 1]
    length = np.linalg.norm(np.diff(surface.vertices[edges[border]], axis=1)[:, 0], axis=1)
    num = part.max(initial=-1) + 1
    perimeter = np.bincount(part[border // 3], length, minlength=num)
    return perimeter**2 <= MAX_HOLE * np.bincount(part, surface.face_areas, minlength=num)


def _signed_volumes(surface: Surface, part: Int[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """Return the volume between each face and its part's first corner; negative if the face looks toward it [m³]."""
    _, first = np.unique(part, return_index=True)
    corners = surface.corners - surface.corners[first, :1][part]
    return np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0


def _winding(shell: Shell, part: int, pos: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return how often a part winds around points: 1 inside, 0 outside, 1/2 on a flat piece of it."""
    import igl

    winding = np.zeros(len(pos))
    vertices, faces = shell.solid(part)
    near = ((pos >= vertices.min(axis=0) - shell.offset) & (pos <= vertices.max(axis=0) + shell.offset)).all(axis=1)
    if near.any():
        winding[near] = np.atleast_1d(igl.winding_number(vertices, faces, pos[near]))
    return winding


def _enclosed(shell: Shell) -> Bool[np.ndarray, " part"]:
    """Return which parts lie wholly inside some solid part."""
    num = len(shell.is_solid)
    owner = np.full(len(shell.surface.vertices), -1)
    owner[shell.surface.faces] = shell.part[:, None]
    vertices, owner = shell.surface.vertices[owner >= 0], owner[owner >= 0]
    is_enclosed = np.zeros(num, dtype=bool)
    for part in np.flatnonzero(shell.is_solid).tolist():
        other = owner != part
        # Not 1/2: a vertex on the other's surface, even in a notch of it, shall not count.
        is_out = _winding(shell, part, vertices[other]) < 0.9
        is_inside = np.bincount(owner[other][is_out], minlength=num) == 0
        is_inside[part] = False
        is_enclosed |= is_inside
    return is_enclosed


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
    fans = np.stack([np.broadcast_to(polygons[:, :1], polygons[:, 2:].shape), polygons[:, 1:-1], polygons[:, 2:]], axis=2)
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
    """Draw points evenly over pieces of faces; keep those in the region and on the outer surface."""
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
    is_kept = _outside(shell, region, pos, face)
    return Pool(pos[is_kept], shell.surface.face_normals[face[is_kept]], float(area[-1]) / num)


def _outside(
    shell: Shell, region: Region, pos: Float[np.ndarray, "n 3"], face: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which points of faces are on the outside of the union of all solid parts.

    Where solids touch back to back neither is outside; where their faces coincide and look the same way, only the first
    part that belongs to the region keeps its points, lest the place count twice.
    """
    normal = shell.surface.face_normals[face]
    above, below = pos + shell.offset * normal, pos - shell.offset * normal
    part = shell.part[face]
    is_geom = np.ones(len(shell.surface.geoms), bool) if region.is_geom is None else region.is_geom
    is_out = np.ones(len(pos), dtype=bool)
    for solid in np.flatnonzero(shell.is_solid).tolist():
        is_out &= _winding(shell, solid, above) < 0.5
        if is_geom[shell.surface.face_geom[shell.part == solid]].any():
            later = np.flatnonzero(is_out & (part > solid))
            is_out[later] = _winding(shell, solid, below[later]) < 0.5
    is_out[is_out] = _seen(shell, above[is_out], normal[is_out])
    return is_out


def _seen(shell: Shell, above: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which points just above faces are seen from far away."""
    is_seen = np.zeros(len(above), dtype=bool)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(DIRECTIONS)
    # A Fibonacci lattice covers the sphere evenly; walking it in steps of 37 meets every side early.
    height = 1.0 - (2.0 * np.arange(DIRECTIONS) + 1.0) / DIRECTIONS
    ring = np.sqrt(1.0 - height**2)
    lattice = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=-1)
    for direction in lattice[37 * np.arange(DIRECTIONS) % DIRECTIONS]:
        left = np.flatnonzero(~is_seen)
        left = left[normal[left] @ direction < -0.05]
        if not len(left):
            continue
        view = View.of(shell.surface, frame(direction))
        uvt = above[left] @ view.axes.T
        is_seen[left] = first_hits(view, uvt[:, :2]).depth >= uvt[:, 2]
    return is_seen


def spread(pool: Pool, count: int | None, spacing: float | None, seed: int) -> Int[np.ndarray, " taxel"]:
    """Return the chosen points of a pool, ascending: exactly `count`, or as many as fit at `spacing` [m]."""
    order = np.random.default_rng([seed, 1]).permutation(len(pool.pos))
    if count is None:
        assert spacing is not None
        return _thrown(pool.pos, order, spacing)
    candidates = np.sort(order[: CANDIDATES * count])
    return candidates[_eliminated(pool.pos[candidates], count, pool.area)]


def _thrown(pos: Float[np.ndarray, "pool 3"], order: Int[np.ndarray, " pool"], spacing: float) -> Int[np.ndarray, " n"]:
    """Take points in some order, each unless it is within `spacing` of one taken before."""
    tree = KDTree(pos)
    is_free = np.ones(len(pos), dtype=bool)
    taken = []
    for point in order:
        if is_free[point]:
            taken.append(point)
            is_free[tree.query_ball_point(pos[point], spacing)] = False
    return np.sort(np.array(taken, dtype=np.int64))


def _eliminated(pos: Float[np.ndarray, "n 3"], count: int, area: float) -> Int[np.ndarray, " count"]:
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


def shares(pool: Pool, chosen: Int[np.ndarray, " taxel"]) -> Float[np.ndarray, " taxel"]:
    """Return the area of the pool's points that are nearest to each chosen one [m²]."""
    _, nearest = KDTree(pool.pos[chosen]).query(pool.pos)
    return pool.point_area * np.bincount(nearest, minlength=len(chosen))
