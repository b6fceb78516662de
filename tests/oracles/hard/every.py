"""All hard cases, and what is reported of them."""

from __future__ import annotations

from collections.abc import Mapping

from oracles.hard import contacts, heat, kinds, probes
from oracles.hard.results import HEADER, Case, HardCase, entry_of
from tgdsl.report.sheets.run import Begun, Run, run_groups
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


def run(groups: Mapping[str, tuple[Case, ...]] = GROUPS, begun: Begun | None = None) -> Run[HardCase]:
    """Return by group all hard cases, and what could not be run here, and why: see `sheets.run`."""
    return run_groups(groups, begun)


def sheet_of(found: Run[HardCase]) -> Sheet:
    """Return what is reported of hard cases, by group."""
    sections = [Section(group, tuple(map(entry_of, results)), tuple(left_out)) for group, (results, left_out) in found.items()]
    return Sheet("hard", "numerical hard cases of tgdsl", ABOUT, HEADER, tuple(sections))
