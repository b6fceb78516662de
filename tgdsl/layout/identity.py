"""Whether two tables of taxels are the same within rounding: by a comparison of tables, or of their ids.

A policy knows a taxel only by its row: another order of rows is another input. Tables are the same if they have equally many
rows, on the same links and bodies, in the same cells, at the same places: to within `POSITION` for positions and radii,
`DIRECTION` for normals and tangents, `AREA` for areas. Float32 moves vertices by 1e-8 m; a hand's taxels are at least about
1e-4 m apart.

An id is coarser: it hashes links, rows and cells, lengths rounded to intervals of 1 mm, and components of directions rounded to
intervals of 0.1. It has one half for each of two grids, half an interval apart, and matches if either half matches: a number
that rounding moves across a line of one grid is in the middle of an interval of the other.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped

from tgdsl.errors import TaxelError
from tgdsl.layout.layout import Layout

POSITION = 1e-6  # largest distance of two positions that are the same place, and of two radii [m]
DIRECTION = 1e-4  # largest distance of two unit vectors that are the same direction: an angle [rad]
AREA = 0.05  # largest difference of two areas that are the same, relative to the larger: sampled ones are counted in points
_LENGTH_CELL, _DIRECTION_CELL = 1e-3, 0.1
_SHIFTS = (0.5 * np.sqrt(0.3), 0.5 * np.sqrt(0.3) + 0.5)
"""Offsets of the ids' grids, in cells: round numbers, such as halves of a millimetre, are on no line."""
REQUIRED = ("link", "body", "pos", "normal")
COMPARED = (*REQUIRED, "tangent", "radius", "area", "row", "column")
_TOLERANCES = {"pos": POSITION, "normal": DIRECTION, "tangent": DIRECTION, "radius": POSITION, "area": AREA}

Columns = Mapping[str, np.ndarray]
"""A table of taxels by columns, as `TactileModule.taxels` names them; `REQUIRED` are there, others compared if both tables have
them."""


def taxels_id(layout: Layout) -> str:
    """Return a hash of a layout's rows: names of link and body, place, directions, radius and cell; see `is_same_id`."""
    names = [[link.name, link.body] for link in layout.links]
    return "".join(_grid_digest(layout, json.dumps(names), shift) for shift in _SHIFTS)


def is_same_id(one: str, other: str) -> bool:
    """Return whether two ids may be of the same table, to within rounding."""
    return one[:16] == other[:16] or one[16:] == other[16:]


def _grid_digest(layout: Layout, names: str, shift: float) -> str:
    digest = hashlib.sha256(names.encode())
    lengths, directions = (layout.pos, layout.radius), (layout.normal, layout.tangent)
    numbers = [*(length / _LENGTH_CELL for length in lengths), *(part / _DIRECTION_CELL for part in directions)]
    for array in (layout.link_id, layout.cell, *(np.floor(number + shift) for number in numbers)):
        digest.update(f"{array.shape} ".encode() + array.astype("<i8").tobytes())
    return digest.hexdigest()[:16]


def columns_of(layout: Layout) -> dict[str, np.ndarray]:
    """Return a layout as the columns of a table, a row per taxel."""
    names = np.array([[link.name, link.body] for link in layout.links]).reshape(-1, 2)[layout.link_id]
    row, column = layout.cell.T
    floats = {name: getattr(layout, name) for name in _TOLERANCES}
    return {"link": names[:, 0], "body": names[:, 1], **floats, "row": row, "column": column}


def check_same_rows(here: Columns, there: Columns, what: str) -> None:
    """Refuse a table in use, `here`, if a row differs from the expected table's, `there`.

    Raises:
        TaxelError: How they differ: the number of rows, and the first differing row, here and there.
    """
    num_here, num_there = len(here["pos"]), len(there["pos"])
    num = min(num_here, num_there)
    is_same = _same_rows(here, there, num)
    if num_here == num_there and is_same.all():
        return
    if num_here != num_there:
        text = f"{num_here} taxels here, {num_there} expected"
    else:
        text = f"{int((~is_same).sum())} of {num} rows are other taxels than expected"
        text += ", the same ones in another order" if _places(here) == _places(there) else ""
    if not is_same.all():
        row = int(np.argmin(is_same))
        text += f"; the first is row {row}: {_described(here, there, row)} here, {_described(there, here, row)} expected"
    raise TaxelError(f"{what}: {text}")


def _same_rows(here: Columns, there: Columns, num: int) -> Bool[np.ndarray, " row"]:
    shared = [name for name in COMPARED if name in here and name in there]
    return np.logical_and.reduce([_same(name, here[name][:num], there[name][:num]) for name in shared])


def _same(name: str, here: Shaped[np.ndarray, "row ..."], there: Shaped[np.ndarray, "row ..."]) -> Bool[np.ndarray, " row"]:
    """Return the rows in which a column is the same."""
    if name not in _TOLERANCES:
        return np.asarray(here == there)
    one, other = (np.asarray(values, dtype=np.float64).reshape(len(here), -1) for values in (here, there))
    scale = np.maximum(np.abs(one), np.abs(other))[:, 0] if name == "area" else 1.0
    return np.linalg.norm(one - other, axis=1) <= _TOLERANCES[name] * scale


def _places(table: Columns) -> list[tuple[Any, ...]]:
    rounded = np.round(np.asarray(table["pos"], dtype=np.float64), 4)
    return sorted((str(link), *pos) for link, pos in zip(table["link"], rounded.tolist(), strict=True))


def _described(table: Columns, other: Columns, row: int) -> str:
    """Return a row as text: its link and place, and if these agree with the other table's, the columns that differ."""
    place = ", ".join(f"{1e3 * x:.6g}" for x in table["pos"][row])
    text = f'link "{table["link"][row]}" at [{place}] mm'
    shared = [name for name in COMPARED if name in table and name in other]
    differing = [name for name in shared if not _same(name, table[name][row : row + 1], other[name][row : row + 1])[0]]
    if {"link", "pos"} & set(differing):
        return text
    return text + "".join(f", {name} {_plain(table[name][row])}" for name in differing)


def _plain(value: Any) -> str:
    if np.ndim(value):
        return f"[{', '.join(f'{x:.6g}' for x in value)}]"
    return f"{value:.6g}" if isinstance(value, np.floating) else str(value)
