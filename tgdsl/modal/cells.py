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

import numpy as np
from jaxtyping import Float, Int

from tgdsl.modal.closed import refused

POINTS = 5
"""Gauss points of a cell along each axis: products of two quadratic shape functions are of degree four."""
CHUNK = 1 << 21
"""Pairs of line and triangle that are looked at at once."""
NUDGE = 1e-9
"""How far into the body a point of the surface is moved to tell which cell it belongs to, over the size of the grid."""
ASIDE = 1e-10
"""How far lines of sight are moved, over the size of the grid: far more than rounding, and too little to matter."""
TOUCHING = 1e-6
"""Distance between two surfaces up to which they touch, over the size of the body."""

Lines = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Planes of the grid across x, y and z."""


@dataclass(frozen=True, eq=False)
class Filled:
    """The part of a grid that a body fills.

    Attributes:
        index: Place of each cell that holds some of the body along x, y, z.
        low: Its lower corner.
        size: Its sides.
        weight: Of its Gauss points, x outermost and z innermost, over its volume: they sum to the share that is filled.
    """

    index: Int[np.ndarray, "cell 3"]
    low: Float[np.ndarray, "cell 3"]
    size: Float[np.ndarray, "cell 3"]
    weight: Float[np.ndarray, "cell point"]

    @property
    def volume(self) -> Float[np.ndarray, " cell"]:
        """Volume of the body in each cell."""
        return self.weight.sum(axis=1) * self.size.prod(axis=1)


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where lines of sight pass through a body's surface.

    Attributes:
        cell: Row in `Filled` of the cell that the point lies in.
        pos: The points.
        normal: Unit normals out of the body.
        area: Surface that each stands for.
    """

    cell: Int[np.ndarray, " x"]
    pos: Float[np.ndarray, "x 3"]
    normal: Float[np.ndarray, "x 3"]
    area: Float[np.ndarray, " x"]


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
    """Return places of lines, each moved a little: symmetric bodies have edges exactly at symmetric places."""
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
