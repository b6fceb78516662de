"""Taxels given by hand: points in the layout, or in a CSV file beside it."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tgdsl.errors import SampleError, did_you_mean
from tgdsl.schema.placement import Points

_COLUMNS = ("x", "y", "z", "nx", "ny", "nz")
_OPTIONAL = ("radius", "area")


def point_table(placement: Points, folder: Path) -> Float[np.ndarray, "point 8"]:
    """Return x, y, z, nx, ny, nz, radius and area of each point, as given; an area that is not given is NaN.

    Args:
        placement: The points, or their file.
        folder: Where the file is looked up.

    Raises:
        SampleError: If the file cannot be read as points.
    """
    if isinstance(placement.points, str):
        rows = list(_read(folder, placement.points, placement.radius))
        if not rows:
            raise SampleError(f"{placement.points} has no points")
    else:
        rows = [
            (
                *point.pos,
                *point.normal,
                placement.radius if point.radius is None else point.radius,  # the schema sees to it that one is there
                np.nan if point.area is None else point.area,
            )
            for point in placement.points
        ]
    return np.array(rows, dtype=np.float64)


def _read(folder: Path, name: str, default_radius: float | None) -> Iterator[tuple[float, ...]]:
    """Yield x, y, z, nx, ny, nz, radius and area of each row of a CSV file; an area that is not given is NaN."""
    try:
        text = (folder / name).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise SampleError(f"cannot read the points of {name}: {reason}") from error
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    header = [column.strip() for column in reader.fieldnames or ()]
    reader.fieldnames = header
    for column in header:
        if column not in _COLUMNS + _OPTIONAL:
            raise SampleError(f'{name}:1: unknown column "{column}"', did_you_mean(column, _COLUMNS + _OPTIONAL))
    missing = [column for column in _COLUMNS if column not in header]
    if missing:
        raise SampleError(f"{name}:1: no column {', '.join(missing)}", f"expected the header {','.join(_COLUMNS)}")
    for row in reader:
        place = f"{name}:{reader.line_num}"
        if None in row:
            raise SampleError(f"{place}: more values than the header has columns")
        values = {column: _number(place, column, text) for column, text in row.items() if (text or "").strip()}
        radius = values.get("radius", default_radius)
        if radius is None:
            hint = "add a column `radius`, or give one `radius` for the whole file"
            raise SampleError(f"{place}: the point has no radius", hint)
        for column in _COLUMNS:
            if column not in values:
                raise SampleError(f"{place}: {column} is empty, expected a number")
        if not any(values[column] for column in _COLUMNS[3:]):
            raise SampleError(f"{place}: normal [0, 0, 0] has no direction", "expected a vector of non-zero length")
        yield *(values[column] for column in _COLUMNS), radius, values.get("area", np.nan)


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
    return value
