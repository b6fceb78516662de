"""What is kept of a run of `tgdsl distill`, in docs/measured/ablations/NAME: some hundred kilobytes of tables and curves.

- `distill.json`: who was taught, by whom, and what the run was made from; no local paths
- `table.csv`: as `tgdsl distill` wrote it
- `<resolution>/curve.csv`: at most 60 rows, each of as many control steps: `samples`, control steps of each student by its
  end; `seconds` by then; means of `Score/…` and `Loss/…` of each student, 4 digits; scores without the first episodes of each
  leg, iterations in which some episode of the student ended counting alike
- `<resolution>/evaluation.json`: the evaluation of each student
- `teacher.json`, `rest.json`: evaluations of the teacher and of joints at rest, where given

A run that went on with `--resume` has one curve, that of all its legs.

Shapes: `point` points of a curve.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from jaxtyping import Float

from tgdsl.errors import TgdslError
from tgdsl.rl.sensors import PolicyTouch
from tgdsl.rl.students.keys import NONE, StudentKey
from tgdsl.rl.students.results import Row

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "docs" / "measured" / "ablations"
LIMIT = 300_000
"""Most bytes of an ablation."""
MADE = ("document", "unit", "is_less_better", "teacher", "resolutions", "overrides", "simulations")
"""What is read of what a run was made from."""
Array = np.ndarray


class KeptError(TgdslError):
    """A run that cannot be kept, or results that cannot be read."""


@dataclass(frozen=True)
class Taught:
    """Students that differ in their seeds alone.

    Attributes:
        row: Their row of the table.
        names: Their names, a student per seed.
    """

    row: Row
    names: tuple[str, ...]

    @property
    def where(self) -> tuple[str, str, str]:
        """Placement, resolution and noise; placement and noise are empty of students that feel nothing."""
        return self.row.placement, self.row.resolution, self.row.noise


@dataclass(frozen=True)
class Curves:
    """Curves of the students of one simulation.

    Attributes:
        samples: Control steps of each student by the end of each point.
        score: Score by student, nan where no episode has ended.
    """

    samples: Float[Array, " point"]
    score: Mapping[str, Float[Array, " point"]]


@dataclass(frozen=True)
class Ablation:
    """What is kept of one run.

    Attributes:
        name: Its name.
        made: What it was made from: `distill.json`.
        taught: The students, in the order of the table.
        curves: Their curves by resolution.
        teacher: The evaluation of their teacher; None: not kept.
        rest: That of joints at rest; the same.
    """

    name: str
    made: dict[str, Any]
    taught: tuple[Taught, ...]
    curves: dict[str, Curves]
    teacher: dict[str, Any] | None
    rest: dict[str, Any] | None


def kept_ablations(folder: Path = KEPT) -> list[Ablation]:
    """Return all that is kept, by name.

    Raises:
        KeptError: If something cannot be read.
    """
    return [read_ablation(file.parent) for file in sorted(folder.glob("*/distill.json"))]


def read_ablation(folder: Path) -> Ablation:
    """Return what is kept in a folder.

    Raises:
        KeptError: If it cannot be read.
    """
    made = read_json(folder / "distill.json", "an ablation")
    missing = [name for name in MADE if name not in made]
    if missing:
        raise KeptError(f"{folder / 'distill.json'}: there is no {missing[0]}: this is not what `collect` writes")
    taught = taught_in(read_rows(folder / "table.csv"), made["resolutions"], folder / "table.csv")
    curves = {}
    for resolution in made["resolutions"]:
        file = folder / resolution / "curve.csv"
        rows = read_rows(file)
        names = [name for each in taught if each.row.resolution == resolution for name in each.names]
        curves[resolution] = Curves(
            column(rows, "samples", file), {name: column(rows, f"Score/{name}", file) for name in names}
        )
    teacher, rest = (
        read_json(file, "an evaluation") if file.is_file() else None for file in (folder / "teacher.json", folder / "rest.json")
    )
    return Ablation(folder.name, made, taught, curves, teacher, rest)


def taught_in(rows: Sequence[Mapping[str, str]], resolutions: Sequence[str], file: Path) -> tuple[Taught, ...]:
    """Return the students of a table.

    Raises:
        KeptError: If the table is of other columns, or of other resolutions.
    """
    found = []
    for row in rows:
        if tuple(row) != Row._fields:
            raise KeptError(f"{file}: found the columns {', '.join(map(str, row))}, expected {', '.join(Row._fields)}")
        try:
            own = Row(**{name: kind(row[name]) for name, kind in get_type_hints(Row).items()})
        except ValueError as error:
            raise KeptError(f"{file}: {error}") from error
        if own.resolution not in resolutions:
            raise KeptError(f'{file}: a row of the resolution "{own.resolution}", expected {", ".join(resolutions)}')
        touch = None if own.type == NONE else PolicyTouch(own.type, own.placement, own.noise)
        found.append(Taught(own, tuple(StudentKey(touch, seed).name for seed in range(own.seeds))))
    return tuple(found)


def read_text(file: Path, hint: str = "") -> str:
    """Return a file's text.

    Raises:
        KeptError: If it cannot be read.
    """
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise KeptError(f"{file}: cannot read this file: {error}" + (f"; {hint}" if hint else "")) from error


def read_json(file: Path, what: str) -> dict[str, Any]:
    """Return what a file of JSON holds.

    Raises:
        KeptError: If it cannot be read, or is no mapping.
    """
    try:
        found = json.loads(read_text(file, f"expected {what}"))
    except ValueError as error:
        raise KeptError(f"{file}: this is no JSON: {error}") from error
    if not isinstance(found, dict):
        raise KeptError(f"{file}: found a {type(found).__name__}, expected {what}")
    return found


def read_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file; lines that begin with # are left out.

    Raises:
        KeptError: If it cannot be read, or has no rows.
    """
    lines = [line for line in read_text(file).splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    if not rows:
        raise KeptError(f"{file}: it has no rows")
    return rows


def column(rows: Sequence[Mapping[str, str]], name: str, file: Path) -> Float[Array, " point"]:
    """Return a column's numbers, nan where there is none."""
    if name not in rows[0]:
        raise KeptError(f"{file}: there is no column {name}")
    try:
        return np.array([float(row[name] or "nan") for row in rows])
    except ValueError as error:
        raise KeptError(f"{file}: {name}: {error}") from error
