"""All hard cases, and what is reported of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tgdsl.errors import TgdslError
from tgdsl.report.hard import contacts, heat, kinds, probes
from tgdsl.report.hard.results import HEADER, Case, HardCase, entry_of
from tgdsl.report.sheets.sheet import Section, Sheet

GROUPS: Mapping[str, tuple[Case, ...]] = {
    "every kind": kinds.CASES,
    "probes and shapes": probes.CASES,
    "contacts, time and memory": contacts.CASES,
    "heat": heat.CASES,
}
"""The hard cases, by group."""
ABOUT = (
    "What could go wrong numerically, the largest error against an exact value or the kind's float64 definition, what it may "
    "be; not-a-number and infinity count as infinite. Both precisions are given float64 poses, as simulators give them."
)
Found = Mapping[str, tuple[list[HardCase], list[tuple[str, str]]]]


def run(groups: Mapping[str, tuple[Case, ...]] = GROUPS, begun: Callable[[str, int, int], None] | None = None) -> Found:
    """Return by group all hard cases, and what could not be run here, and why.

    Args:
        groups: The cases.
        begun: Is told the group, and how many are done of how many.
    """
    found: dict[str, tuple[list[HardCase], list[tuple[str, str]]]] = {}
    total, done = sum(map(len, groups.values())), 0
    for group, cases in groups.items():
        results, left_out = found.setdefault(group, ([], []))
        for case in cases:
            if begun is not None:
                begun(group, done, total)
            try:
                results.append(case())
            except TgdslError as error:  # such as an extra that is not installed
                left_out.append((getattr(case, "__name__", str(getattr(case, "func", case))), str(error)))
            done += 1
    if begun is not None:
        begun("", total, total)
    return found


def sheet_of(found: Found) -> Sheet:
    """Return what is reported of hard cases, by group."""
    sections = [Section(group, tuple(map(entry_of, results)), tuple(left_out)) for group, (results, left_out) in found.items()]
    return Sheet("hard", "numerical hard cases of tgdsl", ABOUT, HEADER, tuple(sections))
