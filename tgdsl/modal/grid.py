"""The grid of cells that a body is cut by: along the body's own flat faces, and on planes where most of these lie.

So walls between parallel planes get separate layers of cells, however thin they are; elsewhere the body's surface passes
through the cells (`cells.py`).

Shapes: `v` vertices, `f` faces, `line` planes across an axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

FLAT_SHARE = 0.02
"""Share of a body's area that its faces along one direction have, for the grid to follow them."""
PLANE_SHARE = 0.004
"""Share of a body's area that lies on one plane, for the grid to have it."""
MAX_PLANES = 24
"""Most such planes across each axis."""
LEAST_LAYER = 0.1
"""Of planes nearer than this to each other, in cell sizes, those with less than a third of another one's area are left out."""
MERGE_TOLERANCE = 1e-2
"""Relative difference below which two principal moments are equal; the axes are then the body frame's."""
ROUNDING = 1e-5
"""Difference of places along an axis up to which they are one, over the size of the body: meshes are float32."""


@dataclass(frozen=True, eq=False)
class Planes:
    """The flat parts of a surface that face along an axis.

    Attributes:
        at: Where they are along it, ascending.
        area: Area on each.
    """

    at: Float[np.ndarray, " line"]
    area: Float[np.ndarray, " line"]


def axes(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the grid's axes, as rows: what most of the area faces along, then most of the rest; else principal axes."""
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
