"""Connected parts of a triangle surface, each wound so that its normals point outwards.

Two faces are neighbours where an edge has just these two, as its vertices are numbered in the file or else by their places.
Where more meet, as along the edges of a face that two boxes share, those are neighbours that have a wedge of the solid between
them.

Shapes: `v` and `w` vertices, `f` and `g` faces, `p` parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgdsl.surfaces.holes import hole_caps

FLAT = 1e-9  # volume below which a part encloses none, over the cube of its size
ENCLOSED = 0.9  # winding number of a part from which a point is within it: on its surface it is 1/2, at a notch of it more


@dataclass(frozen=True, eq=False)
class Parts:
    """A surface whose parts are wound outwards and share no vertices."""

    vertices: Float[np.ndarray, "w 3"]  # positions [m]
    faces: Int[np.ndarray, "f 3"]  # vertex indices, counter-clockwise seen from outside
    caps: Int[np.ndarray, "g 3"]  # triangles that close the parts' holes, wound like the faces
    is_orientable: bool  # whether all neighbours could be made to agree. A part whose neighbours cannot is left as it was.


def outward(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], written: Int[np.ndarray, "f 3"]) -> Parts:
    """Return a surface with its parts wound outwards: those within a larger part as it is wound, or opposite, as they were.

    So an inner shell that is wound against the shell around it remains a cavity, if both are inside out too. `faces` are of
    distinct vertices, `written` the same faces as the file has them, where several vertices may be in one place.
    """
    part, is_turned, is_orientable = _coherent(vertices, faces, *_neighbours(vertices, faces, written))
    faces = np.where(is_turned[:, None], faces[:, ::-1], faces)
    num = int(part.max()) + 1
    corner, flat = np.unique(part[:, None] * len(vertices) + faces, return_inverse=True)
    faces, part_of_vertex = flat.reshape(-1, 3), corner // len(vertices)
    vertices, caps = hole_caps(vertices[corner % len(vertices)], faces)
    closed, closed_part = np.concatenate([faces, caps]), np.concatenate([part, part_of_vertex[caps[:, 0]]])
    is_inverted = _inside_out(vertices, closed, closed_part, num)[closed_part]
    closed = np.where(is_inverted[:, None], closed[:, ::-1], closed)
    return Parts(vertices, closed[: len(faces)], closed[len(faces) :], is_orientable)


def _coherent(
    vertices: np.ndarray, faces: np.ndarray, first: np.ndarray, second: np.ndarray, agrees: np.ndarray
) -> tuple[Int[np.ndarray, " f"], Bool[np.ndarray, " f"], bool]:
    """Return each face's part, which faces are wound against most of their part's area, and whether that could be told."""
    num = len(faces)
    # Each face stands there twice, as it is and turned; what agrees is connected.
    start, end = np.tile(first, 2), np.where(np.tile(agrees, 2), np.tile(second, 2), np.tile(second + num, 2))
    start[len(first) :] += num
    end[len(first) :] = np.where(agrees, second + num, second)
    label = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (2 * num,) * 2), directed=False)[1]
    joined = coo_array((np.ones(len(first), bool), (first, second)), (num, num))
    part = connected_components(joined, directed=False)[1]
    root = np.unique(part, return_index=True)[1][part]
    is_turned = label[:num] != label[root]
    area = np.asarray(igl.doublearea(vertices, faces))
    is_turned ^= (np.bincount(part, np.where(is_turned, area, -area)) > 0)[part]
    is_twisted = label[:num] == label[num:]
    return part.astype(np.int64), is_turned & ~is_twisted, not is_twisted.any()


def _neighbours(
    vertices: np.ndarray, faces: np.ndarray, written: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
    """Return pairs of faces that are neighbours, and whether they run along their edge in opposite senses."""
    sides, unpaired, pairs = _sides(faces), np.arange(3 * len(faces)), [np.zeros((0, 2), np.int64)]
    is_forward = sides[:, 0] < sides[:, 1]
    for ends in (_sides(written), sides):
        _, which, count = np.unique(np.sort(ends[unpaired], axis=1), axis=0, return_inverse=True, return_counts=True)
        which = which.reshape(-1)
        order, begin = unpaired[np.argsort(which, kind="stable")], (np.cumsum(count) - count)[count == 2]
        pairs.append(np.stack([order[begin], order[begin + 1]], axis=1))
        unpaired, which = unpaired[count[which] != 2], which[count[which] != 2]
    is_shared = np.bincount(which)[which] > 2 if len(which) else np.zeros(0, bool)
    unpaired, which = unpaired[is_shared], which[is_shared]
    if len(unpaired):
        angle = _angles(vertices, np.sort(sides[unpaired], axis=1), np.roll(faces, 1, axis=1).T.reshape(-1)[unpaired], which)
        # At one angle, what ends a wedge comes before what begins one.
        order = np.lexsort((~is_forward[unpaired], angle, which))
        groups = np.split(unpaired[order], np.flatnonzero(np.diff(which[order])) + 1)
        pairs += [np.array(wedges) for group in groups if (wedges := _wedges(group.tolist(), is_forward))]
    a, b = np.concatenate(pairs).T
    return a % len(faces), b % len(faces), is_forward[a] != is_forward[b]


def _sides(faces: np.ndarray) -> Int[np.ndarray, "n 2"]:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _angles(vertices: np.ndarray, edges: np.ndarray, opposite: np.ndarray, which: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the angle at which faces stand around their edges, from that of the first face of each edge [rad]."""
    low, high = vertices[edges.T]
    along = (high - low) / np.linalg.norm(high - low, axis=1, keepdims=True)
    away = vertices[opposite] - low
    away -= (away * along).sum(axis=1, keepdims=True) * along
    _, first, same = np.unique(which, return_index=True, return_inverse=True)
    zero = away[first][same.reshape(-1)]
    angle = np.arctan2((np.cross(along, zero) * away).sum(axis=1), (zero * away).sum(axis=1))
    return np.round(angle % (2 * np.pi), 6) % np.round(2 * np.pi, 6)


def _wedges(sides: list[int], is_forward: np.ndarray) -> list[tuple[int, int]]:
    """Match the sides of one edge, in the order of their angle, as brackets: the solid is behind a face."""
    result, begun = [], list[int]()
    for side in sides:
        if not is_forward[side]:
            begun.append(side)
        elif begun:
            result.append((begun.pop(), side))
    ended = {side for _, side in result}
    for side in sides:
        if begun and is_forward[side] and side not in ended:
            result.append((begun.pop(), side))
    return result


def _inside_out(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, num: int) -> Bool[np.ndarray, " p"]:
    """Return which closed parts are to be turned, by the sign of the volume of the largest part that each is within."""
    first = np.unique(part, return_index=True)[1]
    corners = vertices[faces] - vertices[faces[first, 0]][part][:, None]
    volume = np.bincount(part, np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])), num) / 6.0
    low, high = np.full((num, 3), np.inf), np.full((num, 3), -np.inf)
    np.minimum.at(low, part, vertices[faces].min(axis=1))
    np.maximum.at(high, part, vertices[faces].max(axis=1))
    is_inverted = volume < -FLAT * np.linalg.norm(high - low, axis=1) ** 3
    if not is_inverted.any() or is_inverted.all():
        return is_inverted
    order = np.argsort(part, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(part, minlength=num))[:-1])
    outermost = np.full(num, -1)
    for container in np.argsort(-np.abs(volume), kind="stable").tolist():
        is_near = (low >= low[container]).all(axis=1) & (high <= high[container]).all(axis=1)
        is_near &= (outermost < 0) & (np.abs(volume) < np.abs(volume[container]))
        near = np.flatnonzero(is_near)
        if len(near):
            tested = np.concatenate([members[i] for i in near])
            pos = np.concatenate([vertices[faces[tested]], vertices[faces[tested]].mean(axis=1, keepdims=True)], axis=1)
            winding = igl.fast_winding_number(vertices, faces[members[container]], pos.reshape(-1, 3))
            is_out = (np.abs(winding).reshape(-1, 4) < ENCLOSED).any(axis=1)
            outermost[near[np.bincount(part[tested], is_out, num)[near] == 0]] = container
    return is_inverted[np.where(outermost < 0, np.arange(num), outermost)]
