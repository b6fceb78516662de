"""Where the faces of a triangle surface cross, touch or cover each other, and the cells that they cut each other into.

Shapes: `v` vertices, `f` faces, `n` pairs, `s` segments, `k` corners of a convex cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

LEAF = 32  # faces whose boxes are compared with all near ones at once
CHUNK = 1 << 18  # pairs that are looked at at once
MAX_PAIRS = 20_000_000  # largest number of pairs of faces whose boxes overlap
MAX_SEGMENTS = 200_000  # largest number of segments along which faces are cut
ROUNDING = 1e-3  # distance at which a cell's corner is on a line, over the tolerance


@dataclass(frozen=True, eq=False)
class Crossings:
    """How the faces of a surface meet elsewhere than along their borders."""

    cut: Int[np.ndarray, " s"]  # faces that others cross or touch
    segments: Float[np.ndarray, "s 2 3"]  # along what each is cut [m]
    # faces in a plane with earlier ones, which may cover them and along whose border they are cut
    covered: Int[np.ndarray, " n"]
    cover: Int[np.ndarray, " n"]  # those earlier ones
    is_complete: bool = True  # whether they were all looked at; if they are too many, none is there


def crossings(corners: Float[np.ndarray, "f 3 3"], normal: Float[np.ndarray, "f 3"], tolerance: float) -> Crossings:
    """Return how faces of these corners [m] and unit normals meet, if they do not meet too often.

    Faces touch at a distance of `tolerance` [m].
    """
    edges = np.roll(corners, -1, axis=1) - corners
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    none = np.zeros(0, np.int64)
    skipped = Crossings(none, np.zeros((0, 2, 3)), none, none, is_complete=False)
    pairs = _near_pairs(corners.min(axis=1) - tolerance, corners.max(axis=1) + tolerance)
    if pairs is None:
        return skipped
    cut, segments, covered, cover = [none], [np.zeros((0, 2, 3))], [none], [none]
    for start in range(0, len(pairs), CHUNK):
        i, j = pairs[start : start + CHUNK].T
        of_i, of_j = (_heights(corners[b], normal[b], corners[a], tolerance) for a, b in ((i, j), (j, i)))
        meets = ~((of_j > 0).all(axis=1) | (of_j < 0).all(axis=1) | (of_i > 0).all(axis=1) | (of_i < 0).all(axis=1))
        i, j, of_i, of_j = i[meets], j[meets], of_i[meets], of_j[meets]
        is_flat = ~of_i.any(axis=1) | ~of_j.any(axis=1)
        covered.append(j[is_flat])
        cover.append(i[is_flat])
        border = np.stack([corners[i[is_flat]], np.roll(corners[i[is_flat]], -1, axis=1)], axis=2)
        candidates = [(np.repeat(j[is_flat], 3), border.reshape(-1, 2, 3))]
        for face, other, height in ((i, j, of_j), (j, i, of_i)):
            is_cut, sections = _sections(corners[other[~is_flat]], height[~is_flat])
            candidates.append((face[~is_flat][is_cut], sections))
        for face, sections in candidates:
            inward = np.cross(normal[face][:, None], edges[face])
            depth = np.einsum("nekc,nkc->nek", sections[:, :, None] - corners[face][:, None], inward)
            is_cut, sections = _clipped(sections, depth, tolerance)
            cut.append(face[is_cut])
            segments.append(sections)
        if sum(map(len, cut)) > MAX_SEGMENTS:
            return skipped
    return Crossings(np.concatenate(cut), np.concatenate(segments), np.concatenate(covered), np.concatenate(cover))


def _near_pairs(low: Float[np.ndarray, "f 3"], high: Float[np.ndarray, "f 3"]) -> Int[np.ndarray, "n 2"] | None:
    """Return the pairs of boxes that overlap, the lower index first; None if there are too many."""
    everything = np.arange(len(low))
    result, waiting, count = [np.zeros((0, 2), np.int64)], [(everything, everything)], 0
    while waiting:
        members, near = waiting.pop()
        box_low, box_high = low[members].min(axis=0), high[members].max(axis=0)
        near = near[((low[near] <= box_high) & (high[near] >= box_low)).all(axis=1)]
        if len(members) > LEAF:
            middle = low[members] + high[members]
            members = members[np.argsort(middle[:, np.ptp(middle, axis=0).argmax()], kind="stable")]
            waiting += [(members[: len(members) // 2], near), (members[len(members) // 2 :], near)]
            continue
        meets = members[:, None] < near
        for axis in range(3):
            meets &= (low[members, axis, None] <= high[near, axis]) & (high[members, axis, None] >= low[near, axis])
        a, b = np.nonzero(meets)
        result.append(np.stack([members[a], near[b]], axis=1))
        count += len(a)
        if count > MAX_PAIRS:
            return None
    return np.concatenate(result)


def _heights(base: np.ndarray, normal: np.ndarray, corners: np.ndarray, tolerance: float) -> Float[np.ndarray, "n 3"]:
    height = np.einsum("nki,ni->nk", corners - base[:, :1], normal)
    height[np.abs(height) <= tolerance] = 0.0
    return height


def _sections(corners: Float[np.ndarray, "n 3 3"], height: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return which triangles have a section with a plane that they are so high above, and its two ends [m]."""
    after, onward = np.roll(height, -1, axis=1), np.roll(corners, -1, axis=1)
    crosses = height * after < 0
    part = np.divide(height, height - after, out=np.zeros_like(height), where=crosses)
    ends = np.concatenate([corners, corners + part[:, :, None] * (onward - corners)], axis=1)
    is_end = np.concatenate([height == 0, crosses], axis=1)
    result = np.flatnonzero(is_end.sum(axis=1) == 2)
    return result, ends[result][is_end[result]].reshape(-1, 2, 3)


def cells(
    triangle: Float[np.ndarray, "3 3"], segments: Float[np.ndarray, "s 2 3"], tolerance: float
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the convex cells that the lines through segments in a triangle's plane cut it into, none of them met by a segment.

    Segments along the border of a cell do not count, nor what is nearer to it than the tolerance [m].
    """
    x = triangle[1] - triangle[0]
    x /= np.linalg.norm(x)
    y = triangle[2] - triangle[0]
    y = y - (y @ x) * x
    axes = np.stack([x, y / np.linalg.norm(y)])
    waiting = [((triangle - triangle[0]) @ axes.T, (segments - triangle[0]) @ axes.T)]
    done = []
    while waiting:
        cell, inner = waiting.pop()
        if len(inner):
            edge = _next(cell) - cell
            inward = edge[:, ::-1] * [-1.0, 1.0] / np.sqrt((edge**2).sum(axis=1, keepdims=True))
            inner = _clipped(inner, inner @ inward.T - (cell * inward).sum(axis=1), tolerance)[1]
        if not len(inner):
            done.append(cell @ axes + triangle[0])
            continue
        way = inner[:, 1] - inner[:, 0]
        longest = (way**2).sum(axis=1).argmax()
        side = (cell - inner[longest, 0]) @ (way[longest, ::-1] * [-1.0, 1.0]) / np.sqrt((way[longest] ** 2).sum())
        side[np.abs(side) < ROUNDING * tolerance] = 0.0  # or else cells have sides of no direction
        inner = np.delete(inner, longest, axis=0)
        waiting += [(_half(cell, part), inner) for part in (side, -side)]
    return done


def _clipped(
    segments: Float[np.ndarray, "s 2 d"], depth: Float[np.ndarray, "s 2 k"], tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which segments pass through the interior of convex cells, and their ends there."""
    slope = depth[:, 1] - depth[:, 0]
    at = np.divide(-depth[:, 0], slope, out=np.zeros_like(slope), where=slope != 0)
    begin = np.where(slope > 0, at, 0.0).max(axis=1).clip(0, 1)
    end = np.where(slope < 0, at, 1.0).min(axis=1).clip(0, 1)
    way = segments[:, 1] - segments[:, 0]
    middle = depth[:, 0] + (0.5 * (begin + end))[:, None] * slope
    length = (end - begin) * np.sqrt((way**2).sum(axis=1))
    result = np.flatnonzero((middle.min(axis=1) > tolerance) & (length > tolerance))
    return result, segments[result, :1] + np.stack([begin, end], axis=1)[result, :, None] * way[result, None]


def _next(cell: np.ndarray) -> np.ndarray:
    return np.concatenate([cell[1:], cell[:1]])


def _half(cell: Float[np.ndarray, "k 2"], side: Float[np.ndarray, " k"]) -> np.ndarray:
    """Return the part of a convex cell on one side of a line, its corners being so far on that side of it."""
    after, onward = _next(side), _next(cell)
    crosses = side * after < 0
    part = np.divide(side, side - after, out=np.zeros_like(side), where=crosses)
    both = np.concatenate([cell, cell + part[:, None] * (onward - cell)], axis=1)
    result = both.reshape(-1, 2)[np.column_stack([side >= 0, crosses]).reshape(-1)]
    return result[(result != _next(result)).any(axis=1)]
