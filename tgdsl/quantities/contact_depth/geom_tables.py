"""The geoms of an object, or of a link, as the Plan holds them: a row per variant, a column per geom."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.compiler.felt import Settled
from tgdsl.compiler.variants import aligned
from tgdsl.surfaces.geom import SurfaceGeom

Placed = tuple[SurfaceGeom, Settled]
Rows = Sequence[Sequence[Placed | None]]


def placed_geoms(
    variants: Sequence[Sequence[SurfaceGeom]], settled: Sequence[Sequence[Settled]]
) -> tuple[tuple[str, ...], list[list[Placed | None]]]:
    """Return how the distance to each geom of an object is found, and the geoms that its variants have there."""
    shapes, tables = aligned([[part.shape for part in variant] for variant in settled])
    parts = [list(zip(*pair, strict=True)) for pair in zip(variants, settled, strict=True)]
    return shapes, [[None if i is None else own[i] for i in table] for own, table in zip(parts, tables, strict=True)]


def is_centred(rows: Rows) -> tuple[bool, ...]:
    """Return for each geom whether its frame is the body's in all variants."""
    return tuple(all(part is None or part[0].geom.is_centred for part in column) for column in zip(*rows, strict=True))


def accuracy(rows: Rows) -> tuple[tuple[dict[str, float], ...], ...]:
    """Return what was measured of each variant's grids."""
    return tuple(tuple({} if part is None else dict(part[1].accuracy) for part in row) for row in rows)


def geom_tables(path: str, rows: Rows) -> dict[str, np.ndarray]:
    """Return the arrays of all geoms, by their paths."""
    arrays = {}
    for key, absent in (("size", np.ones(3)), ("pos", np.zeros(3)), ("rotation", np.eye(3))):
        felt = [[absent if part is None else getattr(part[0].geom, key) for part in row] for row in rows]
        arrays[f"{path}/{key}"] = np.array(felt).reshape(len(rows), len(rows[0]), -1)
    if len(rows) > 1:
        arrays[f"{path}/is_absent"] = np.array([[part is None for part in row] for row in rows])
    for i, column in enumerate(zip(*rows, strict=True)):
        arrays |= {f"{path}/{i}/{key}": value for key, value in _surfaces(column).items()}
    return arrays


def _surfaces(column: Sequence[Placed | None]) -> dict[str, np.ndarray]:
    """Return the arrays of a geom's grids or triangles, variant after variant; one that lacks it has another's."""
    like = next(part[1].arrays for part in column if part is not None)
    owned = [like if part is None else part[1].arrays for part in column]
    if "vertices" in like:
        triangles = {f"{v}/{key}": own[key] for v, own in enumerate(owned) for key in ("vertices", "faces")}
        return {**triangles, "max_distance": like["max_distance"]}
    if "values" not in like:
        return {}
    distinct = list({id(own): own for own in owned}.values())
    place = [next(i for i, own in enumerate(distinct) if own is found) for found in owned]
    starts = np.cumsum([0, *(own["values"].size for own in distinct)])
    return {
        "values": np.concatenate([own["values"].reshape(-1) for own in distinct]),
        "first": starts[place],
        "num": np.array([own["values"].shape for own in owned]),
        "origin": np.array([own["origin"] for own in owned]),
        "cell": np.array([own["cell"] for own in owned]),
    }
