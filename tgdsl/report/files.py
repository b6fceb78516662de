"""Reports as files: CSV, JSON, and HTML that opens without a network: tables, and plots as SVG."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tgdsl.files.write import atomic_write_all, check_writable

SUFFIXES = (".csv", ".json", ".html")
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#2b2f36;max-width:1100px;margin:2em auto;padding:0 1em}
table{border-collapse:collapse;font-size:13px;margin:1em 0;width:100%}
th,td{padding:.25em .6em;text-align:right;border-bottom:1px solid #e3e5e8;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
tr.own td{font-weight:600;color:#c0392b} tr.front td:first-child::before{content:"● ";color:#1f6f8b}
svg{max-width:100%;height:auto} .note{color:#7b828c;font-size:13px} nav a{margin-right:1em}
"""


def check_report_files(folder: Path, stem: str) -> None:
    """Raise `FileError` if one of a report's files cannot be written, before the work that leads to them."""
    for suffix in SUFFIXES:
        check_writable(folder / f"{stem}{suffix}")


def write_report_files(
    folder: Path, stem: str, rows: Sequence[Mapping[str, Any]], document: Mapping[str, Any], page: str
) -> list[Path]:
    """Write the files of a report, all or none, and return them: rows as CSV, without lists; a JSON document; an HTML page."""
    flat = [{key: value for key, value in row.items() if not isinstance(value, list | tuple)} for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in flat for key in row)), restval="")
    writer.writeheader()
    writer.writerows(flat)
    contents = (text.getvalue(), json.dumps(document, indent=1, ensure_ascii=False), page)
    files = [folder / f"{stem}{suffix}" for suffix in SUFFIXES]
    atomic_write_all({file: content.encode() for file, content in zip(files, contents, strict=True)})
    return files


def page_of(
    title: str, about: Sequence[str], links: Iterable[tuple[str, str]], sections: Iterable[str], style: str = ""
) -> str:
    """Return a page: a title, paragraphs and sections in HTML, and links to the sections by their ids."""
    anchors = "".join(f'<a href="#{escape(anchor)}">{escape(name)}</a>' for anchor, name in links)
    head = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>tgdsl: {escape(title)}</title><style>{STYLE}{style}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
    ]
    return "\n".join([*head, *about, f"<nav>{anchors}</nav>", *sections, "</body></html>"])


def table_of(header: Iterable[str], rows: Iterable[Iterable[str]], classes: Iterable[str] = ()) -> str:
    """Return a table of texts; `classes`: the rows' CSS classes, if any."""
    lines = ["<table><tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in header) + "</tr>"]
    names = iter(classes)
    for row in rows:
        name = next(names, "")
        opening = f'<tr class="{name}">' if name else "<tr>"
        lines.append(opening + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return "\n".join([*lines, "</table>"])


def svg_of(figure: Figure, salt: str) -> str:
    """Return a figure as SVG for HTML, the same bytes each time; `salt` makes its identifiers unique among plots."""
    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": salt, "svg.fonttype": "none"}):
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    drawn = text.getvalue()
    drawn = re.sub(r'<g id="[^"]*"', "<g", drawn)  # nothing refers to groups, and their names are the same in all plots
    return re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", drawn[drawn.index("<svg") :]).replace("xlink:href", "href")
