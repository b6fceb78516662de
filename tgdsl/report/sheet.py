"""A sheet of results: entries in sections, as text, CSV, JSON and one HTML file that opens without a network."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tgdsl.console.tables import text_table
from tgdsl.files.write import atomic_write_all, check_writable
from tgdsl.report.bench.page import STYLE, svg_of
from tgdsl.report.defects import DEFECTS, Answer, Defect, answers

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


GRID = """
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(330px,1fr));gap:1em 1.5em}
.card h3{font-size:14px;margin:.6em 0 .2em} .card p{margin:.15em 0;font-size:12.5px;color:#7b828c}
td{white-space:normal} tr.failed td,.failed h3{color:#c0392b}
"""
SIZE = (4.3, 2.7)
"""Of a plot [inch]."""


def sheet_page(sheet: Sheet) -> str:
    """Return the HTML file of a sheet."""
    links = "".join(f'<a href="#{_anchor(section)}">{escape(section.name)}</a>' for section in sheet.sections)
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>tgdsl: {escape(sheet.title)}</title><style>{STYLE}{GRID}</style></head><body>",
        f"<h1>{escape(sheet.title)}</h1><p>{escape(sheet.about)}</p>",
        f'<nav>{links}<a href="#findings">findings</a></nav>',
    ]
    index = 0
    for section in sheet.sections:
        parts.append(_section(sheet, section, index))
        index += len(section.entries)
    return "\n".join([*parts, _findings(sheet), "</body></html>"])


def _anchor(section: Section) -> str:
    return escape("".join(char if char.isalnum() else "-" for char in section.name))


def _section(sheet: Sheet, section: Section, index: int) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in sheet.header)
    rows = [f'<section id="{_anchor(section)}"><h2>{escape(section.name)}</h2><table><tr>{head}</tr>']
    for entry in section.entries:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in (entry.title, *entry.cells))
        rows.append(f"<tr{_failed(entry)}>{cells}</tr>")
    rows.append('</table><div class="cards">')
    rows += [_card(entry, f"{sheet.stem}{index + i}") for i, entry in enumerate(section.entries)]
    rows.append("</div>")
    rows += [f'<p class="note">not to be had: {escape(name)}: {escape(why)}</p>' for name, why in section.left_out]
    return "\n".join([*rows, "</section>"])


def _failed(entry: Entry) -> str:
    return "" if entry.holds else ' class="failed"'


def _card(entry: Entry, salt: str) -> str:
    name = "card" if entry.holds else "card failed"
    notes = "".join(f"<p>{escape(note)}</p>" for note in entry.notes)
    return f'<div class="{name}"><h3>{escape(entry.title)}</h3>{plot(entry, salt)}{notes}</div>'


def plot(entry: Entry, salt: str, size: tuple[float, float] = SIZE) -> str:
    """Return an entry's plot as SVG, to stand in HTML.

    Args:
        entry: The entry.
        salt: What makes the identifiers in it differ from those of other plots.
        size: Its size [inch].
    """
    figure = Figure(figsize=size)
    axes = figure.add_subplot()
    entry.draw(axes)
    axes.tick_params(labelsize=7)
    axes.grid(True, which="major", color="#e3e5e8", linewidth=0.6)
    axes.set_axisbelow(True)
    figure.tight_layout()
    return svg_of(figure, salt)


def _findings(sheet: Sheet) -> str:
    rows = ["<table><tr><th>finding</th><th>there</th><th>answered by</th><th>figure here</th></tr>"]
    for defect, found in _answered(sheet):
        by, figure = (found.title, found.figure) if found else (f"tgdsl bench --{defect.answered_in}", "")
        cells = (f"{defect.number}. {defect.about}", defect.measured, by, figure)
        rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    about = "What was measured on, or read from, the paper's published implementation (Chung et al.), and what answers it here."
    return "\n".join([f'<section id="findings"><h2>Findings</h2><p>{about}</p>', *rows, "</table></section>"])


def _answered(sheet: Sheet) -> list[tuple[Defect, Answer | None]]:
    found = answers((entry.title, entry.figure, entry.defects) for entry in sheet.entries)
    return [(defect, found.get(defect.number)) for defect in DEFECTS]


def sheet_text(sheet: Sheet) -> str:
    """Return a sheet for a terminal."""
    parts = [f"{sheet.title}\n{sheet.about}"]
    for section in sheet.sections:
        table = text_table(("", *sheet.header), [("" if e.holds else "✗", e.title, *e.cells) for e in section.entries])
        lines = [section.name, table, *(f"not to be had: {name}: {why}" for name, why in section.left_out)]
        parts.append("\n".join(lines))
    rows = [
        (f"{d.number}", d.about, found.title if found else f"--{d.answered_in}", found.figure if found else "")
        for d, found in _answered(sheet)
    ]
    parts.append("findings about the paper's implementation\n" + text_table(("", "finding", "answered by", "figure"), rows))
    num = len(sheet.entries)
    parts.append(f"{num} of {num} hold" if not sheet.failed else f"{len(sheet.failed)} of {num} do not hold (✗)")
    return "\n\n".join(parts)


SUFFIXES = (".csv", ".json", ".html")


def check_sheet_files(stem: str, folder: Path) -> None:
    """See that a sheet's files can be written, before the work that leads to them.

    Raises:
        FileError: If one cannot.
    """
    for suffix in SUFFIXES:
        check_writable(folder / f"{stem}{suffix}")


def write_sheet(sheet: Sheet, folder: Path) -> list[Path]:
    """Write the files of a sheet, all or none, and return them.

    Raises:
        FileError: If one cannot be written.
    """
    told = [
        {"section": section.name, "title": entry.title, "holds": entry.holds, "defects": list(entry.defects), **entry.record}
        for section in sheet.sections
        for entry in section.entries
    ]
    rows = [{key: value for key, value in row.items() if not isinstance(value, list | tuple)} for row in told]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), restval="")
    writer.writeheader()
    writer.writerows(rows)
    left_out = [{"section": s.name, "title": name, "why": why} for s in sheet.sections for name, why in s.left_out]
    whole = json.dumps({"title": sheet.title, "entries": told, "left_out": left_out}, indent=1, ensure_ascii=False)
    contents = (text.getvalue(), whole, sheet_page(sheet))
    files = [folder / f"{sheet.stem}{suffix}" for suffix in SUFFIXES]
    atomic_write_all({file: content.encode() for file, content in zip(files, contents, strict=True)})
    return files
