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
from jaxtyping import Complex, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from tgdsl.errors import LowerError

COINCIDENT = 1e-6  # distance below which two vertices are one, over the size of the pad
SEAM_ROUNDS = 16  # passes over the seams; each closes at least one T-junction of every edge that has some


@dataclass(frozen=True, eq=False)
class Sheet:
    """A connected orientable surface with an edge."""

    vertices: Float[np.ndarray, "v 3"]  # positions in the body frame [m]
    faces: Int[np.ndarray, "f 3"]  # vertex indices, counter-clockwise seen from outside


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
    for _ in range(SEAM_ROUNDS):
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


STRETCH = 0.02  # largest relative change of an edge's length that still counts as unrolling
ROUNDS = 200
SETTLED = 1e-4  # relative decrease of the squared misfit at which the rounds end
EXACT = 1e-12  # squared relative misfit that counts as none
THIN = 1e-7  # height over length below which a triangle has no side up


def flatten(sheet: Sheet) -> Float[np.ndarray, "v 2"]:
    """Return plane coordinates [m] of the vertices, seen from outside, the first axis along the nearest body axis.

    Unrolling a sheet to the plane without stretching it.

    A flat sheet is moved rigidly. A curved one is unrolled in two steps: the angle of each triangle in the plane, by carrying
    directions across shared edges (the angle that is left over around curved vertices is spread by least squares); then the
    vertices, by least squares of the edges, and a few rounds of both in turn ("as rigid as possible", Liu et al., *A
    Local/Global Approach to Mesh Parameterization*, 2008, here with a positive weight for each edge so that slivers do no
    harm). Where the sheet can be unrolled, a part of a cylinder or cone, the first step is exact already.

    libigl does not replace it: its conformal map (`lscm`) is NaN where one triangle has no area, and `arap_precomputation`
    fails on half of the tests' pads, half cylinders of long triangles among them, and takes 15 times as long on the others.

    Shapes: `v` vertices, `f` triangles, `pair` shared edges. Points of the plane are complex numbers inside.

    Raises:
        LowerError: The sheet stretches by more than `STRETCH`, folds over or overlaps itself.
    """
    corners = sheet.vertices[sheet.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), np.finfo(float).tiny)
    offset = sheet.vertices - sheet.vertices.mean(axis=0)
    if np.abs(offset @ normal).max() <= COINCIDENT * np.ptp(offset, axis=0).max():
        across = np.eye(3)[np.argmin(np.abs(normal))]
        first = np.cross(normal, across) / np.linalg.norm(np.cross(normal, across))
        plane = offset @ np.stack([first, np.cross(normal, first)], axis=1)
    else:
        unrolled = _unrolled(sheet)
        plane = np.stack([np.real(unrolled), np.imag(unrolled)], axis=1)
    plane = plane - plane.mean(axis=0)
    _check_flat(sheet, plane)
    return plane @ _turn(sheet, plane)


def jacobians(sheet: Sheet, plane: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "f 3 2"]:
    """Return the derivative of the body-frame position by the plane coordinates on each triangle; zero without area."""
    space, flat = sheet.vertices[sheet.faces], plane[sheet.faces]
    e, d = space[:, 1:] - space[:, :1], flat[:, 1:] - flat[:, :1]
    twice = d[:, 0, 0] * d[:, 1, 1] - d[:, 0, 1] * d[:, 1, 0]
    safe = np.where(has_area(plane, sheet.faces), twice, np.inf)
    du = (d[:, 1, 1, None] * e[:, 0] - d[:, 0, 1, None] * e[:, 1]) / safe[:, None]
    dv = (d[:, 0, 0, None] * e[:, 1] - d[:, 1, 0, None] * e[:, 0]) / safe[:, None]
    return np.stack([du, dv], axis=2)


def has_area(points: Float[np.ndarray, "v k"], faces: Int[np.ndarray, "f 3"]) -> np.ndarray:
    """Return which triangles are more than a line."""
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.abs(igl.doublearea(points, faces)) > THIN * longest**2


def _laid(sheet: Sheet) -> Complex[np.ndarray, "f 3"]:
    """Return each triangle laid into the plane by itself: corner 0 at the origin, corner 1 on the first axis."""
    corners = sheet.vertices[sheet.faces]
    e, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(e, axis=1)
    tip = (e * d).sum(axis=1) / length + 1j * np.linalg.norm(np.cross(e, d), axis=1) / length
    return np.stack([np.zeros_like(tip), length + 0j, tip], axis=1)


def _angles(faces: Int[np.ndarray, "f 3"], laid: Complex[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    """Return the rotation of each triangle that makes neighbours agree on the direction of their shared edge."""
    direction = np.angle(np.roll(laid, -1, axis=1) - laid).ravel()
    side, twin = shared(faces).T
    count = len(faces)
    start, end = np.concatenate([side, twin]) // 3, np.concatenate([twin, side]) // 3
    step = direction[side] - (direction[twin] + np.pi)
    step = np.concatenate([step, -step])
    graph = csr_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    order, parent = breadth_first_order(graph, 0, directed=False)
    key = start * count + end
    sorting = np.argsort(key, kind="stable")
    side_ids = sorting[np.searchsorted(key, parent[order[1:]] * count + order[1:], sorter=sorting)]
    angle = np.zeros(count)
    for face, way in zip(order[1:].tolist(), side_ids.tolist(), strict=True):
        angle[face] = angle[parent[face]] + step[way]
    left = angle[end] - angle[start] - step
    left = (left + np.pi) % (2 * np.pi) - np.pi
    if np.abs(left).max(initial=0.0) < 1e-12:
        return angle
    laplacian = _laplacian(start, end, np.ones(len(start)), count)
    excess = np.bincount(end, left, count) - np.bincount(start, left, count)
    angle[1:] -= splu(laplacian[1:, 1:].tocsc()).solve(excess[1:])
    return angle


def _laplacian(
    start: Int[np.ndarray, " e"], end: Int[np.ndarray, " e"], weight: Float[np.ndarray, " e"], count: int
) -> csr_matrix:
    """Return the matrix of Σ w (x_end − x_start)²."""
    rows = np.concatenate([start, end, start, end])
    columns = np.concatenate([start, end, end, start])
    values = np.concatenate([weight, weight, -weight, -weight])
    return csr_matrix(coo_matrix((values, (rows, columns)), shape=(count, count)))


def _unrolled(sheet: Sheet) -> Complex[np.ndarray, " v"]:
    """Return the vertices in the plane such that all edges keep their length as well as they can."""
    faces, count = sheet.faces, len(sheet.vertices)
    laid = _laid(sheet)
    edge = (np.roll(laid, -1, axis=1) - laid).ravel()
    length = np.abs(edge)
    area = 0.5 * np.real(laid[:, 1]) * np.imag(laid[:, 2])
    longest = length.reshape(-1, 3).max(axis=1)
    weight = np.repeat(area + 1e-3 * longest**2, 3) / length**2
    weight /= weight.mean()
    start, end = half_edges(faces)
    solver = splu(_laplacian(start, end, weight, count)[1:, 1:].tocsc())
    angle = _angles(faces, laid)
    place, misfit = np.zeros(count, dtype=np.complex128), np.inf
    for _ in range(ROUNDS):
        target = np.repeat(np.exp(1j * angle), 3) * edge
        force = _at(end, weight * target, count) - _at(start, weight * target, count)
        solution = solver.solve(np.stack([np.real(force), np.imag(force)], axis=1)[1:])
        place[1:] = solution[:, 0] + 1j * solution[:, 1]
        got = place[end] - place[start]
        last_misfit, misfit = misfit, float((weight * np.abs(got - target) ** 2).sum())
        if misfit > (1 - SETTLED) * last_misfit or misfit < EXACT * float((weight * length**2).sum()):
            break
        angle = np.angle((weight * got * edge.conj()).reshape(-1, 3).sum(axis=1))
    return place


def _at(index: Int[np.ndarray, " e"], value: Complex[np.ndarray, " e"], count: int) -> Complex[np.ndarray, " v"]:
    return np.bincount(index, np.real(value), count) + 1j * np.bincount(index, np.imag(value), count)


def _turn(sheet: Sheet, plane: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "2 2"]:
    """Return the rotation of the plane that lays its first axis along the body axis that the sheet follows best."""
    mean = np.einsum("f,fxu->xu", np.asarray(igl.doublearea(plane, sheet.faces)), jacobians(sheet, plane))
    length = np.linalg.norm(mean, axis=1)
    x, y = mean[int(np.argmax(length > (1 - 1e-6) * length.max()))] / length.max()
    x, y = x / np.hypot(x, y), y / np.hypot(x, y)
    return np.array([[x, -y], [y, x]])


def _check_flat(sheet: Sheet, plane: Float[np.ndarray, "v 2"]) -> None:
    start, end = half_edges(sheet.faces)
    length = np.linalg.norm(sheet.vertices[end] - sheet.vertices[start], axis=1)
    stretch = np.abs(np.linalg.norm(plane[end] - plane[start], axis=1) / length - 1)
    if stretch.max() > STRETCH:
        raise refused(
            f"the pad's surface cannot be unrolled: an edge changes its length by {stretch.max():.1%}, "
            f"{STRETCH:.0%} are allowed",
            "a pad is flat or curved one way, as a cylinder is, and does not close around it; select a smaller region",
        )
    solid = has_area(sheet.vertices, sheet.faces)
    flipped = int((np.asarray(igl.doublearea(plane, sheet.faces))[solid] <= 0).sum())
    if flipped:
        raise refused(
            f"the pad's surface folds over: {flipped} of its {len(solid)} triangles are upside down when it is unrolled",
            "a pad has one outer layer; select a smaller region, or repair the mesh",
        )
    if (crossing := _crossings(plane, igl.boundary_loop_all(sheet.faces))) is not None:
        at = ", ".join(f"{1e3 * x:.3g}" for x in sheet.vertices[crossing])
        raise refused(
            f"the pad's surface overlaps itself when it is unrolled, near ({at}) mm",
            "a pad unrolls to one layer; select a smaller region",
        )


def _crossings(plane: Float[np.ndarray, "v 2"], chains: list[list[int]]) -> int | None:
    """Return a vertex near a crossing of the pad's edge with itself, or None."""
    first = np.concatenate(chains)
    last = np.concatenate([np.roll(chain, -1) for chain in chains])
    a, b = plane[first], plane[last]
    span = b - a
    slack = 1e-9 * float(np.ptp(plane, axis=0).max()) ** 2
    for i in range(len(a) - 1):
        c, d = a[i + 1 :], b[i + 1 :]
        ours = _side(a[i], span[i], c) * _side(a[i], span[i], d)
        theirs = _side(c, span[i + 1 :], a[i]) * _side(c, span[i + 1 :], b[i])
        if ((ours < -(slack**2)) & (theirs < -(slack**2))).any():
            return int(first[i])
    return None


def _side(origin: np.ndarray, along: np.ndarray, point: np.ndarray) -> np.ndarray:
    offset = point - origin
    return along[..., 0] * offset[..., 1] - along[..., 1] * offset[..., 0]
