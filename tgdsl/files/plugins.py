"""What installed packages bring by entry points: kinds, quantities, sources; each by package and name."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from tgdsl.errors import TgdslError

Thing = TypeVar("Thing")
Wrong = Callable[[object], str]  # returns why something is no such thing, or nothing


def known(
    group: str, what: str, argument: str, own: Sequence[Thing], given: Sequence[Thing], wrong: Wrong
) -> tuple[Thing, ...]:
    """Return all things of a sort: those of tgdsl (`own`), of installed packages, and the caller's (`given`).

    An installed one that cannot be had is left out, with a warning, the first time. An installed package may bring some of
    those given, too. `what` is what one is called, "kind", and `argument` that by which a caller gives some, "kinds".

    Raises:
        TgdslError: If two have one name, or one that is given is none: `wrong` says what.
    """
    result: dict[str, tuple[Any, str]] = {}
    of_tgdsl = [(thing, "tgdsl") for thing in own]
    for thing, whence in (*of_tgdsl, *installed(group, what, wrong), *((thing, f"`{argument}`") for thing in given)):
        if reason := wrong(thing):
            raise TgdslError(f"{whence}: {reason}")
        other, first = result.setdefault(thing.name, (thing, whence))  # type: ignore[attr-defined]
        if other is not thing:
            name = thing.name  # type: ignore[attr-defined]
            raise TgdslError(f'two {argument} are called "{name}": one of {first}, one of {whence}; rename or remove one')
    return tuple(thing for thing, _ in result.values())


@cache
def installed(group: str, what: str, wrong: Wrong) -> tuple[tuple[Any, str], ...]:
    """Return what installed packages bring, and which package each is of."""
    results = []
    for point in sorted(entry_points(group=group), key=lambda point: (_package(point), point.name)):
        try:
            thing = point.load()
            reason = wrong(thing)
        except Exception as error:  # whatever another package's code raises
            reason = f"{type(error).__name__}: {error}"
        if reason:
            message = f'the {what} "{point.name}" of {_package(point)} ({point.value}) is left out: {reason}'
            warnings.warn(message, stacklevel=4)
        else:
            results.append((thing, _package(point)))
    return tuple(results)


def _package(point: EntryPoint) -> str:
    return "an unknown package" if point.dist is None else f"{point.dist.name} {point.dist.version}"
