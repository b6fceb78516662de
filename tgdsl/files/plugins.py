"""Registries of extensions by users and installed packages: kinds, quantities, noise stages, observations, terms, sources."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from itertools import chain
from operator import attrgetter
from typing import Any, Generic, TypeVar

from tgdsl.errors import TgdslError

Thing = TypeVar("Thing")
Wrong = Callable[[object], str]  # returns why something is no such thing, or nothing


class Registry(Generic[Thing]):
    """Extensions of one sort: tgdsl's, then installed packages' by package and name, then registered ones.

    Args:
        group: Group of the packages' entry points.
        what: Singular in messages, "sensor kind".
        plural: Plural in messages, and the argument by which a caller passes some, "kinds".
        own: tgdsl's things.
        wrong: Returns why something is no such thing, or nothing.
        name_of: Returns a thing's name.
    """

    def __init__(
        self,
        group: str,
        what: str,
        plural: str,
        own: Sequence[Thing],
        wrong: Wrong,
        name_of: Callable[[Any], str] = attrgetter("name"),
    ):
        self.group, self.what, self.plural = group, what, plural
        self._own, self._wrong, self._name_of = tuple(own), wrong, name_of
        self.registered: tuple[Thing, ...] = ()

    def register(self, thing: Thing) -> None:
        """Make a thing known to all documents and artefacts that are read from now on.

        Raises:
            TgdslError: If it is no such thing, or another one has its name.
        """
        self._check(thing, "`register`")
        previous, self.registered = self.registered, (*self.registered, thing)
        try:
            self.by_name()
        except TgdslError:
            self.registered = previous
            raise

    def known(self, given: Sequence[Thing] = ()) -> tuple[Thing, ...]:
        """Return all things: tgdsl's, installed packages', registered and given ones.

        An installed one that cannot be imported is left out, with a warning the first time. A thing may be listed repeatedly.

        Raises:
            TgdslError: If two things have one name, or a given one is no such thing.
        """
        return tuple(self.by_name(given).values())

    def by_name(self, given: Sequence[Thing] = ()) -> dict[str, Thing]:
        """Return the things of `known`, by name."""
        result: dict[str, tuple[Any, str]] = {}
        for thing in given:
            self._check(thing, f"`{self.plural}`")
        sources = [((thing, "tgdsl") for thing in self._own), installed(self.group, self.what, self._wrong)]
        sources += [((thing, "`register`") for thing in self.registered), ((thing, f"`{self.plural}`") for thing in given)]
        for thing, source in chain.from_iterable(sources):
            other, first = result.setdefault(name := self._name_of(thing), (thing, source))
            if other is not thing:
                problem = f'two {self.plural} are called "{name}": one of {first}, one of {source}'
                raise TgdslError(f"{problem}; rename or remove one")
        return {name: thing for name, (thing, _) in result.items()}

    def _check(self, thing: Any, source: str) -> None:
        if reason := self._wrong(thing):
            raise TgdslError(f"{source}: {reason}")


@cache
def installed(group: str, what: str, wrong: Wrong) -> tuple[tuple[Any, str], ...]:
    """Return the things of installed packages, each with its package."""
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
