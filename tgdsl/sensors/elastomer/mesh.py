"""Meshing a region of the plane anew: triangles that are fine along the edge, where a clamped field varies, and coarser inside.

The edge is thinned to the vertices that give it its shape and cut into pieces no longer than the element size; inside stand the
points of nested triangular lattices, of which those with spacing 2^k sizes are used where the edge is at least 2^k / `GRADE`
sizes away; Delaunay's triangulation joins them, pieces of the edge that it misses are halved, and what lies outside is removed.

Shapes: `n` vertices of a loop, `p` points, `m` triangles, `seg` pieces of the edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, KDTree

from tgdsl.sensors.elastomer.sheet import half_edges, open_sides, refused

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
"""Times that pieces of the edge may be halved."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of a plane region.

    Attributes:
        points: Corners [m].
        triangles: Indices of their corners, counter-clockwise.
    """

    points: Float[np.ndarray, "p 2"]
    triangles: Int[np.ndarray, "m 3"]


def mesh(outline: list[Float[np.ndarray, "n 2"]], size: float) -> Mesh:
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
        triangles = _oriented(everything, Delaunay(everything).simplices)
        missing = _missing(triangles, pieces)
        if not missing.any():
            break
        points, pieces = _halved(points, pieces, missing)
    centre = everything[triangles].mean(axis=1)
    triangles = triangles[_is_within(centre, points, pieces)]
    _check(everything, triangles, pieces)
    return Mesh(np.multiply(everything, size), triangles)


def _edge(outline: list[Float[np.ndarray, "n 2"]]) -> tuple[Float[np.ndarray, "p 2"], Int[np.ndarray, "seg 2"]]:
    """Return points along the loops, at most one apart, and the pieces between them; points that coincide are one."""
    loops = [_sampled(loop) for loop in outline]
    points = np.concatenate(loops)
    after = np.concatenate([np.roll(np.arange(len(loop)), -1) + at for loop, at in zip(loops, _starts(loops), strict=True)])
    same = np.arange(len(points))
    for first, second in sorted(KDTree(points).query_pairs(1e-6)):
        same[second] = same[first]
    kept, index = np.unique(same, return_inverse=True)
    pieces = np.stack([index, index[after]], axis=1)
    return points[kept], pieces[pieces[:, 0] != pieces[:, 1]].astype(np.int64)


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
    kept = np.array(sorted({0, far, len(loop)} | _shaping(closed, 0, far) | _shaping(closed, far, len(loop))))
    places = [
        np.linspace(way[a], way[b], max(1, int(np.ceil(way[b] - way[a] - 1e-6))), endpoint=False) for a, b in pairwise(kept)
    ]
    place = np.concatenate(places)
    return np.stack([np.interp(place, way, closed[:, k]) for k in range(2)], axis=1)


def _shaping(line: Float[np.ndarray, "n 2"], first: int, last: int) -> set[int]:
    """Return the vertices between two that a line needs to stay within `SHAPE` of itself (Douglas and Peucker, 1973)."""
    found: set[int] = set()
    waiting = [(first, last)]
    while waiting:
        a, b = waiting.pop()
        if b - a < 2:
            continue
        offset, chord = line[a + 1 : b] - line[a], line[b] - line[a]
        place = np.clip(offset @ chord / max(float(chord @ chord), np.finfo(float).tiny), 0.0, 1.0)
        gap = np.linalg.norm(offset - place[:, None] * chord, axis=1)
        if gap.max() > SHAPE:
            middle = a + 1 + int(np.argmax(gap))
            found.add(middle)
            waiting += [(a, middle), (middle, b)]
    return found


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
    kept = ((i | j) % (1 << level) == 0) & (distance > CLEARANCE)
    lattice = lattice[kept]
    return lattice[_is_within(lattice, points, pieces)]


def _dense(points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]) -> Float[np.ndarray, "more 2"]:
    """Return points a quarter apart along the edge."""
    a, b = points[pieces[:, 0]], points[pieces[:, 1]]
    return np.concatenate([a + part * (b - a) for part in np.arange(4) / 4])


def _is_within(
    where: Float[np.ndarray, "q 2"], points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"]
) -> Bool[np.ndarray, " q"]:
    """Return which points are inside the edge: a ray to the right crosses it an odd number of times."""
    a, b = points[pieces[:, 0]], points[pieces[:, 1]]
    odd = np.zeros(len(where), dtype=bool)
    for (ax, ay), (bx, by) in zip(a, b, strict=True):
        spans = np.flatnonzero((ay > where[:, 1]) != (by > where[:, 1]))
        x, y = where[spans].T
        odd[spans] ^= x < ax + (y - ay) * (bx - ax) / (by - ay)
    return odd


def _oriented(points: Float[np.ndarray, "p 2"], triangles: np.ndarray) -> Int[np.ndarray, "m 3"]:
    """Return the triangles that are more than a line, counter-clockwise."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    turned = np.where((area < 0)[:, None], triangles[:, ::-1], triangles)
    return turned[np.abs(area) > 1e-7].astype(np.int64)


def _missing(triangles: Int[np.ndarray, "m 3"], pieces: Int[np.ndarray, "seg 2"]) -> Bool[np.ndarray, " seg"]:
    ends = np.sort(np.stack(half_edges(triangles), axis=1), axis=1)
    count = int(max(ends.max(), pieces.max())) + 1
    return ~np.isin(np.sort(pieces, axis=1) @ [count, 1], ends @ [count, 1])


def _halved(
    points: Float[np.ndarray, "p 2"], pieces: Int[np.ndarray, "seg 2"], which: Bool[np.ndarray, " seg"]
) -> tuple[Float[np.ndarray, "more 2"], Int[np.ndarray, "pieces 2"]]:
    """Return the edge with some pieces cut in the middle."""
    cut = pieces[which]
    middle = len(points) + np.arange(len(cut))
    halves = [np.stack([cut[:, 0], middle], axis=1), np.stack([middle, cut[:, 1]], axis=1)]
    return np.concatenate([points, points[cut].mean(axis=1)]), np.concatenate([pieces[~which], *halves])


def _check(points: Float[np.ndarray, "p 2"], triangles: Int[np.ndarray, "m 3"], pieces: Int[np.ndarray, "seg 2"]) -> None:
    """Refuse a mesh whose edge is not the region's."""
    first, last = half_edges(triangles)
    sides = open_sides(triangles)
    got = {(int(a), int(b)) for a, b in np.sort(np.stack([first[sides], last[sides]], axis=1), axis=1)}
    wanted = {(int(a), int(b)) for a, b in np.sort(pieces, axis=1)}
    if not len(triangles) or got != wanted:
        raise refused(
            f"no triangles fill the pad: {len(got ^ wanted)} pieces of its edge do not bound the mesh",
            "its outline may have spikes or slits; select a region with a plain outline",
        )
