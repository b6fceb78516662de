"""The kinds that a document may use: those of tgdsl, those that installed packages bring, and those that a caller gives.

A package brings a kind by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.kinds"]
    my_kind = "my_package.my_kind:MY_KIND"
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from tgdsl.errors import TgdslError
from tgdsl.sensors import KINDS
from tgdsl.sensors.base import Kind, Lowered

GROUP = "tgdsl.kinds"
"""Group of the entry points by which packages bring kinds."""


def known_kinds(given: Sequence[Kind] = ()) -> tuple[Kind, ...]:
    """Return all kinds: those of tgdsl, of installed packages by package and name, and those that are given.

    An installed kind that cannot be had is left out, with a warning, the first time.

    Args:
        given: Kinds of the caller's own. One that an installed package brings too may be among them.

    Raises:
        TgdslError: If two kinds have one name, or a kind that is given is none.
    """
    found: dict[str, tuple[Kind, str]] = {}
    own = [(kind, "tgdsl") for kind in KINDS]
    for kind, whence in (*own, *_installed(), *((kind, "`kinds`") for kind in given)):
        if wrong := _wrong(kind):
            raise TgdslError(f"{whence}: {wrong}")
        other, first = found.setdefault(kind.name, (kind, whence))
        if other is not kind:
            raise TgdslError(f'two kinds are called "{kind.name}": one of {first}, one of {whence}; rename or remove one')
    return tuple(kind for kind, _ in found.values())


def check_names(kind: Kind, lowered: Lowered) -> None:
    """Refuse a kind whose channels or reports have names that readings need for something else.

    Raises:
        TgdslError: With the kind and the name.
    """
    channels = [*lowered.channels, *(lowered.signal or ()), *(c for report in lowered.reports.values() for c in report)]
    if any(channel.name == "signal" for channel in channels):
        what = 'what `forward` returns as "signal" is all channels in one tensor'
        raise TgdslError(f'kind "{kind.name}" has a channel called "signal"; rename it: {what}')
    for name, what in (("signal", "the reading before its noise"), ("clean", "the reading without noise")):
        if name in lowered.reports:
            raise TgdslError(f'kind "{kind.name}" has a report called "{name}"; rename it: "<sensor>/{name}" is {what}')


@cache
def _installed() -> tuple[tuple[Kind, str], ...]:
    """Return the kinds of installed packages, and which package each is of."""
    found = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: (_package(point), point.name)):
        try:
            kind = point.load()
            wrong = _wrong(kind)
        except Exception as error:  # whatever another package's code raises
            wrong = f"{type(error).__name__}: {error}"
        if wrong:
            message = f'the sensor kind "{point.name}" of {_package(point)} ({point.value}) is left out: {wrong}'
            warnings.warn(message, stacklevel=3)
        else:
            found.append((kind, _package(point)))
    return tuple(found)


def _package(point: EntryPoint) -> str:
    return "an unknown package" if point.dist is None else f"{point.dist.name} {point.dist.version}"


def _wrong(kind: object) -> str:
    """Return why something is no kind that a document can name, or nothing."""
    if not isinstance(kind, Kind):
        return f"found {type(kind).__name__}, expected a tgdsl.sensors.Kind"
    field = kind.spec.model_fields.get("kind")
    names = getattr(field and field.annotation, "__args__", ())
    if len(names) != 1 or not isinstance(names[0], str):
        return f'the spec {kind.spec.__name__} has no field `kind: Literal["its_name"]`'
    return ""
