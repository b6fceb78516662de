"""Names chosen by selections: plain names, shell wildcards and groups of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase

from tgdsl.errors import did_you_mean
from tgdsl.fields.models import Selection

Report = Callable[[tuple[str, int], str, str], None]
"""Called with a pattern's place in its selection, such as `("exclude", 1)`, the mistake, and a hint."""


def matching(pattern: str, names: Sequence[str]) -> list[str]:
    """Return the names that a shell wildcard matches, in order; case counts."""
    return [name for name in names if fnmatchcase(name, pattern)]


def is_plain(pattern: str) -> bool:
    """Return whether a pattern is a name, with no shell wildcards."""
    return not any(character in pattern for character in "*?[")


def select(
    selection: Selection,
    candidates: Sequence[Sequence[str]],
    groups: Mapping[str, Selection],
    report: Report,
    group: str | None = None,
    elsewhere: Sequence[str] = (),
) -> list[int]:
    """Return the ascending indices of the selected candidates; each candidate has several names.

    Groups may be used like names, also inside other groups; in its own definition a group's name means the link of that name.
    `report` is called for each pattern that matches nothing, except wildcards and groups in `exclude`: one selection serves
    several robots. A plain name in `exclude` must match a candidate or a name in `elsewhere`. For the selection of a `group`,
    `report` is also called if the group contains itself.
    """
    valid = [*groups, *(name for names in candidates for name in names)]
    for i, pattern in enumerate(selection.include):
        if pattern in groups and not _group(pattern, candidates, groups, ()) and pattern != group:
            if group is None or all(name in groups or _matched(name, candidates) for name in groups[pattern].include):
                report(("include", i), f'group "{pattern}" holds no link', "")
        elif pattern not in groups and not _matched(pattern, candidates):
            report(("include", i), f'no link matches "{pattern}"', did_you_mean(pattern, valid, "links"))
    for i, name in enumerate(selection.exclude):
        if is_plain(name) and name not in valid and name not in elsewhere:
            hint = did_you_mean(name, [*valid, *elsewhere], "links")
            report(("exclude", i), f'no link matches "{name}"', hint)
    if group is not None and (cycle := _cycle(group, group, candidates, groups, ())):
        patterns = {name: (part, i) for part in ("exclude", "include") for i, name in enumerate(getattr(selection, part))}
        report(patterns[cycle[0]], f'group "{group}" contains itself', " → ".join([group, *cycle]))
    return sorted(_selected(selection, candidates, groups, () if group is None else (group,)))


def _selected(
    selection: Selection, candidates: Sequence[Sequence[str]], groups: Mapping[str, Selection], inside: tuple[str, ...]
) -> set[int]:
    def of(patterns: Sequence[str]) -> set[int]:
        def one(pattern: str) -> set[int]:
            is_link = pattern not in groups or (pattern,) == inside[-1:]
            return _matched(pattern, candidates) if is_link else _group(pattern, candidates, groups, inside)

        return set().union(*map(one, patterns))

    return of(selection.include) - of(selection.exclude)


def _group(
    name: str, candidates: Sequence[Sequence[str]], groups: Mapping[str, Selection], inside: tuple[str, ...]
) -> set[int]:
    return set() if name in inside else _selected(groups[name], candidates, groups, (*inside, name))


def _matched(pattern: str, candidates: Sequence[Sequence[str]]) -> set[int]:
    return {i for i, names in enumerate(candidates) if matching(pattern, names)}


def _cycle(
    name: str, end: str, candidates: Sequence[Sequence[str]], groups: Mapping[str, Selection], seen: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the groups that lead from one to another through includes and excludes, the last one too; or nothing."""
    for pattern in (*groups[name].include, *groups[name].exclude):
        if pattern == name and _matched(pattern, candidates):
            continue  # the link that is called so
        if pattern == end:
            return (pattern,)
        is_new = pattern in groups and pattern not in seen
        if is_new and (rest := _cycle(pattern, end, candidates, groups, (*seen, name, pattern))):
            return (pattern, *rest)
    return ()
