"""Boxes that are divided into cells: what is known of them beforehand, in NumPy.

Along an axis the modes of a box are the eigenvectors of the second difference D² of its cells, whose exposed ends lose b of
what the first and the last cell are above the surroundings: M v_k = μ_k v_k, M = diag(b at exposed ends) − D². Insulated, b =
0, they are cosines, v_k = cos((i + ½)kπ/n) with μ_k = 4 sin²(kπ/2n) [1]; those of the continuous solid have (kπ/n)².

Shapes: `row` boxes, `x`, `y`, `z` cells along the axes, as many as the row with most of them has; `mode` modes along one axis,
as many as cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""Faces of a box, by the axis that they are across, and on which side."""


def tables(
    count: Int[np.ndarray, "row 3"],
    size: Float[np.ndarray, "row 3"],
    faces: Sequence[str] = FACES,
    loss: Float[np.ndarray, "row 3"] | None = None,
) -> dict[str, np.ndarray]:
    """Return what a step needs of boxes.

    `count`, `number` and `volume` of cells; by axis `ends`, how many exposed faces across it a cell has, `mode`, the modes,
    their eigenvalues `square`, `smooth` with (kπ/n)² in place of 4 sin²(kπ/2n) in them, and the modes' sums over the cells
    `total`.

    Args:
        count: Cells of each box along each axis.
        size: Its sides [m].
        faces: Its exposed faces.
        loss: b of the exposed faces across each axis [1]; default: they are insulated.
    """
    loss = np.zeros(count.shape) if loss is None else loss
    found = {"count": count.astype(np.float64)}
    found |= {"number": found["count"].prod(axis=1), "volume": (size / count).prod(axis=1)}
    for axis, name in enumerate("xyz"):
        own = exposed_ends(count[:, axis], [face[0] for face in faces if face[1] == name])
        vectors, values = modes(count[:, axis], own * loss[:, axis, None])
        k = np.arange(values.shape[1])[None, :] / count[:, axis, None]
        smooth = np.where(k < 1, values + (np.pi * k) ** 2 - 4.0 * np.sin(0.5 * np.pi * k) ** 2, 0.0)
        sums = vectors.sum(axis=2)
        if not (own * loss[:, axis, None]).any():
            sums[:, 1:] = 0.0  # exactly: what insulated cells hold stays
        found |= {f"ends_{name}": own, f"mode_{name}": vectors}
        found |= {f"square_{name}": values, f"smooth_{name}": smooth, f"total_{name}": sums}
    return found


def is_cell(count: Int[np.ndarray, "row 3"]) -> Bool[np.ndarray, "row x y z"]:
    """Return which cells there are, where rows are padded to as many as the one with most."""
    along = [np.arange(count[:, axis].max(initial=1))[None, :] < count[:, axis, None] for axis in range(3)]
    return along[0][:, :, None, None] & along[1][:, None, :, None] & along[2][:, None, None, :]


def exposed_ends(count: Int[np.ndarray, " row"], sides: Sequence[str]) -> Float[np.ndarray, "row cell"]:
    """Return how many exposed faces cells along an axis have across it, on the sides `-` and `+`."""
    place = np.arange(count.max(initial=1))[None, :]
    first, last = np.broadcast_to(place == 0, (len(count), place.size)), place == count[:, None] - 1
    return np.sum([first if side == "-" else last for side in sides], axis=0, dtype=np.float64) + np.zeros(last.shape)


def outer_areas(
    count: Int[np.ndarray, "row 3"], size: Float[np.ndarray, "row 3"], faces: Sequence[str]
) -> Float[np.ndarray, "row x y z"]:
    """Return the area of each cell that lies on some faces of its box [m²]."""
    there, step = is_cell(count), size / count
    area = np.zeros(there.shape)
    for axis, name in enumerate("xyz"):
        ends = exposed_ends(count[:, axis], [face[0] for face in faces if face[1] == name])
        shape = [len(count), 1, 1, 1]
        shape[1 + axis] = -1
        across = step[:, [a for a in range(3) if a != axis]].prod(axis=1)
        area += ends.reshape(shape) * across[:, None, None, None] * there
    return area


def modes(
    count: Int[np.ndarray, " row"], loss: Float[np.ndarray, "row cell"]
) -> tuple[Float[np.ndarray, "row mode cell"], Float[np.ndarray, "row mode"]]:
    """Return the modes along an axis, orthonormal, the slowest first and positive, and their eigenvalues μ [1].

    Both are 0 where a row has fewer cells than another.

    Args:
        count: Cells of each row.
        loss: What each cell loses at its exposed faces, b of each [1].
    """
    most = int(count.max(initial=1))
    vectors, values = np.zeros((len(count), most, most)), np.zeros((len(count), most))
    for row, n in enumerate(count.tolist()):
        if loss[row, :n].any():
            coupled = np.diff(np.eye(n), axis=0)
            found = np.linalg.eigh(coupled.T @ coupled + np.diag(loss[row, :n]))[1].T
            found *= np.where(found.sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
            # By Rayleigh's quotient, a sum of positive numbers: a small loss keeps its digits.
            values[row, :n] = (np.diff(found, axis=1) ** 2).sum(axis=1) + (loss[row, :n] * found**2).sum(axis=1)
        else:
            m, i = np.arange(n)[:, None], np.arange(n)[None, :] + 0.5
            found = np.sqrt(np.where(m == 0, 1.0, 2.0) / n) * np.cos(np.pi * m * i / n)
            values[row, :n] = 4.0 * np.sin(0.5 * np.pi * np.arange(n) / n) ** 2
        vectors[row, :n, :n] = found
    return vectors, values
