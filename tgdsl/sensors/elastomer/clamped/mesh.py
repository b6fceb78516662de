"""Remeshing a region of the plane: triangles that are fine along the edge, where a clamped field varies, and coarser inside.

The edge is thinned to the vertices that give it its shape and cut into pieces no longer than the element size; inside stand the
points of nested triangular lattices: those with a spacing of 2^k sizes where the edge is at least 2^k / `GRADE` sizes away;
Delaunay's triangulation joins them, pieces of the edge that it misses are bisected, and what lies outside is removed. Neither
scikit-fem nor libigl meshes an outline, and the meshers that do are not under a free licence.

Shapes: `n` vertices of a loop, `p` points, `m` triangles, `seg` pieces of the edge.
"""

from __future__ import annotations

from itertools import pairwise

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, KDTree
from skfem import MeshTri

from tgdsl.sensors.elastomer.clamped.sheet import refused

MAX_CORNERS = 20_000
"""Bound on the corners of all triangles; the finite elements have four nodes for each."""
MAX_CELLS = 1_000_000
"""Bound on the area of the pad's bounding box over the square of the element size."""
SHAPE = 0.05
"""How far the meshed edge may be from the pad's own, in element sizes."""
GRADE = 0.5
"""Growth of the size of triangles with the distance from the edge."""
COARSEST = 3
"""Inside, triangles are at most 2^this element sizes large."""
CLEARANCE = 0.6
"""Distance of inner points from the edge, in element sizes."""
ROUNDS = 40
"""Times that pieces of the edge may be bisected."""


def mesh(outline: list[Float[np.ndarray, "n 2"]], size: float) -> MeshTri:
    """Return triangles of about `size` [m] at the edge that fill the closed loops of `outline` [m].

    Raises:
        LowerError: There would be more than `MAX_CORNERS` corners, or no triangulation keeps to the edge.
    """
    points, pieces = _edge([loop / size for loop in outline])
    inner = _inside(points, pieces)
    if len(points) + len(inner) > MAX_CORNERS:
        raise refused(
            f"the pad needs {len(points) + len(inner)} corners of triangles at an element size of {1e3 * size:.3g} mm, "
            f"{MAX_CORNERS} are allowed",
            "give a smaller region, a larger thickness or less drag",
        )
    for _ in range(ROUNDS):
        everything = np.concatenate([points, inner])
        triangles = Delaunay(everything).simplices.astype(np.int64)
        triangles = triangles[np.abs(igl.doublearea(everything, triangles)) > 1e-7]
        triangulation = MeshTri(np.ascontiguousarray(everything.T), np.ascontiguousarray(triangles.T), sort_t=False)
        missing = ~np.isin(_sides(pieces), _sides(np.asarray(triangulation.facets).T))
        if not missing.any():
            break
        points, pieces = _bisected(points, pieces, missing)
    within = np.flatnonzero(_is_within(everything[triangles].mean(axis=1), points, pieces))
    _check(triangulation, within, pieces)
    inside = triangulation.restrict(within)
    assert isinstance(inside, MeshTri)
    return inside.scaled(size)


def _sides(ends: Int[np.ndarray, "seg 2"]) -> Int[np.ndarray, " seg"]:
    return np.sort(ends, axis=1).astype(np.int64) @ [1 << 32, 1]


def _edge(outline: list[Float[np.ndarray, "n 2"]]) -> tuple[Float[np.ndarray, "p 2"], Int[np.ndarray, "seg 2"]]:
    """Return points along the loops, at most one apart, and the pieces between them; points that coincide are one."""
    loops = [_sampled(loop) for loop in outline]
    points = np.concatenate(loops)
    after = np.concatenate([np.roll(np.arange(len(loop)), -1) + at for loop, at in zip(loops, _starts(loops), strict=True)])
    same = np.arange(len(points))
    for first, second in sorted(KDTree(points).query_pairs(1e-6)):
        same[second] = same[first]
    distinct, index = np.unique(same, return_inverse=True)
    pieces = np.stack([index, index[after]], axis=1)
    return points[distinct], pieces[pieces[:, 0] != pieces[:, 1]].astype(np.int64)


def _starts(parts: list[np.ndarray]) -> Int[np.ndarray, " part"]:
    return np.cumsum([0, *map(len, parts)])[:-1]


def _sampled(loop: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "p 2"]:
    """Return points on a loop: the vertices that give it its shape, and points evenly between them along the loop."""
    into, out = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    bend = np.abs(np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], (into * out).sum(axis=1)))
    loop = np.roll(loop, -int(np.argmax(bend)), axis=0)
    closed = np.concatenate([loop, loop[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    far = int(np.argmax(np.linalg.norm(loop - loop[0], axis=1)))
    # Douglas and Peucker, 1973
    halves = (igl.ramer_douglas_peucker(np.ascontiguousarray(half), SHAPE)[1] for half in (closed[: far + 1], closed[far:]))
    corners = np.unique(np.concatenate([at + np.asarray(half) for at, half in zip((0, far), halves, strict=True)]))
    places = [
        np.linspace(way[a], way[b], max(1, int(np.ceil(way[b] - way[a] - 1e-6))), endpoint=False) for a, b in pairwise(corners)
    ]
    place = np.concatenate(places)
    return np.stack([np.interp(place, way, closed[:, k]) for k in range(2)], axis=1)


def _inside(points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]) -> Float[np.ndarray, "q 2"]:
    """Return the points of nested triangular lattices within the edge, unit spacing along it."""
    low, high = points.min(axis=0), points.max(axis=0)
    if float(np.prod(high - low)) > MAX_CELLS:
        raise refused(
            f"the pad is {high[0] - low[0]:.0f} by {high[1] - low[1]:.0f} elements large, "
            f"more than {MAX_CORNERS} corners of triangles would be needed",
            "give a smaller region, a larger thickness or less drag",
        )
    rows = int(np.ceil((high - low)[1] / np.sqrt(0.75))) + 1
    columns = int(np.ceil((high - low)[0])) + rows + 1
    i, j = (index.ravel() for index in np.meshgrid(np.arange(-rows // 2, columns), np.arange(rows), indexing="ij"))
    lattice = low + np.stack([i + 0.5 * j, np.sqrt(0.75) * j], axis=1)
    boxed = (lattice < high).all(axis=1) & (lattice > low).all(axis=1)
    i, j, lattice = i[boxed], j[boxed], lattice[boxed]
    distance = KDTree(_dense(points, pieces)).query(lattice, distance_upper_bound=2**COARSEST / GRADE)[0]  # beyond: inf
    level = np.clip(np.floor(np.log2(np.maximum(GRADE * distance, 1.0))), 0, COARSEST).astype(np.int64)
    is_used = ((i | j) % (1 << level) == 0) & (distance > CLEARANCE)
    lattice = lattice[is_used]
    return lattice[_is_within(lattice, points, pieces)]


def _dense(points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]) -> Float[np.ndarray, "more 2"]:
    a, b = points[pieces[:, 0]], points[pieces[:, 1]]
    return np.concatenate([a + part * (b - a) for part in np.arange(4) / 4])


def _is_within(
    where: Float[np.ndarray, "q 2"], points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]
) -> Bool[np.ndarray, " q"]:
    return np.abs(igl.winding_number(points, pieces, where)) > 0.5


def _bisected(
    points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"], which: Bool[np.ndarray, " seg"]
) -> tuple[Float[np.ndarray, "more 2"], Int[np.ndarray, "pieces 2"]]:
    """Return the edge with some pieces cut in the middle."""
    cut = pieces[which]
    middle = len(points) + np.arange(len(cut))
    halves = [np.stack([cut[:, 0], middle], axis=1), np.stack([middle, cut[:, 1]], axis=1)]
    return np.concatenate([points, points[cut].mean(axis=1)]), np.concatenate([pieces[~which], *halves])


def _check(mesh: MeshTri, within: Int[np.ndarray, " m"], pieces: Int[np.ndarray, "seg 2"]) -> None:
    """Refuse triangles of a mesh whose edge is not the region's."""
    facet, count = np.unique(np.asarray(mesh.t2f)[:, within], return_counts=True)
    wrong = np.setxor1d(_sides(np.asarray(mesh.facets).T[facet[count == 1]]), _sides(pieces))
    if not len(within) or len(wrong):
        raise refused(
            f"no triangles fill the pad: {len(wrong)} pieces of its edge do not bound the mesh",
            "its outline may have spikes or slits; select a region with a plain outline",
        )
