"""Taxels given by hand: points in the layout, or in a CSV file beside it, of one link or of several.

Shapes: `point` the points of one link.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import SampleError, did_you_mean
from tgdsl.schema.placement import MAX_COUNT, Point, Points

REQUIRED = ("x", "y", "z", "nx", "ny", "nz")
TANGENT = ("tx", "ty", "tz")
CELL = ("row", "column")
OPTIONAL = ("radius", "area", *TANGENT, *CELL, "link")


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points of a link as given, in its body's frame."""

    pos: Float[np.ndarray, "point 3"]  # position [m]
    normal: Float[np.ndarray, "point 3"]  # outward normal, of any length
    tangent: Float[np.ndarray, "point 3"]  # tangent, of any length and across the normal only roughly; NaN where none is given
    radius: Float[np.ndarray, " point"]  # sensing radius [m]
    area: Float[np.ndarray, " point"]  # surface that the point stands for [m²]; NaN where none is given
    cell: Int[np.ndarray, "point 2"]  # row and column in the link's grid; −1 where there is none


def point_table(placement: Points, folder: Path, link: str = "") -> PointTable:
    """Return the points of a link."""
    if isinstance(placement.points, str):
        placed = list(_read(folder, placement.points, link))
    else:
        placed = [(f"points[{i}]", _values(point)) for i, point in enumerate(placement.points)]
    for place, values in placed:
        _check(place, values, placement.radius)
    rows = [values for _, values in placed]
    table = PointTable(
        pos=_columns(rows, REQUIRED[:3]),
        normal=_columns(rows, REQUIRED[3:]),
        tangent=_columns(rows, TANGENT),
        radius=_columns(rows, ("radius",), placement.radius)[:, 0],
        area=_columns(rows, ("area",))[:, 0],
        cell=_columns(rows, CELL, -1.0).astype(np.int64),
    )
    _check_cells([place for place, _ in placed], table.cell)
    return table


def _columns(rows: Sequence[Mapping[str, float]], names: Sequence[str], default: float | None = None) -> np.ndarray:
    default = np.nan if default is None else default
    return np.array([[row.get(name, default) for name in names] for row in rows], dtype=np.float64)


def _values(point: Point) -> dict[str, float]:
    """Return what a point in a layout gives, by the names of a file's columns."""
    values = dict(zip(REQUIRED, (*point.pos, *point.normal), strict=True))
    if point.tangent is not None:
        values |= dict(zip(TANGENT, point.tangent, strict=True))
    others = {"radius": point.radius, "area": point.area, "row": point.row, "column": point.column}
    return values | {name: value for name, value in others.items() if value is not None}


def _read(folder: Path, name: str, link: str) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the place and the numbers of each row of a CSV file that is a link's; empty cells have none."""
    try:
        text = (folder / name).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise SampleError(f"cannot read the points of {name}: {reason}") from error
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    header = [column.strip() for column in reader.fieldnames or ()]
    reader.fieldnames = header
    _check_header(name, header)
    links: dict[str, None] = {}
    for row in reader:
        place = f"{name}:{reader.line_num}"
        if None in row:
            raise SampleError(f"{place}: more values than the header has columns")
        if "link" in header:
            owner = (row.pop("link") or "").strip()
            links[owner] = None
            if owner != link:
                continue
        values = {column: _number(place, column, text) for column, text in row.items() if (text or "").strip()}
        for column in REQUIRED:
            if column not in values:
                raise SampleError(f"{place}: {column} is empty, expected a number")
        yield place, values
    if "link" in header and link not in links:
        raise SampleError(f'{name} has no points of the link "{link}"', did_you_mean(link, links, "links"))
    if "link" not in header and reader.line_num <= 1:
        raise SampleError(f"{name} has no points")


def _check_header(name: str, header: Sequence[str]) -> None:
    """Raise a `SampleError` unless a file's columns are known, each there once, and all that there must be."""
    for i, column in enumerate(header):
        if column not in REQUIRED + OPTIONAL:
            raise SampleError(f'{name}:1: unknown column "{column}"', did_you_mean(column, REQUIRED + OPTIONAL))
        if column in header[:i]:
            raise SampleError(f'{name}:1: column "{column}" is there twice')
    missing = [column for column in REQUIRED if column not in header]
    if missing:
        raise SampleError(f"{name}:1: no column {', '.join(missing)}", f"expected the header {','.join(REQUIRED)}")


def _check(place: str, values: Mapping[str, float], radius: float | None) -> None:
    """Raise a `SampleError` unless a point has a radius and directions, and all of a tangent or a cell if any."""
    if values.get("radius", radius) is None:
        hint = "add a column `radius`, or give one `radius` for the whole file"
        raise SampleError(f"{place}: the point has no radius", hint)
    if not any(values[column] for column in REQUIRED[3:]):
        raise SampleError(f"{place}: normal [0, 0, 0] has no direction", "expected a vector of non-zero length")
    for whole in (TANGENT, CELL):
        given = [column for column in whole if column in values]
        if given and len(given) < len(whole):
            raise SampleError(f"{place}: {', '.join(given)} without the others of {', '.join(whole)}", "give all or none")
    if TANGENT[0] in values:
        normal, tangent = (np.array([values[column] for column in columns]) for columns in (REQUIRED[3:], TANGENT))
        normal, tangent = normal / np.abs(normal).max(), tangent / max(np.abs(tangent).max(), np.finfo(float).tiny)
        if np.linalg.norm(np.cross(normal, tangent)) < 1e-3:
            raise SampleError(f"{place}: the tangent is along the normal", "expected a direction across it")


def _check_cells(places: Sequence[str], cell: Int[np.ndarray, "point 2"]) -> None:
    """Raise a `SampleError` if two points have one cell."""
    first: dict[tuple[int, ...], str] = {}
    for place, (row, column) in zip(places, cell.tolist(), strict=True):
        if min(row, column) >= 0 and (other := first.setdefault((row, column), place)) != place:
            raise SampleError(f"{place}: row {row}, column {column} is that of {other} too", "one point for each cell")


def _number(place: str, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise SampleError(f'{place}: {column} is "{text.strip()}", expected a number')
    if (column == "radius" and value < 0) or (column == "area" and value <= 0):
        bound = "at least 0" if column == "radius" else "more than 0"
        raise SampleError(f"{place}: {column} {value:g} is out of range, expected {bound}")
    if column in CELL and (value != int(value) or not 0 <= value < MAX_COUNT):
        raise SampleError(f'{place}: {column} is "{text.strip()}", expected a whole number from 0 to {MAX_COUNT - 1}')
    return value
