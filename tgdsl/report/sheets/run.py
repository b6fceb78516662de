"""Runs what is reported, group by group."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from tgdsl.errors import TgdslError

Result = TypeVar("Result")
Run = dict[str, tuple[list[Result], list[tuple[str, str]]]]
"""By group all results, and what could not be computed here, and why."""
Begun = Callable[[str, int, int], None]
"""Is told the group, and how many are done of how many."""


def run_groups(groups: Mapping[str, Sequence[Callable[[], Result]]], begun: Begun | None = None) -> Run[Result]:
    """Return by group what functions return, and the names of those that raised `TgdslError`, with what it says.

    Args:
        groups: The functions.
        begun: Is told before each of them, and at the end.
    """
    found: Run[Result] = {}
    total, done = sum(map(len, groups.values())), 0
    for group, works in groups.items():
        results, left_out = found.setdefault(group, ([], []))
        for work in works:
            if begun is not None:
                begun(group, done, total)
            try:
                results.append(work())
            except TgdslError as error:  # such as an extra that is not installed
                left_out.append((getattr(work, "__name__", str(getattr(work, "func", work))), str(error)))
            done += 1
    if begun is not None:
        begun("", total, total)
    return found
