"""Names chosen by selections: plain names, shell wildcards and groups of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase

from tgdsl.errors import did_you_mean
from tgdsl.fields import Selection

Report = Callable[[str, str, str], None]
"""Called with the pattern, what is wrong with it, and a hint."""


def matching(pattern: str, names: Sequence[str]) -> list[str]:
    """Return the names that a shell wildcard matches, in order; case counts."""
    return [name for name in names if fnmatchcase(name, pattern)]


def select(
    selection: Selection,
    candidates: Sequence[Sequence[str]],
    groups: Mapping[str, Selection],
    report: Report,
    what: str = "link",
) -> list[int]:
    """Return the candidates that a selection takes, in the candidates' order.

    Args:
        selection: What to include and exclude.
        candidates: The names that each candidate answers to.
        groups: Named selections that may stand in place of names, also within one another.
        report: Called for each pattern of the selection itself that matches nothing (and for groups that contain
            themselves); an `exclude` may match nothing.
        what: What the candidates are, for messages.

    Returns:
        Indices of the chosen candidates, ascending.
    """
    return sorted(_chosen(selection, candidates, groups, report, what, ()))


def _chosen(
    selection: Selection,
    candidates: Sequence[Sequence[str]],
    groups: Mapping[str, Selection],
    report: Report,
    what: str,
    inside: tuple[str, ...],
) -> set[int]:
    def of(pattern: str) -> set[int]:
        if pattern in inside:
            report(pattern, f'group "{pattern}" contains itself', " → ".join([*inside, pattern]))
            return set()
        if pattern in groups:
            return _chosen(groups[pattern], candidates, groups, _silent, what, (*inside, pattern))
        return {i for i, names in enumerate(candidates) if matching(pattern, names)}

    taken: set[int] = set()
    for pattern in selection.include:
        found = of(pattern)
        if not found and pattern not in inside:
            known = [*groups, *(name for names in candidates for name in names)]
            problem = f'group "{pattern}" holds no {what}' if pattern in groups else f'no {what} matches "{pattern}"'
            report(pattern, problem, "" if pattern in groups else did_you_mean(pattern, known, f"{what}s"))
        taken |= found
    for pattern in selection.exclude:
        taken -= of(pattern)
    return taken


def _silent(pattern: str, what: str, hint: str) -> None:
    """Problems inside a group are reported where the group is defined."""
