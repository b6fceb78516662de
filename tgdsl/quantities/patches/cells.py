"""Boxes that are divided into cells: what is known of them beforehand, in NumPy.

Shapes: `row` boxes, `x`, `y`, `z` cells along the axes, as many as the row with most of them has; `mode` modes along one axis
but for their mean, one less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""Faces of a box, by the axis that they are across, and on which side."""


def tables(
    count: Int[np.ndarray, "row 3"], size: Float[np.ndarray, "row 3"], faces: Sequence[str] = FACES
) -> dict[str, np.ndarray]:
    """Return what a step needs: `count`, `number` and `volume` of cells, `outer` areas; `square`, `smooth`, `cosine` by axis.

    Args:
        count: Cells of each box along each axis.
        size: Its sides [m].
        faces: Its exposed faces.
    """
    found = {"count": count.astype(np.float64), "outer": outer_areas(count, size, faces)}
    found |= {"number": found["count"].prod(axis=1), "volume": (size / count).prod(axis=1)}
    for axis, name in enumerate("xyz"):
        own = count[:, axis]
        k = np.arange(1, int(own.max(initial=1)))[None, :]
        found |= {f"square_{name}": eigenvalues(own), f"cosine_{name}": cosines(own)}
        found[f"smooth_{name}"] = np.where(k < own[:, None], (np.pi * k / own[:, None]) ** 2, 1.0)
    return found


def is_cell(count: Int[np.ndarray, "row 3"]) -> Bool[np.ndarray, "row x y z"]:
    """Return which cells there are, where rows are padded to as many as the one with most."""
    along = [np.arange(count[:, axis].max(initial=1))[None, :] < count[:, axis, None] for axis in range(3)]
    return along[0][:, :, None, None] & along[1][:, None, :, None] & along[2][:, None, None, :]


def outer_areas(
    count: Int[np.ndarray, "row 3"], size: Float[np.ndarray, "row 3"], faces: Sequence[str]
) -> Float[np.ndarray, "row x y z"]:
    """Return the area of each cell that lies on some faces of its box [m²]."""
    there = is_cell(count)
    area = np.zeros(there.shape)
    step = size / count
    for face in faces:
        axis, across = "xyz".index(face[1]), step[:, [a for a in range(3) if a != "xyz".index(face[1])]].prod(axis=1)
        place = np.arange(there.shape[1 + axis])
        at = (place == 0)[None] if face[0] == "-" else place[None] == count[:, axis, None] - 1
        shape = [len(count), 1, 1, 1]
        shape[1 + axis] = -1
        area += np.broadcast_to(at, (len(count), len(place))).reshape(shape) * across[:, None, None, None] * there
    return area


def eigenvalues(count: Int[np.ndarray, " row"]) -> Float[np.ndarray, "row mode"]:
    """Return μ_k = 4 sin²(kπ/2n), k = 1 … n − 1: those of the cosine modes under the second difference of n cells.

    Where a row has fewer cells than another μ is 1.
    """
    k = np.arange(1, int(count.max(initial=1)))[None, :]
    return np.where(k < count[:, None], 4.0 * np.sin(0.5 * np.pi * k / count[:, None]) ** 2, 1.0)


def cosines(count: Int[np.ndarray, " row"]) -> Float[np.ndarray, "row mode cell"]:
    """Return the cosine modes of cells along an axis, orthonormal: mode 0 is their mean; zero where there are no cells."""
    most = int(count.max(initial=1))
    found = np.zeros((len(count), most, most))
    for row, n in enumerate(count.tolist()):
        m, i = np.arange(n)[:, None], np.arange(n)[None, :] + 0.5
        found[row, :n, :n] = np.sqrt(np.where(m == 0, 1.0, 2.0) / n) * np.cos(np.pi * m * i / n)
    return found
