"""The kinds of sources that can be connected to: those of tgdsl, and those that installed packages bring.

A package brings one by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.sources"]
    my_hand = "my_package.my_hand:MY_HAND"
"""

from __future__ import annotations

from tgdsl.files.plugins import known
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
    return known(GROUP, "source", "kinds of sources", SOURCES, (), _wrong)


def _wrong(kind: object) -> str:
    """Return why something is no kind of source, or nothing."""
    return "" if isinstance(kind, SourceKind) else f"found {type(kind).__name__}, expected a {SourceKind.__name__}"
