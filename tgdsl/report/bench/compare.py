"""Compare two benches of a document: whether errors are equal, and whether times rank the variants equally.

Times vary from run to run: of two equally fast variants either may be on the front. Two fronts agree if no two variants changed
places: no variant was faster than another with disjoint intervals, and is now slower with disjoint intervals.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

from tgdsl.errors import TgdslError, listed
from tgdsl.module.accuracy.errors import Interval
from tgdsl.report.bench.results import Report, rows_of

Row = Mapping[str, Any]
OF_TIME = ("seconds_", "times_own", "is_on_front", "is_own")
"""Prefixes of columns that may differ from run to run, or with the document."""


class Comparison(NamedTuple):
    """The differences of two benches."""

    only_before: tuple[str, ...]  # variants of the earlier bench only
    only_now: tuple[str, ...]  # variants of the later bench only
    changed: Mapping[str, tuple[str, ...]]  # variants whose errors or counts differ, with each number before and now
    turned: tuple[tuple[str, str], ...]  # pairs of variants whose first was faster, and is slower now
    tied: tuple[str, ...]  # variants on one front only, as fast as the variants that replace them

    def lines(self) -> list[str]:
        """Return the differences as text."""
        lines = [f"only in the earlier bench: {name}" for name in self.only_before]
        lines += [f"not in the earlier bench: {name}" for name in self.only_now]
        lines += [f"{name}: {listed(changes, 4)}" for name, changes in self.changed.items()]
        lines += [f"{one} was faster than {other}, and is slower now" for one, other in self.turned]
        if not self.changed:
            lines.append("errors and counts are as in the earlier bench")
        if not self.turned:
            ties = f", except for ties: {listed(self.tied)}" if self.tied else ""
            lines.append(f"the front is as in the earlier bench{ties}")
        return lines


def read_rows(file: Path) -> list[Row]:
    """Return the rows of a `bench.json`.

    Raises:
        TgdslError: If the file cannot be read, or is none.
    """
    try:
        rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise TypeError("rows of a bench are mappings in a list")
        _by_name(rows)
    except OSError as error:
        raise TgdslError(f"{file}: cannot read this file: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise TgdslError(f"{file}: found no rows of a bench, expected the bench.json of one") from error
    return rows


def compared(report: Report, before: Sequence[Row]) -> Comparison:
    """Return the differences of a bench and an earlier one's rows, for sensors that both measured."""
    return compared_rows(list(rows_of(report)), before)


def compared_rows(now: Sequence[Row], before: Sequence[Row]) -> Comparison:
    """Return the differences of two benches' rows: see `compared`."""
    subjects = {row["subject"] for row in now} & {row["subject"] for row in before}
    new, old = (_by_name([row for row in rows if row["subject"] in subjects]) for rows in (now, before))
    both = [name for name in new if name in old]
    changed = {name: changes for name in both if (changes := _changes(new[name], old[name]))}
    faster = [
        (one, other)
        for one, other in permutations(both, 2)
        if new[one]["subject"] == new[other]["subject"]
        and _is_faster(old[one], old[other])
        and _is_faster(new[other], new[one])
    ]
    moved = {name for pair in faster for name in pair}
    tied = [name for name in both if new[name]["is_on_front"] != old[name]["is_on_front"] and name not in moved]
    only_before, only_now = ([name for name in rows if name not in both] for rows in (old, new))
    return Comparison(tuple(only_before), tuple(only_now), changed, tuple(faster), tuple(tied))


def _by_name(rows: Sequence[Row]) -> dict[str, Row]:
    return {f"{row['subject']}: {row['variant']}, {row['precision']}": row for row in rows}


def _changes(now: Row, before: Row) -> tuple[str, ...]:
    names = [name for name in now if not name.startswith(OF_TIME) and name in before]
    return tuple(f"{name} {_brief(before[name])} → {_brief(now[name])}" for name in names if now[name] != before[name])


def _brief(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _is_faster(one: Row, other: Row) -> bool:
    """Whether a variant is faster, with disjoint intervals, at the largest number of environments timed for both."""
    shared = {name for name in one if name.startswith("seconds_") and name.endswith("_envs")} & set(other)
    if not shared:
        return False
    name = max(shared, key=lambda own: int(own.split("_")[1]))
    mine, its = (Interval(row[name], row[f"{name}_low"], row[f"{name}_high"]) for row in (one, other))
    return mine.value < its.value and not mine.overlaps(its)
