"""A sheet of results: entries in sections, as text, CSV, JSON and one HTML file that opens without a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from oracles.defects import DEFECTS, Defect
from tgdsl.console.tables import text_table
from tgdsl.report.files import page_of, svg_of, table_of, write_report_files


@dataclass(frozen=True)
class Entry:
    """A result.

    Attributes:
        title: One line.
        cells: Its cells of the table, after the title.
        record: Its values for CSV and JSON.
        notes: Lines next to the plot.
        draw: Draws the plot.
        holds: Whether the result is right.
        defects: Numbers of the findings that it answers.
        figure: The value that answers them.
    """

    title: str
    cells: tuple[str, ...]
    record: Mapping[str, Any]
    notes: tuple[str, ...]
    draw: Callable[[Axes], None]
    holds: bool
    defects: tuple[int, ...] = ()
    figure: str = ""


@dataclass(frozen=True)
class Section:
    """Entries of a section, and names and reasons of those that could not be computed here."""

    name: str
    entries: tuple[Entry, ...]
    left_out: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Sheet:
    """A report; `stem` names its files, `header` the table's columns after the mark, `about` is a paragraph."""

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
        """Entries that are wrong."""
        return tuple(entry for entry in self.entries if not entry.holds)


GRID = """
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(330px,1fr));gap:1em 1.5em}
.card h3{font-size:14px;margin:.6em 0 .2em} .card p{margin:.15em 0;font-size:12.5px;color:#7b828c}
td{white-space:normal} tr.failed td,.failed h3{color:#c0392b}
"""


def sheet_page(sheet: Sheet) -> str:
    """Return the HTML file of a sheet."""
    links = [(_anchor(section), section.name) for section in sheet.sections]
    sections, index = [], 0
    for section in sheet.sections:
        sections.append(_section(sheet, section, index))
        index += len(section.entries)
    about, links = [f"<p>{escape(sheet.about)}</p>"], [*links, ("findings", "findings")]
    return page_of(sheet.title, about, links, [*sections, _findings(sheet)], GRID)


def _anchor(section: Section) -> str:
    return "".join(char if char.isalnum() else "-" for char in section.name)


def _section(sheet: Sheet, section: Section, index: int) -> str:
    rows = [(entry.title, *entry.cells) for entry in section.entries]
    cards = [_card(entry, f"{sheet.stem}{index + i}") for i, entry in enumerate(section.entries)]
    return "\n".join(
        [
            f'<section id="{_anchor(section)}"><h2>{escape(section.name)}</h2>',
            table_of(sheet.header, rows, ["" if entry.holds else "failed" for entry in section.entries]),
            *('<div class="cards">', *cards, "</div>"),
            *(f'<p class="note">not to be had: {escape(name)}: {escape(why)}</p>' for name, why in section.left_out),
            "</section>",
        ]
    )


def _card(entry: Entry, salt: str) -> str:
    name = "card" if entry.holds else "card failed"
    notes = "".join(f"<p>{escape(note)}</p>" for note in entry.notes)
    return f'<div class="{name}"><h3>{escape(entry.title)}</h3>{_plot(entry, salt)}{notes}</div>'


def _plot(entry: Entry, salt: str) -> str:
    figure = Figure(figsize=(4.3, 2.7))
    axes = figure.add_subplot()
    entry.draw(axes)
    axes.tick_params(labelsize=7)
    axes.grid(True, which="major", color="#e3e5e8", linewidth=0.6)
    axes.set_axisbelow(True)
    figure.tight_layout()
    return svg_of(figure, salt)


def _findings(sheet: Sheet) -> str:
    rows = [
        (f"{defect.number}. {defect.about}", defect.measured, title or f"tgdsl bench --{defect.answered_in}", figure)
        for defect, title, figure in findings(sheet.entries)
    ]
    about = "Measurements and settings of the paper's published implementation (Chung et al.), and their counterparts here."
    table = table_of(("finding", "there", "answered by", "figure here"), rows)
    return f'<section id="findings"><h2>Findings</h2><p>{about}</p>\n{table}</section>'


def findings(entries: Iterable[Entry]) -> list[tuple[Defect, str, str]]:
    """Return each finding with title and figure of the first entry that answers it, or empty strings."""
    first: dict[int, tuple[str, str]] = {}
    for entry in entries:
        for number in entry.defects:
            first.setdefault(number, (entry.title, entry.figure))
    return [(defect, *first.get(defect.number, ("", ""))) for defect in DEFECTS]


def sheet_text(sheet: Sheet) -> str:
    """Return a sheet for a terminal."""
    parts = [f"{sheet.title}\n{sheet.about}"]
    for section in sheet.sections:
        table = text_table(("", *sheet.header), [("" if e.holds else "✗", e.title, *e.cells) for e in section.entries])
        lines = [section.name, table, *(f"not to be had: {name}: {why}" for name, why in section.left_out)]
        parts.append("\n".join(lines))
    rows = [(f"{d.number}", d.about, title or f"--{d.answered_in}", figure) for d, title, figure in findings(sheet.entries)]
    parts.append("findings about the paper's implementation\n" + text_table(("", "finding", "answered by", "figure"), rows))
    num = len(sheet.entries)
    parts.append(f"{num} of {num} hold" if not sheet.failed else f"{len(sheet.failed)} of {num} do not hold (✗)")
    return "\n\n".join(parts)


def write_sheet(sheet: Sheet, folder: Path) -> list[Path]:
    """Write the files of a sheet, all or none, and return them.

    Raises:
        FileError: If one cannot be written.
    """
    rows = [
        {"section": section.name, "title": entry.title, "holds": entry.holds, "defects": list(entry.defects), **entry.record}
        for section in sheet.sections
        for entry in section.entries
    ]
    left_out = [{"section": s.name, "title": name, "why": why} for s in sheet.sections for name, why in s.left_out]
    document = {"title": sheet.title, "entries": rows, "left_out": left_out}
    return write_report_files(folder, sheet.stem, rows, document, sheet_page(sheet))
