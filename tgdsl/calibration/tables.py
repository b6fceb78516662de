"""Recordings in CSV files, described by a YAML document.

    tgdsl: 1
    states:
      file: states.csv
      time: t                              # a column by its name in the first line, or by its number from 0
      unit: mm
      position: {ball: [x, y, z], pad: [0 m, 0 m, 0 m]}    # columns, or fixed numbers with a unit
      orientation: {ball: [qw, qx, qy, qz]}    # default: the world's axes
    targets:
      load:
        file: scale.csv
        time: 0
        unit: N
        channels: {force_z: 4}             # one column, or a list of one for each row of the reading
        rows: sum                          # the column is the sum of all rows, as of a load cell
        scale: -0.00981                    # from the column to the unit
        invalid: [-1]                      # numbers that stand for a missing reading
        clock_width: 0.5 s

Each body that the module reads needs a position. Empty and `invalid` cells get the weight 0 in targets; in states an empty cell
is an error. A file that starts with numbers has no names.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, StrictInt, Tag

from tgdsl.errors import Problem, SpecError, did_you_mean, listed
from tgdsl.fields.models import TEXT_OR_OTHER, NonNegative, Quantity, SpecModel, Text
from tgdsl.fields.units import UNITS, parse
from tgdsl.schema.load import read_spec
from tgdsl.schema.yaml import Source

Column = Annotated[Text | Annotated[StrictInt, Field(ge=0), Tag("other")], TEXT_OR_OTHER]
Three = tuple[Column, Column, Column]
Four = tuple[Column, Column, Column, Column]


class StatesSpec(SpecModel):
    """Poses of bodies in a CSV file."""

    file: str
    """The file, relative to this one."""
    time: Column
    """Column of the clock [s]."""
    unit: Literal["m", "mm", "cm", "um"]
    """Unit of the positions."""
    position: Annotated[dict[str, Three], Field(min_length=1)]
    """Columns of each body's position, or fixed numbers with a unit."""
    orientation: dict[str, Four] = {}
    """Columns of each body's quaternion, w first."""


class TargetSpec(SpecModel):
    """Readings of a sensor, in a CSV file."""

    file: str
    """The file, relative to this one."""
    time: Column
    """Column of the clock [s]."""
    unit: str
    """Unit of the numbers, once scaled."""
    channels: Annotated[dict[str, Column | Annotated[tuple[Column, ...], Field(min_length=1)]], Field(min_length=1)]
    """Columns of each channel, one for each row of the reading."""
    rows: Literal["each", "sum"] = "each"
    """Whether columns are rows of the reading, or one column the sum of all rows, as of a load cell."""
    scale: float = 1.0
    """Factor from the columns' numbers to the unit."""
    invalid: tuple[float, ...] = ()
    """Numbers that stand for a missing reading."""
    clock_width: Annotated[float, Quantity("time", ge=0.0)] = 0.0
    """Standard deviation of the clock's unknown offset from the states' [s]."""
    floor: NonNegative = 0.0
    """RMS noise, in the unit; 0: unknown."""


class TablesSpec(SpecModel):
    """A recording in CSV files."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    states: StatesSpec
    """Poses of the bodies."""
    targets: Annotated[dict[str, TargetSpec], Field(min_length=1)]
    """Readings of sensors, by name."""


class _Table:
    """A CSV file's numbers, and the mistakes in the columns read so far.

    Attributes:
        path: The file.
        names: Names of the columns; empty if it has none.
        lines: Its lines with the number of each, from 1.
        problems: The mistakes.
    """

    def __init__(self, path: Path):
        self.path, self.names, self.problems = path, list[str](), list[Problem]()
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                reader = csv.reader(file, strict=True)
                self.lines = [(reader.line_num, [cell.strip() for cell in line]) for line in reader if line]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise SpecError([Problem(str(path), 0, 0, "", f"cannot be read as CSV: {error}")]) from error
        if self.lines and len(first := self.lines[0][1]) == 1:
            problem = f'found one column, "{first[0]:.40}"'
            raise SpecError([Problem(str(path), 1, 1, "", problem, "expected commas between columns")])
        if self.lines and any(cell and _number(cell) is None for cell in self.lines[0][1]):
            self.names = self.lines.pop(0)[1]
        if not self.lines:
            raise SpecError([Problem(str(self.path), 1, 1, "", "there is no line of numbers")])
        width = len(self.names or self.lines[0][1])
        for line, cells in self.lines:
            if any(cells[width:]):
                problem = f"found {len(cells)} columns, expected {width}"
                raise SpecError([Problem(str(self.path), line, width + 1, "", problem, "write decimals with a point")])

    def column(self, which: Column, invalid: Sequence[float] | None = None) -> Float[np.ndarray, " line"]:
        """Return a column's numbers; NaN where one is missing or in `invalid`: a mistake if that is None."""
        width = len(self.names or self.lines[0][1])
        if isinstance(which, str) and self.names.count(which) != 1:
            has_hint, numbers = self.names and which not in self.names, f"number them from 0 to {width - 1}"
            hint = did_you_mean(which, self.names, "columns") if has_hint else numbers
            problem = f'column "{which}" stands twice' if which in self.names else f'there is no column "{which}"'
            self.problems.append(Problem(str(self.path), 1, 1, "", problem, hint))
            return np.zeros(len(self.lines))
        place = self.names.index(which) if isinstance(which, str) else which
        if place >= width:
            self.problems.append(Problem(str(self.path), 1, 1, "", f"there is no column {place}", f"there are {width}, from 0"))
            return np.zeros(len(self.lines))
        result = np.full(len(self.lines), np.nan)
        for i, (line, cells) in enumerate(self.lines):
            cell = cells[place] if place < len(cells) else ""
            value = _number(cell) if cell else np.nan
            is_missing = value is None or not np.isfinite(value) or value in (invalid or ())
            if value is None or (is_missing and invalid is None):
                problem = f"column {which}: " + (f'found "{cell}", expected a number' if cell else "this cell is empty")
                self.problems.append(Problem(str(self.path), line, place + 1, "", problem))
                break  # of each column the first
            result[i] = np.nan if is_missing else value
        return result


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def read_tables(path: str | Path) -> dict[str, Any]:
    """Return the recording of a YAML document and its CSV files, with the keys of an `.npz` recording.

    Raises:
        SpecError: All mistakes in the document, or in the files, by line and column.
    """
    path = Path(path)
    spec, source = read_spec(path, TablesSpec, ("tgdsl", "states", "targets"))
    names = dict.fromkeys([spec.states.file, *(target.file for target in spec.targets.values())])
    tables = {name: _Table(path.parent / name) for name in names}
    result = _states(spec.states, tables[spec.states.file], source)
    for name, target in spec.targets.items():
        table = tables[target.file]
        columns = [(c,) if isinstance(c, (int, str)) else c for c in target.channels.values()]
        if len({len(each) for each in columns}) > 1:
            counts = listed([f"{channel}: {len(each)}" for channel, each in zip(target.channels, columns, strict=True)])
            problem = f"expected as many columns each, found {counts}"
            raise SpecError([source.problem(("targets", name, "channels"), problem)])
        numbers = [[table.column(c, target.invalid) for c in each] for each in columns]
        value = target.scale * np.stack([np.stack(each, axis=-1) for each in numbers], axis=-1)
        result |= {
            f"target:{name}": value, f"weight:{name}": np.isfinite(value).astype(np.float64),
            f"clock:{name}": table.column(target.time), f"clock_width:{name}": target.clock_width,
            f"channels:{name}": list(target.channels), f"unit:{name}": target.unit, f"floor:{name}": target.floor,
            f"rows:{name}": target.rows,
        }  # fmt: skip
    if problems := [problem for table in tables.values() for problem in table.problems]:
        raise SpecError(problems)
    return result


def _states(spec: StatesSpec, table: _Table, source: Source) -> dict[str, Any]:
    bodies = list(spec.position)
    pos = np.stack([np.stack([_position(table, c, spec.unit) for c in spec.position[b]], axis=-1) for b in bodies], axis=1)
    quat = np.zeros((*pos.shape[:2], 4))
    quat[..., 0] = 1.0
    for body, columns in spec.orientation.items():
        if body not in bodies:
            raise SpecError([source.problem(("states", "orientation", body), f'"{body}" has an orientation, but no position')])
        quat[:, bodies.index(body)] = np.stack([table.column(c) for c in columns], axis=-1)
    return {"time": table.column(spec.time), "body_pos": pos, "body_quat": quat, "bodies": bodies}


def _position(table: _Table, which: Column, unit: str) -> Float[np.ndarray, " line"]:
    """Return positions [m], of a column or the same at all lines."""
    if isinstance(which, str) and which not in table.names and _number(which) is None:
        with suppress(ValueError):
            return np.full(len(table.lines), parse(which, "length"))
    return UNITS["length"][unit] * table.column(which)
