"""Points of a surface on the lines of three fixed lattices: their positions do not depend on the surface's triangles.

Each of the three families of lines runs along one axis of the body frame and has one line in each square of a lattice of some
pitch h that is fixed in space. A line's place in its square is a hash of the seed, the axis and the square's integer
coordinates. A point is the intersection of a line and a face. Two of its coordinates, and its priority, keep their bits for any
order of faces, any numbering of vertices and any triangulation of a flat face. If vertices move by δ, the third coordinate
moves by δ over the cosine of line and normal. No point depends on other points, nor on their number.

Lines count where they meet a face steeply, |n_a| ≥ 0.37 for the unit normal n and the axis a: one family always does, and
the points of a family that grazes a face are inaccurate. A face is met by |n_a| / h² lines of family a per area. A point
stands for the area h² |n_a| / Σ n_b², summed over the families that count: the points' areas add up to the face's.

Shapes: `piece` triangles, `strip` (piece, column of squares) pairs, `pair` (piece, square) pairs, `hit` points.
Everything is in the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.surfaces.rays import expanded

STEPS_PER_OCTAVE = 4  # pitches are powers of 2 to the quarter: a pitch must not follow the last bits of an area
STEEP = 0.37  # least |cosine| of line and normal; no more than 1/√3, and no angle that occurs in drawings
_MARGIN = 1e-9  # share of a pitch: squares that are touched only by rounding are searched too


@dataclass(frozen=True, eq=False)
class Hits:
    """Intersections of lines and faces, ordered by a hash of the line, and along one line by position."""

    pos: Float[np.ndarray, "hit 3"]  # position in the body frame [m]
    piece: Int[np.ndarray, " hit"]  # index of the triangle
    area: Float[np.ndarray, " hit"]  # surface that the point stands for [m²]


def pitch_below(largest: float) -> float:
    """Return the largest pitch of the fixed series that is at most some length [m]."""
    return float(2.0 ** (np.floor(STEPS_PER_OCTAVE * np.log2(largest)) / STEPS_PER_OCTAVE))


def hits(corners: Float[np.ndarray, "piece 3 3"], pitch: float, seed: int) -> Hits:
    """Return where the lines of all three lattices pass through triangles."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(cross, axis=1)
    normal = np.divide(cross, size[:, None], out=np.zeros_like(cross), where=size[:, None] > 0)
    steep = np.where(np.abs(normal) >= STEEP, np.abs(normal), 0.0)
    share = np.divide(steep, (steep**2).sum(axis=1, keepdims=True), out=np.zeros_like(steep), where=steep > 0)
    parts = []
    for axis in range(3):
        met = np.flatnonzero(steep[:, axis])
        pos, piece, priority = _along(axis, corners[met], normal[met], pitch, seed)
        parts.append((pos, met[piece], pitch**2 * share[met[piece], axis], priority))
    pos, piece, area, priority = (np.concatenate([part[i] for part in parts]) for i in range(4))
    order = np.lexsort((*pos.T, priority))
    return Hits(pos[order], piece[order], area[order])


def _along(
    axis: int, corners: Float[np.ndarray, "piece 3 3"], normal: Float[np.ndarray, "piece 3"], pitch: float, seed: int
) -> tuple[Float[np.ndarray, "hit 3"], Int[np.ndarray, " hit"], Float[np.ndarray, " hit"]]:
    """Return position, piece and priority where the lines along one axis hit."""
    across = [(axis + 1) % 3, (axis + 2) % 3]
    flat = corners[:, :, across] / pitch
    piece, square = _squares(flat)
    where = square + np.stack([_uniform(seed, axis, *square.T, stream) for stream in (0, 1)], axis=-1)
    is_hit = _is_inside(flat[piece], where, normal[piece, axis])
    piece, square, where = piece[is_hit], square[is_hit], where[is_hit]
    pos = np.empty((len(piece), 3))
    pos[:, across] = where * pitch
    first, slope = corners[piece, 0], normal[piece]
    rise = ((pos[:, across] - first[:, across]) * slope[:, across]).sum(axis=1)
    pos[:, axis] = first[:, axis] - rise / slope[:, axis]
    return pos, piece, _uniform(seed, axis, *square.T, 2)


def _squares(flat: Float[np.ndarray, "piece 3 2"]) -> tuple[Int[np.ndarray, " pair"], Int[np.ndarray, "pair 2"]]:
    """Return the squares of side 1 that triangles in the plane may touch: column by column, so that slivers touch few."""
    first = np.floor(flat[..., 0].min(axis=1) - _MARGIN).astype(np.int64)
    last = np.floor(flat[..., 0].max(axis=1) + _MARGIN).astype(np.int64)
    piece, step = expanded(last - first + 1)
    column = first[piece] + step
    low, high = np.full(len(piece), np.inf), np.full(len(piece), -np.inf)
    for i in range(3):  # how far each edge reaches within the column
        (u, v), (u_end, v_end) = flat[piece, i].T, flat[piece, (i + 1) % 3].T
        begin, end = np.maximum(np.minimum(u, u_end), column - _MARGIN), np.minimum(np.maximum(u, u_end), column + 1 + _MARGIN)
        is_upright = u == u_end
        run = np.where(is_upright, 1.0, u_end - u)
        one, other = (v + np.clip((border - u) / run, 0.0, 1.0) * (v_end - v) for border in (begin, end))
        one, other = np.where(is_upright, v, one), np.where(is_upright, v_end, other)
        is_there = begin <= end
        low = np.where(is_there, np.minimum(low, np.minimum(one, other)), low)
        high = np.where(is_there, np.maximum(high, np.maximum(one, other)), high)
    is_met = high >= low
    piece, column, low, high = piece[is_met], column[is_met], low[is_met], high[is_met]
    bottom = np.floor(low - _MARGIN).astype(np.int64)
    strip, step = expanded(np.floor(high + _MARGIN).astype(np.int64) - bottom + 1)
    return piece[strip], np.stack([column[strip], bottom[strip] + step], axis=-1)


def _is_inside(
    flat: Float[np.ndarray, "pair 3 2"], where: Float[np.ndarray, "pair 2"], facing: Float[np.ndarray, " pair"]
) -> Bool[np.ndarray, " pair"]:
    """Return which points are in triangles of the plane, counter-clockwise ones where `facing` is positive."""
    is_in = np.ones(len(where), dtype=bool)
    for i in range(3):
        start, end = flat[:, i], flat[:, (i + 1) % 3]
        # The same arithmetic from both sides of an edge, so that just one of its triangles has what lies on it.
        is_turned = (start[:, 0] > end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] > end[:, 1]))
        low, high = np.where(is_turned[:, None], end, start), np.where(is_turned[:, None], start, end)
        along, to = high - low, where - low
        is_left = (along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0] >= 0) != is_turned
        is_in &= is_left == (facing > 0)
    return is_in


def _uniform(*keys: int | Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return numbers in [0, 1) that are a hash of integers: a counter through the mixing function of SplitMix64."""
    # Steele, Lea and Flood, "Fast Splittable Pseudorandom Number Generators", OOPSLA 2014.
    value = np.zeros(1, dtype=np.uint64)
    for key in keys:
        word = np.array([key % 2**64], dtype=np.uint64) if isinstance(key, int) else key.astype(np.uint64)
        value = (value ^ word) + np.uint64(0x9E3779B97F4A7C15)  # these wrap around
        value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        value = value ^ (value >> np.uint64(31))
    return (value >> np.uint64(11)).astype(np.float64) * 2.0**-53
