"""Comparisons of each kind with closed forms, as a table and a plot, and all comparisons on one page."""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from tgdsl.commands.report import tests_of_clone
from tgdsl_docs.tables import inline, table

HEADER = ("comparison", "quantity", "largest exact", "error", "of what is allowed", "error of the paper's", "source")
report = tests_of_clone()
MOST = 4
"""Comparisons that a kind's plot shows."""


class Accuracy:
    """All comparisons, computed once per build."""

    def __init__(self) -> None:
        self.fields = {field: comparisons for field, (comparisons, _) in report.run().items()}

    def of(self, kind: str) -> list[Any]:
        """Return a kind's comparisons."""
        return [each for comparisons in self.fields.values() for each in comparisons if kind in each.kinds]

    def section(self, kind: str) -> str:
        """Return the section on accuracy of a kind's page; the plot is `accuracy_<kind>.svg` in the same folder."""
        comparisons = self.of(kind)
        if not comparisons:
            return "Compared with no closed form.\n"
        about = "Computed when these pages were built; [accuracy](../../background/accuracy.md) says how."
        return f"![Exact values, tgdsl and the paper's formula](accuracy_{kind}.svg)\n\n{_table(comparisons)}\n{about}\n"

    def plot(self, kind: str) -> str:
        """Return a kind's plot as an SVG file: its comparisons with most points, those with the paper's first."""
        plotted = sorted(self.of(kind), key=lambda each: (each.paper is None, -each.exact.shape[-1]))[:MOST]
        figure = Figure(figsize=(9.0, 3.1 * -(-len(plotted) // 2)))
        for i, comparison in enumerate(plotted):
            axes = figure.add_subplot(-(-len(plotted) // 2), 2, i + 1)
            report.draw(comparison, axes)
            axes.set_title(comparison.name, fontsize=8)
            axes.tick_params(labelsize=7)
        figure.tight_layout()
        text = io.StringIO()
        with matplotlib.rc_context({"svg.hashsalt": kind, "svg.fonttype": "none"}):
            figure.savefig(text, format="svg", metadata={"Date": None})
        return text.getvalue()

    def page(self) -> str:
        """Return the page of all comparisons and of the findings that they answer."""
        parts = ["# All comparisons\n\n[Accuracy](../background/accuracy.md) explains the columns.\n"]
        for field, comparisons in self.fields.items():
            parts.append(f"## {field[0].upper()}{field[1:]}\n\n{_table(comparisons)}")
        entries = [report.entry_of(each) for comparisons in self.fields.values() for each in comparisons]
        rows = [
            (str(d.number), inline(d.about), d.measured, inline(title or f"`tgdsl bench --{d.answered_in}`"), figure)
            for d, title, figure in importlib.import_module("oracles.sheet").findings(entries)
        ]
        about = "Findings about the paper's published implementation (Chung et al.), and the comparison that answers each here."
        header = ("", "finding", "there", "answered by", "figure here")
        parts.append(f"## Findings\n\n{about}\n\n{table(header, rows)}")
        return "\n".join(parts)


def _table(found: Sequence[Any]) -> str:
    rows = [(inline(entry.title), *map(inline, entry.cells)) for entry in map(report.entry_of, found)]
    return table(HEADER, rows)
