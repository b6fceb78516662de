"""How much of each cell of a grid a body fills, as weights of points to integrate over it, and points of the body's surface.

Along lines of sight through the cells, in all three directions, the pieces inside the body follow exactly from where the
lines cross its triangles. On the grid's points, Gauss' along each axis, weights are chosen such that all polynomials of up to
degree four along each axis are integrated over the body in a cell as these lines integrate them; each of the three directions
counts as the square of the surface that it sees in the cell. A full cell has Gauss' own weights. The crossings themselves, each
standing for cos²θ of the surface around it, are the points to integrate over the surface.

A line crosses each closed surface as often inwards as outwards: on which side of an edge a line passes is one number for both
triangles of the edge, and lines are moved aside a little, so that they pass no edge within rounding.

Everything is in the grid's frame. Shapes: `v` vertices, `f` faces, `cell` cells, `point` points of a cell, `x` crossings.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tgdsl.errors import LowerError
from tgdsl.surfaces.meshlab import MAX_HOLE
from tgdsl.surfaces.surface import Surface, hole_caps

COINCIDENT = 1e-7  # distance below which two vertices of a geom are one, over its size
FLAT = 1e-9  # volume below which a geom encloses none, over the cube of its size


def refused(what: str, hint: str = "") -> LowerError:
    """Return the error of a body that has no modal analysis."""
    return LowerError(what, field="modes", hint=hint)


def closed(surface: Surface) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return vertices [m] and faces that wind around the inside of a body, once or more, and not around the outside.

    The triangles that bound a body, repaired so that each point of space is clearly inside or outside.

    A point is inside where the triangles wind around it, once or more. So geoms that overlap are one solid, a component inside
    another one that is wound like it (a screw) is part of it, and one that is wound the other way round is a cavity: that is
    what makes a body thin-walled.

    Repaired, geom by geom: vertices that coincide are one; triangles without area and repeated ones are dropped; neighbours
    that are wound against each other are turned, by connected part, to what most of its area has; a geom that is inside out is
    turned; small holes are closed. A geom with larger holes has no inside, which is an error.

    Shapes: `v` vertices, `f` faces.

    Raises:
        LowerError: If there are no triangles, a coordinate is no number, or a geom is open or flat.
    """
    parts, count = [], 0
    for geom in range(len(surface.geoms)):
        faces = surface.faces[surface.face_geom == geom]
        if len(faces):
            names = [name for name in surface.geoms[geom] if name]
            geom_name = f'geom "{names[0]}"' if names else f"geom {geom}"
            vertices, faces = _closed_geom(surface.vertices, faces, geom_name)
            parts.append((vertices, faces + count))
            count += len(vertices)
    if not parts:
        raise refused("there are no triangles", "a body that rings needs a geom")
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _closed_geom(vertices: np.ndarray, faces: np.ndarray, shown: str) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = _welded(vertices, faces)
    if not np.isfinite(vertices).all():
        raise refused(f"{shown} has a vertex that is no number", "repair the mesh")
    if not len(faces):
        raise refused(f"{shown} has no triangle with an area", "repair the mesh")
    faces = _coherent(vertices, faces)
    area = 0.5 * float(np.asarray(igl.doublearea(vertices, faces)).sum())
    border = _border(vertices, faces)
    if border**2 > MAX_HOLE * area:
        raise refused(
            f"{shown} is open: {1e3 * border:.3g} mm of edges without a second triangle, or with more than two, around "
            f"{1e4 * area:.3g} cm² of surface",
            "close the mesh; a thin wall needs both of its sides",
        )
    vertices, caps = hole_caps(vertices, faces)
    faces = np.concatenate([faces, caps])
    volume, size = enclosed(vertices, faces), float(np.ptp(vertices, axis=0).max())
    if abs(volume) < FLAT * size**3:
        raise refused(f"{shown} encloses no volume", "a thin wall needs both of its sides")
    return vertices, faces if volume > 0 else faces[:, ::-1]


def enclosed(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Return the volume that triangles wind around, counted as often as they do [m³]."""
    a, b, c = (vertices - vertices.mean(axis=0))[faces].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum()) / 6.0


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a geom's welded vertices, and its distinct faces with an area."""
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used] + 0.0, faces.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        return vertices, faces
    near = COINCIDENT * float(np.ptp(vertices, axis=0).max())
    first, second = KDTree(vertices).query_pairs(near, output_type="ndarray").T
    graph = coo_array((np.ones(len(first), bool), (first, second)), (len(vertices),) * 2)
    _, same = connected_components(graph, directed=False)
    _, first = np.unique(same, return_index=True)
    vertices, faces = vertices[first], same[faces].astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return vertices, faces[np.sort(np.unique(turned, axis=0, return_index=True)[1])]


def _directed(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, which = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    return edges, which.reshape(-1), np.where(sides[:, 0] < sides[:, 1], 1, -1)


def _border(vertices: np.ndarray, faces: np.ndarray) -> float:
    edges, which, sense = _directed(faces)
    net = np.abs(np.bincount(which, sense, len(edges)))
    return float((net * np.linalg.norm(np.diff(vertices[edges], axis=1)[:, 0], axis=1)).sum())


def _coherent(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return faces wound alike within each connected part, as most of its area was; as they are if all agree already."""
    edges, which, sense = _directed(faces)
    pairs = np.bincount(which, minlength=len(edges)) == 2
    if not (pairs & (np.bincount(which, sense, len(edges)) != 0)).any():
        return faces
    turned, part = (np.asarray(array).astype(np.int64) for array in igl.bfs_orient(faces))
    signed_area = np.where((turned == faces).all(axis=1), 1.0, -1.0) * np.asarray(igl.doublearea(vertices, faces))
    return np.where((np.bincount(part, signed_area) < 0)[part][:, None], turned[:, ::-1], turned)


FLAT_SHARE = 0.02  # share of a body's area that its faces along one direction have, for the grid to follow them
PLANE_SHARE = 0.004  # share of a body's area that lies on one plane, for the grid to have it
MAX_PLANES = 24  # most such planes across each axis
LEAST_LAYER = 0.1
"""Of planes nearer than this to each other, in cell sizes, those with less than a third of another one's area are left out."""
MERGE_TOLERANCE = 1e-2  # relative difference below which two principal moments are equal; the axes are then the body frame's
ROUNDING = 1e-5  # difference of places along an axis up to which they are one, over the size of the body: meshes are float32


@dataclass(frozen=True, eq=False)
class Planes:
    """The flat parts of a surface that face along an axis."""

    at: Float[np.ndarray, " line"]  # where they are along it, ascending
    area: Float[np.ndarray, " line"]  # area on each


def axes(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the grid's axes, as rows: what most of the area faces along, then most of the rest; else principal axes.

    The grid of cells that a body is cut by: along the body's own flat faces, and on planes where most of these lie.

    So walls between parallel planes get separate layers of cells, however thin they are; elsewhere the body's surface passes
    through the cells (`filled`).

    Shapes: `v` vertices, `f` faces, `line` planes across an axis.
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    area = np.linalg.norm(cross, axis=1)
    cross, corners, area = cross[area > 0], corners[area > 0], area[area > 0]
    normal = cross / area[:, None]
    leading = np.sign(np.take_along_axis(normal, np.abs(normal).argmax(axis=1)[:, None], axis=1))
    normal = normal * leading
    middle = corners.mean(axis=1)
    off = middle - (area[:, None] * middle).sum(axis=0) / area.sum()
    moments = (area[:, None] * off).T @ off
    first = _main(normal, area)
    if first is None:
        first = _principal(moments)
    across = np.abs(normal @ first) < 1e-3
    second = _main(normal[across], area[across], area.sum())
    if second is None:
        flat = np.eye(3) - np.outer(first, first)
        second = _principal(flat @ moments @ flat)
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _main(normal: np.ndarray, area: np.ndarray, whole: float | None = None) -> np.ndarray | None:
    """Return the direction that most area faces along; None if that is too small a share of the whole."""
    if not len(area):
        return None
    rounded, which = np.unique(np.round(normal, 4) + 0.0, axis=0, return_inverse=True)
    share = np.bincount(which.reshape(-1), area, len(rounded)) / (area.sum() if whole is None else whole)
    best = int(np.flatnonzero(share > share.max() - 1e-6)[-1])
    if share[best] < FLAT_SHARE:
        return None
    mine = which.reshape(-1) == best
    mean = (area[mine, None] * normal[mine]).sum(axis=0)
    mean[np.abs(mean) < 1e-9 * np.abs(mean).max()] = 0.0
    return mean / np.linalg.norm(mean)


def _principal(moments: np.ndarray) -> np.ndarray:
    """Return the long principal axis; of several, the nearest one to an axis of the frame."""
    value, vector = np.linalg.eigh(moments)
    long = vector[:, value > (1 - MERGE_TOLERANCE) * value[-1]]
    onto = long @ long.T
    result = onto[int(np.flatnonzero(np.diag(onto) > np.diag(onto).max() - 1e-6)[0])]
    return result / np.linalg.norm(result)


def planes(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], axis: int) -> Planes:
    """Return the planes across an axis that contain most of a surface's area, at most `MAX_PLANES`."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    area = np.linalg.norm(cross, axis=1)
    size = float(np.ptp(vertices, axis=0).max())
    is_flat = (np.ptp(corners[:, :, axis], axis=1) < ROUNDING * size) & (area > 0)
    at, areas = corners[is_flat, :, axis].mean(axis=1), area[is_flat]
    order = np.argsort(at, kind="stable")
    at, areas = at[order], areas[order]
    group = np.cumsum(np.diff(at, prepend=-np.inf) > ROUNDING * size) - 1
    sums = np.bincount(group, areas, group.max(initial=-1) + 1).astype(float)
    middle = np.bincount(group, areas * at, len(sums)) / np.maximum(sums, np.finfo(float).tiny)
    largest = np.sort(np.argsort(-sums, kind="stable")[:MAX_PLANES])
    largest = largest[sums[largest] > PLANE_SHARE * area.sum()]
    return Planes(middle[largest], sums[largest])


def lines(flat: Planes, low: float, high: float, cell: float) -> Float[np.ndarray, " line"]:
    """Return the planes of the grid across an axis, from one end of the body to the other, about a cell apart or nearer."""
    near = ROUNDING * (high - low)
    at = np.where(flat.at < low + near, low, np.where(flat.at > high - near, high, flat.at))
    ends = np.array([end for end in (low, high) if end not in at])
    at, area = np.concatenate([at, ends]), np.concatenate([flat.area, np.zeros(len(ends))])
    area, at = area[np.argsort(at)], np.sort(at)
    is_kept = np.ones(len(at), bool)
    for plane in np.argsort(area[1:-1], kind="stable") + 1:
        is_near = is_kept & (np.abs(at - at[plane]) < LEAST_LAYER * cell)
        is_kept[plane] = not (area[is_near] > 3 * area[plane]).any()
    at = at[is_kept]
    parts = [np.zeros(1) + at[0]]
    for start, end in pairwise(at):
        count = max(1, int(np.ceil((end - start) / cell - 1e-6)))
        parts.append(start + (end - start) * np.arange(1, count + 1) / count)
    return np.concatenate(parts)


POINTS = 5  # Gauss points of a cell along each axis: products of two quadratic shape functions are of degree four
CHUNK = 1 << 21  # pairs of line and triangle that are looked at at once
NUDGE = 1e-9
"""How far into the body a point of the surface is moved to tell which cell it belongs to, over the size of the grid."""
ASIDE = 1e-10  # how far lines of sight are moved, over the size of the grid: far more than rounding, and too little to matter
TOUCHING = 1e-6  # distance between two surfaces up to which they touch, over the size of the body

Lines = tuple[np.ndarray, np.ndarray, np.ndarray]  # planes of the grid across x, y and z


@dataclass(frozen=True, eq=False)
class Filled:
    """The part of a grid that a body fills."""

    index: Int[np.ndarray, "cell 3"]  # place of each cell that holds some of the body along x, y, z
    low: Float[np.ndarray, "cell 3"]  # its lower corner
    size: Float[np.ndarray, "cell 3"]  # its sides
    # of its Gauss points, x outermost and z innermost, over its volume: they sum to the share that is filled
    weight: Float[np.ndarray, "cell point"]

    @property
    def volume(self) -> Float[np.ndarray, " cell"]:
        """Volume of the body in each cell."""
        return self.weight.sum(axis=1) * self.size.prod(axis=1)


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where lines of sight pass through a body's surface."""

    cell: Int[np.ndarray, " x"]  # row in `Filled` of the cell that the point lies in
    pos: Float[np.ndarray, "x 3"]  # the points
    normal: Float[np.ndarray, "x 3"]  # unit normals out of the body
    area: Float[np.ndarray, " x"]  # surface that each stands for


def gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss–Legendre points and weights on [0, 1]."""
    points, weights = np.polynomial.legendre.leggauss(count)
    return (points + 1) / 2, weights / 2


def _lagrange() -> tuple[np.ndarray, np.ndarray]:
    powers = np.vander(gauss(POINTS)[0], increasing=True)
    basis = np.linalg.inv(powers)  # column i: coefficients of the i-th polynomial
    return basis, np.concatenate([np.zeros((1, POINTS)), basis / np.arange(1, POINTS + 1)[:, None]])


_BASIS, _INTEGRAL = _lagrange()


def filled(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], lines: Lines, sight: int, least: float
) -> tuple[Filled, Crossings]:
    """Return what a body fills of a grid, and points of its surface.

    Args:
        vertices: Corners of the triangles, which wind around the inside of the body.
        faces: The triangles.
        lines: The grid.
        sight: Lines of sight through a cell along each axis, at least 3.
        least: Share of a cell below which it is left out, with what it holds of the body.

    Raises:
        LowerError: If a line of sight does not leave the body as often as it enters it.
    """
    views = [_View(vertices, faces, lines, axis, sight) for axis in range(3)]
    trust = np.stack([view.seen for view in views]) ** 2
    trust[:, trust.sum(axis=0) == 0] = 1.0  # a full cell: all directions agree
    trust /= trust.sum(axis=0)
    weight = np.sum([view.weight * share[..., None] for view, share in zip(views, trust, strict=True)], axis=0)
    index = np.argwhere(weight.sum(axis=-1) > least)
    low = np.stack([line[:-1][at] for line, at in zip(lines, index.T, strict=True)], axis=1)
    size = np.stack([np.diff(line)[at] for line, at in zip(lines, index.T, strict=True)], axis=1)
    result = Filled(index, low, size, weight[tuple(index.T)])
    row = np.full(weight.shape[:3], -1)
    row[tuple(index.T)] = np.arange(len(index))
    cell = np.concatenate([row[tuple(view.cell.T)] for view in views])
    pos, normal, area = (np.concatenate([getattr(view, name) for view in views]) for name in ("pos", "normal", "area"))
    return result, Crossings(cell[cell >= 0], pos[cell >= 0], normal[cell >= 0], area[cell >= 0])


class _View:
    """A body as seen along one axis: where lines of sight enter and leave it.

    Attributes:
        weight: Of the points of each cell, "x y z point".
        seen: Area of the surface in each cell, projected along the axis, "x y z".
        cell: Place along x, y, z of the cell inside which each crossing lies.
        pos, normal, area: As in `Crossings`.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, lines: Lines, axis: int, sight: int):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        u_lines, v_lines, w_lines = (lines[i] for i in order)
        self._shape = tuple(len(line) - 1 for line in (u_lines, v_lines, w_lines))
        points, weights = gauss(sight)
        u, v = ((line[:-1, None] + np.diff(line)[:, None] * points).ravel() for line in (u_lines, v_lines))
        ray, w, face, turn = _crossings(vertices[:, order], faces, _aside(u, 0.6180339887498949), _aside(v, 0.7548776662466927))
        i, j = ray // len(v), ray % len(v)
        step = NUDGE * (w_lines[-1] - w_lines[0]) * turn
        k = np.clip(np.searchsorted(w_lines, w + step) - 1, 0, self._shape[2] - 1)
        cell = np.stack([i // sight, j // sight, k])
        within = np.clip((w - w_lines[k]) / np.diff(w_lines)[k], 0.0, 1.0)
        beam = np.outer((np.diff(u_lines)[:, None] * weights).ravel(), (np.diff(v_lines)[:, None] * weights).ravel())[i, j]
        seen = np.bincount(np.ravel_multi_index(tuple(cell), self._shape), beam, int(np.prod(self._shape)))
        back = np.argsort(order)
        self.seen = seen.reshape(self._shape).transpose(back)
        self.weight = self._weights(i, j, k, within, turn, sight).transpose(*back, *(back + 3))
        self.weight = self.weight.reshape(*self.weight.shape[:3], -1)
        self.cell = cell[back].T
        self.pos = np.stack([u[i], v[j], w], axis=1)[:, back]
        cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
        normal = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), np.finfo(float).tiny)
        self.normal = normal[face]
        cosine = self.normal[:, axis]
        # Out of the body: against the line where it enters, along it where it leaves.
        self.normal = self.normal * np.where(cosine * turn > 0, -1.0, 1.0)[:, None]
        self.area = beam * np.abs(cosine)

    def _weights(
        self, i: np.ndarray, j: np.ndarray, k: np.ndarray, within: np.ndarray, turn: np.ndarray, sight: int
    ) -> np.ndarray:
        """Return the weights, "u v w u_point v_point w_point"."""
        num_u, num_v, num_w = self._shape
        points, weights = gauss(sight)
        across = weights[:, None] * (np.vander(points, POINTS, increasing=True) @ _BASIS)  # (line, point)
        shape = (num_u * sight, num_v * sight, num_w)
        place = np.ravel_multi_index((i, j, k), shape)
        total = int(np.prod(shape))
        change = np.bincount(place, turn, total).reshape(shape)
        is_full = np.cumsum(change, axis=2) - change  # cells above a crossing are inside up to the next one
        rest = gauss(POINTS)[1] - np.vander(within, POINTS + 1, increasing=True) @ _INTEGRAL
        along = np.stack([np.bincount(place, turn * part, total) for part in rest.T], axis=-1).reshape(*shape, POINTS)
        along += is_full[..., None] * gauss(POINTS)[1]
        along = along.reshape(num_u, sight, num_v, sight, num_w, POINTS)
        return np.einsum("asbtcw,su,tv->abcuvw", along, across, across, optimize=True)


def _aside(at: np.ndarray, ratio: float) -> np.ndarray:
    return at + ASIDE * (at[-1] - at[0]) * (np.arange(1, len(at) + 1) * ratio % 1.0)


def _crossings(
    vertices: np.ndarray, faces: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return where lines along the third axis enter (turn 1) and leave (−1) a body: line, place along it, face, and turn."""
    flat = vertices[faces]
    first_u, last_u = np.searchsorted(u, flat[:, :, 0].min(axis=1)), np.searchsorted(u, flat[:, :, 0].max(axis=1))
    first_v, last_v = np.searchsorted(v, flat[:, :, 1].min(axis=1)), np.searchsorted(v, flat[:, :, 1].max(axis=1))
    count = (last_u - first_u) * (last_v - first_v)
    chunks: list[tuple[np.ndarray, ...]] = []
    for chunk in np.array_split(np.flatnonzero(count), max(1, int(count.sum()) // CHUNK)):
        face = np.repeat(chunk, count[chunk])
        nth = np.arange(len(face)) - np.repeat(np.cumsum(count[chunk]) - count[chunk], count[chunk])
        width = (last_v - first_v)[face]
        i, j = first_u[face] + nth // width, first_v[face] + nth % width
        sense, depth = _pierced(vertices, faces, face, u[i], v[j])
        hit = sense != 0
        chunks.append((i[hit] * len(v) + j[hit], depth[hit], face[hit], sense[hit]))
    ray, w, face, sense = (np.concatenate(part) for part in zip(*chunks, strict=True))
    order = np.lexsort((face, w, ray))
    ray, w, face, sense = ray[order], w[order], face[order], sense[order]
    winding = np.cumsum(sense)
    ends = np.flatnonzero(np.diff(ray, append=-1))
    if winding[ends].any():
        raise refused("a line through the surface does not leave it as often as it enters it", "repair the mesh")
    # Where geoms touch, a line leaves one and enters the next: between them is nothing.
    size = float(np.ptp(vertices, axis=0).max())
    first = np.flatnonzero((np.diff(ray, prepend=-1) != 0) | (np.diff(w, prepend=-np.inf) > TOUCHING * size))
    last = np.append(first[1:], len(ray)) - 1
    turn = (winding[last] != 0).astype(int) - (winding[first] != sense[first])
    crossing_ids = first[turn != 0]
    return ray[crossing_ids], w[crossing_ids], face[crossing_ids], turn[turn != 0]


def _pierced(
    vertices: np.ndarray, faces: np.ndarray, face: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how faces wind around lines: 1 where the line enters, −1 where it leaves, 0 if it misses; and where."""
    sides, areas = [], []
    for start, end in ((1, 2), (2, 0), (0, 1)):
        a, b = faces[face, start], faces[face, end]
        is_ordered = a < b
        low, high = vertices[np.where(is_ordered, a, b)], vertices[np.where(is_ordered, b, a)]
        area = (high[:, 0] - low[:, 0]) * (v - low[:, 1]) - (high[:, 1] - low[:, 1]) * (u - low[:, 0])
        sides.append((area >= 0) == is_ordered)
        areas.append(np.where(is_ordered, area, -area))
    left = np.stack(sides)
    # Seen along the axis, a face that winds to the left looks along it: there the line leaves.
    sense = np.where(left.all(axis=0), -1, np.where(left.any(axis=0), 0, 1))
    total = areas[0] + areas[1] + areas[2]
    safe = np.where(total == 0, 1.0, total)
    depth = sum(area / safe * vertices[faces[face, corner], 2] for corner, area in enumerate(areas))
    return sense, np.asarray(depth)
