"""The kinds of sources that can be connected to: those of tgdsl, and those that installed packages bring.

A package brings one by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.sources"]
    my_hand = "my_package.my_hand:MY_HAND"
"""

from __future__ import annotations

import warnings
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from tgdsl.errors import TgdslError
from tgdsl.runtime.batch.connect import SIMULATION
from tgdsl.runtime.source_kind import SourceKind
from tgdsl.runtime.warp.connect import WARP
from tgdsl.runtime.xhand1.connect import XHAND1
from tgdsl.runtime.xhand1.emulator.connect import EMULATOR
from tgdsl.runtime.xhand1.log.connect import LOG

GROUP = "tgdsl.sources"
"""Group of the entry points by which packages bring kinds of sources."""
SOURCES: tuple[SourceKind, ...] = (SIMULATION, EMULATOR, XHAND1, WARP, LOG)
"""The kinds of tgdsl."""


def known_sources() -> tuple[SourceKind, ...]:
    """Return all kinds of sources: those of tgdsl, then those of installed packages by package and name.

    An installed kind that cannot be had is left out, with a warning, the first time.

    Raises:
        TgdslError: If two kinds have one name.
    """
    found: dict[str, tuple[SourceKind, str]] = {}
    for kind, whence in (*((kind, "tgdsl") for kind in SOURCES), *_installed()):
        other, first = found.setdefault(kind.name, (kind, whence))
        if other is not kind:
            what = f'two kinds of sources are called "{kind.name}": one of {first}, one of {whence}'
            raise TgdslError(f"{what}; rename or remove one")
    return tuple(kind for kind, _ in found.values())


@cache
def _installed() -> tuple[tuple[SourceKind, str], ...]:
    """Return the kinds of installed packages, and which package each is of."""
    found = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: (_package(point), point.name)):
        try:
            kind = point.load()
            wrong = "" if isinstance(kind, SourceKind) else f"found {type(kind).__name__}, expected a {SourceKind.__name__}"
        except Exception as error:  # whatever another package's code raises
            kind, wrong = None, f"{type(error).__name__}: {error}"
        if wrong:
            message = f'the source "{point.name}" of {_package(point)} ({point.value}) is left out: {wrong}'
            warnings.warn(message, stacklevel=3)
        else:
            found.append((kind, _package(point)))
    return tuple(found)


def _package(point: EntryPoint) -> str:
    return "an unknown package" if point.dist is None else f"{point.dist.name} {point.dist.version}"
