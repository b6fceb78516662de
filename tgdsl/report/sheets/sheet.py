"""What is reported: entries in sections, each with cells for people, a record for files, and what is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes

Draw = Callable[[Axes], None]
"""Draws an entry into axes."""


@dataclass(frozen=True)
class Entry:
    """A result.

    Attributes:
        title: What it is, in a line.
        cells: Its cells of the table, after the title.
        record: The same for CSV and JSON.
        notes: Lines beside the plot.
        draw: Draws its plot.
        holds: Whether it is as it should be.
        defects: Findings about the paper's implementation that it answers, by number.
        figure: The number that answers them, for people.
    """

    title: str
    cells: tuple[str, ...]
    record: Mapping[str, Any]
    notes: tuple[str, ...]
    draw: Draw
    holds: bool
    defects: tuple[int, ...] = ()
    figure: str = ""


@dataclass(frozen=True)
class Section:
    """Entries that belong together.

    Attributes:
        name: Its name.
        entries: What it has.
        left_out: What could not be computed here, and why.
    """

    name: str
    entries: tuple[Entry, ...]
    left_out: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Sheet:
    """A report.

    Attributes:
        stem: Stem of its files' names.
        title: Its title.
        about: What it says, in a paragraph.
        header: Names of the table's columns, the title's first.
        sections: What it has.
    """

    stem: str
    title: str
    about: str
    header: tuple[str, ...]
    sections: tuple[Section, ...]

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries, section by section."""
        return tuple(entry for section in self.sections for entry in section.entries)

    @property
    def failed(self) -> tuple[Entry, ...]:
        """Entries that are not as they should be."""
        return tuple(entry for entry in self.entries if not entry.holds)
