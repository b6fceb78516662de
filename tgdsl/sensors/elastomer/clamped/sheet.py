"""Triangles of a pad as one sheet with an open edge: welded, its seams closed, its neighbours known.

A soup comes in, as a robot's meshes are. Vertices that coincide are welded, an edge that another triangle's vertex lies on is
split there (a T-junction would otherwise be a slit), and where two parts of the sheet touch in one vertex each gets its own.
libigl and trimesh weld by rounding, which leaves apart what lies on two sides of a rounding limit, and close no T-junctions.

Shapes: `v` vertices, `f` triangles, `pair` edges that two triangles share, `seg` edges of one triangle only.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tgdsl.errors import LowerError

COINCIDENT = 1e-6
"""Distance below which two vertices are one, over the size of the pad."""
ROUNDS = 16
"""Passes over the seams; each closes at least one T-junction of every edge that has some."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """A connected orientable surface with an edge.

    Attributes:
        vertices: Positions in the body frame [m].
        faces: Vertex indices, counter-clockwise seen from outside.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def refused(what: str, hint: str = "") -> LowerError:
    """Return the error of a pad that cannot have a clamped boundary."""
    return LowerError(what, field="boundary", hint=hint)


def half_edges(faces: Int[np.ndarray, "f 3"]) -> tuple[Int[np.ndarray, " h"], Int[np.ndarray, " h"]]:
    """Return first and last vertex of each side of each triangle; side 3 f + k leads from corner k to corner k + 1."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def _edges(faces: Int[np.ndarray, "f 3"]) -> tuple[Int[np.ndarray, " h"], Int[np.ndarray, " e"]]:
    ends = np.sort(np.stack(half_edges(faces), axis=1), axis=1)
    _, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return edge.ravel(), count


def shared(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "pair 2"]:
    """Return the two sides of each edge that two triangles share."""
    edge, count = _edges(faces)
    order = np.argsort(edge, kind="stable")
    return order[np.isin(edge[order], np.flatnonzero(count == 2))].reshape(-1, 2)


def open_sides(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " seg"]:
    """Return the sides that only one triangle has."""
    edge, count = _edges(faces)
    return np.flatnonzero(count[edge] == 1)


def welded(corners: Float[np.ndarray, "f 3 3"]) -> Sheet:
    """Return triangles with shared vertices, without degenerate and repeated ones, and with T-junctions closed."""
    points = corners.reshape(-1, 3)
    near = COINCIDENT * float(np.ptp(points, axis=0).max())
    first, second = KDTree(points).query_pairs(near, output_type="ndarray").T
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(len(points), len(points)))
    _, vertex = connected_components(graph, directed=False)
    vertices = points[np.unique(vertex, return_index=True)[1]]
    faces = vertex.reshape(-1, 3).astype(np.int64)
    faces = faces[(faces != np.roll(faces, -1, axis=1)).all(axis=1)]
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    faces = np.unique(turned, axis=0)
    for _ in range(ROUNDS):
        split = _without_seams(vertices, faces, near)
        if len(split) == len(faces):
            break
        faces = split
    return Sheet(vertices, faces)


def _without_seams(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], near: float) -> Int[np.ndarray, "more 3"]:
    """Return the triangles, those with vertices on one of their open sides replaced by a fan over these."""
    first, last = half_edges(faces)
    sides = open_sides(faces)
    rim = np.unique([first[sides], last[sides]])
    whole, fans = np.ones(len(faces), dtype=bool), []
    for side in sides:
        face, k = divmod(int(side), 3)
        start, end, tip = faces[face, [k, (k + 1) % 3, (k + 2) % 3]]
        along = vertices[end] - vertices[start]
        offset = vertices[rim] - vertices[start]
        place = offset @ along / (along @ along)
        gap = np.linalg.norm(offset - place[:, None] * along, axis=1)
        on = (gap < near) & (place > 0) & (place < 1) & (rim != start) & (rim != end) & (rim != tip)
        if whole[face] and on.any():
            chain = [start, *rim[on][np.argsort(place[on])], end]
            fans += [(a, b, tip) for a, b in pairwise(chain)]
            whole[face] = False
    return np.concatenate([faces[whole], np.array(fans, dtype=np.int64).reshape(-1, 3)])


def opened(sheet: Sheet) -> Sheet:
    """Return a connected part as a manifold: parts that touch in a vertex get a vertex each.

    Raises:
        LowerError: An edge belongs to three triangles, two neighbours are wound against each other, or there is no edge.
    """
    first, _ = half_edges(sheet.faces)
    edge, count = _edges(sheet.faces)
    if (count > 2).any():
        worst = int(np.argmax(count))
        place = sheet.vertices[first[edge == worst][0]]
        raise refused(
            f"the pad's surface is not a sheet: {count[worst]} triangles meet in one edge near {_point(place)}",
            "select a region in which each edge belongs to one or two triangles",
        )
    if not (count == 1).any():
        raise refused(
            f"the pad's surface is closed: none of its {len(sheet.faces)} triangles has an open edge, so nothing is clamped",
            "select a part of it as the pad",
        )
    pairs = shared(sheet.faces)
    against = first[pairs[:, 0]] == first[pairs[:, 1]]
    if against.any():
        place = sheet.vertices[first[pairs[against][0, 0]]]
        raise refused(
            f"the pad's surface is not orientable: neighbouring triangles near {_point(place)} are wound against each other",
            "wind all triangles counter-clockwise seen from outside",
        )
    faces, source = (np.asarray(part, dtype=np.int64) for part in igl.split_nonmanifold(sheet.faces))
    return Sheet(sheet.vertices[source], faces)


def _point(place: Float[np.ndarray, " 3"]) -> str:
    return "({}) mm".format(", ".join(f"{1e3 * x:.3g}" for x in place))
