"""Mode shapes on a grid through a body, interpolated between its nodes: how strongly modes are struck where, and along what.

Displacement is smooth within a body, from one side of a wall to the other too, so eight nodes around a point do, and a
direction says which side it is of. A node outside the body has what the nearest point of its surface has. The spacing is the
first of `ALONG` nodes on the longest side with which the largest of the fields' errors is within `TOLERANCE`, or the finest of
at most `MAX_NODES` nodes. Errors are of the component along the normal, root mean squares over points of the surface that
are no nodes.

Everything is in the grid's axes, and in units of the body's size. Shapes: `node` nodes of the grid, z running fastest, `dof`
unknowns of the elements, `field` fields as `loudness.py` has them, `x` points of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from tgdsl.modal.cells import Crossings, Lines
from tgdsl.modal.elasticity import Elements

ALONG = (9, 17, 25, 33, 49, 65, 97)
"""Nodes on the longest side that are tried."""
MAX_NODES = 6000
"""Most nodes of a grid: 2.3 MB for 32 fields."""
TOLERANCE = 0.01
"""Error of a field, over the root mean square of its group, with which a grid is fine enough."""
TRUSTED = 0.25
"""Share of a cell that is filled above which its displacement is used throughout; of others only on the surface."""
MAX_POINTS = 4000
"""Points of the surface at which the error is measured."""


@dataclass(frozen=True, eq=False)
class ShapeGrid:
    """Fields at the nodes of a grid.

    Attributes:
        low: Place of its first node.
        step: Spacing of the nodes along each axis.
        num: Number of nodes along each axis, two or more.
        value: The fields there, as vectors.
        error: Root mean square of what interpolation is off by along the normal.
    """

    low: Float[np.ndarray, " 3"]
    step: Float[np.ndarray, " 3"]
    num: Int[np.ndarray, " 3"]
    value: Float[np.ndarray, "node 3 field"]
    error: Float[np.ndarray, " field"]


def interpolated(
    low: np.ndarray, step: np.ndarray, num: np.ndarray, value: np.ndarray, pos: Float[np.ndarray, "x 3"]
) -> Float[np.ndarray, "x 3 field"]:
    """Return values between the nodes of a grid, trilinear; outside its box the value at the nearest point of the box."""
    at = np.clip((pos - low) / step, 0.0, num - 1)
    first = np.minimum(at.astype(np.int64), num - 2)
    share = at - first
    result = np.zeros((len(pos), *value.shape[1:]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(np.array(corner), share, 1 - share).prod(axis=1)
        node = np.ravel_multi_index(tuple((first + corner).T), tuple(num))
        result += weight[:, None, None] * value[node]
    return result


def on_grid(elements: Elements, crossings: Crossings, lines: Lines, fields: Float[np.ndarray, "dof field"]) -> ShapeGrid:
    """Return fields on a grid through the box of a body.

    Args:
        elements: The body's.
        crossings: Points of its surface.
        lines: The planes between its cells.
        fields: Values of the elements' unknowns.
    """
    low, high = np.array([line[0] for line in lines]), np.array([line[-1] for line in lines])
    every = slice(None, None, -(-len(crossings.cell) // MAX_POINTS))
    at, normal, area = crossings.pos[every], crossings.normal[every], crossings.area[every]
    exact = np.einsum("xif,xi->xf", elements.displacement(crossings.cell[every], at, fields), normal)
    near, best = KDTree(crossings.pos), None
    for along in ALONG:
        num = np.maximum(np.rint((high - low) / (high - low).max() * (along - 1)).astype(np.int64) + 1, 2)
        if best is not None and num.prod() > MAX_NODES:
            break
        step = (high - low) / (num - 1)
        node = np.stack(np.meshgrid(*(np.arange(count) for count in num), indexing="ij"), axis=-1).reshape(-1, 3)
        value = _at(elements, crossings, near, lines, low + node * step, fields).astype(np.float32)
        off = np.einsum("xif,xi->xf", interpolated(low, step, num, value, at), normal) - exact
        error = np.sqrt(area @ off**2 / area.sum())
        best = ShapeGrid(low, step, num, value, error)
        if (error <= TOLERANCE).all():
            break
    assert best is not None
    return best


def _at(
    elements: Elements, crossings: Crossings, near: KDTree, lines: Lines, pos: Float[np.ndarray, "node 3"], fields: np.ndarray
) -> Float[np.ndarray, "node 3 field"]:
    """Return fields at points: of the elements within the body's cells, elsewhere of the nearest surface point."""
    filled = elements.filled
    row = np.full([len(line) - 1 for line in lines], -1)
    is_trusted = filled.weight.sum(axis=1) > TRUSTED
    row[tuple(filled.index[is_trusted].T)] = np.flatnonzero(is_trusted)
    index = [
        np.clip(np.searchsorted(line, part, side="right") - 1, 0, len(line) - 2)
        for line, part in zip(lines, pos.T, strict=True)
    ]
    cell = row[tuple(index)]
    outside = cell < 0
    _, nearest = near.query(pos[outside])
    cell[outside] = crossings.cell[nearest]
    pos = pos.copy()
    pos[outside] = crossings.pos[nearest]
    return elements.displacement(cell, pos, fields)
