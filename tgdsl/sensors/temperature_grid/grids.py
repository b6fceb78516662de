"""Boxes of links and their cells: what is known of them beforehand, in NumPy.

Shapes: `row` bodies, `cell` cells of all of them, row after row.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import LowerError
from tgdsl.layout.layout import Layout
from tgdsl.quantities.patches import is_cell
from tgdsl.sensors.base import SurfaceOf
from tgdsl.sensors.temperature_grid.spec import TemperatureGridSpec

MOST = 1_000_000
"""Cells that a sensor has at most, each link counted as if it had as many along each axis as the one with most."""


def boxes(spec: TemperatureGridSpec, layout: Layout, surface_of: SurfaceOf) -> Float[np.ndarray, "row 2 3"]:
    """Return the lowest and highest corner of each link's box in its body's frame [m].

    Raises:
        LowerError: If two links are one body, or a box has no volume.
    """
    if len(layout.bodies) != len(layout.links):
        raise LowerError(
            "two of its links are one body", field="links", hint="name the body, or choose a part of it by `region`"
        )
    results = []
    for link in layout.links:
        surface = surface_of(link.name, spec.region)
        used = surface.vertices[np.unique(surface.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        if not (high - low > 1e-9).all():
            raise LowerError(f'the box of link "{link.name}" has no volume', field="links", hint="a link needs a solid")
        results.append((low, high))
    return np.array(results)


def counts(spec: TemperatureGridSpec, corners: Float[np.ndarray, "row 2 3"]) -> Int[np.ndarray, "row 3"]:
    """Return how many cells each box has along each axis.

    Raises:
        LowerError: If there are more than `MOST`.
    """
    if spec.cells is not None:
        result = np.tile(np.array(spec.cells, dtype=np.int64), (len(corners), 1))
    else:
        assert spec.spacing is not None
        result = np.maximum(1, np.ceil((corners[:, 1] - corners[:, 0]) / spec.spacing - 1e-9).astype(np.int64))
    # Rows are padded to the longest along each axis.
    if (total := len(result) * float(np.prod(result.max(axis=0, initial=1), dtype=np.float64))) > MOST:
        field = "cells" if spec.spacing is None else "spacing"
        raise LowerError(
            f"its links have {total:.3g} cells, expected at most {MOST:,}", field=field, hint="use fewer, larger cells"
        )
    return result


def centres(count: Int[np.ndarray, "row 3"], corners: Float[np.ndarray, "row 2 3"]) -> Float[np.ndarray, "cell 3"]:
    """Return the centres of all cells, row after row, in their bodies' frames [m]."""
    step = (corners[:, 1] - corners[:, 0]) / count
    row, *at = np.nonzero(is_cell(count))
    return corners[row, 0] + (np.stack(at, axis=1) + 0.5) * step[row]
