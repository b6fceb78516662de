"""The sheets of `tgdsl bench --oracles` and `--hard`: all reported comparisons and hard cases."""

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from oracles.comparison import CASES, Case, Comparison
from oracles.hard.case import HARD, HardCase
from oracles.sheet import Entry, Section, Sheet
from tgdsl.errors import TgdslError
from tgdsl.view.style import FAINT, INK

for module in (
    "half_space", "layer", "markers", "friction", "forces", "kinematic", "bodies", "geometry", "proximity", "noise",
    "filters", "heat", "cooling", "sound", "hearing", "modes", "hard.kinds", "hard.probes", "hard.contacts", "hard.heat",
):  # fmt: skip
    import_module(f"oracles.{module}")

OURS, PAPER = "#1f6f8b", "#c0392b"
COLORS = {"float64": OURS, "float32": "#d08a2e"}
FLOOR = 1e-18
"""Errors of hard cases below this are drawn here."""
HEADER = ("comparison", "quantity", "largest exact", "error", "of allowed", "error of the paper's", "source")
ABOUT = (
    "Each quantity as tgdsl computes it, its exact value, and the paper's formula (Chung et al., Tactile Genesis) where it "
    "differs. Errors are absolute, in the quantity's unit, the largest of all points; `of allowed` is the share of what may be "
    "off there, and holds up to 1."
)
HARD_HEADER = ("hard case", "what could go wrong", "worst, float64", "worst, float32", "unit", "finite", "against")
HARD_ABOUT = (
    "What could go wrong numerically, the largest error against an exact value or the kind's float64 definition, what it may "
    "be; not-a-number and infinity count as infinite. Both precisions are given float64 poses, as simulators give them."
)
Results = dict[str, tuple[list[Any], list[tuple[str, str]]]]
"""By section, the results, and names and reasons of cases that cannot be computed here."""
Begun = Callable[[str, int, int], None]
"""Called before each case with its section and the numbers of finished and of all cases; once more at the end."""


def run(cases: Sequence[Case] = CASES, begun: Begun | None = None) -> Results:
    """Compute the reported cases; a `TgdslError`, such as a missing extra, is listed with the case's name."""
    results: Results = {}
    reported = [case for case in cases if case.is_reported]
    for done, case in enumerate(reported):
        if begun is not None:
            begun(case.section, done, len(reported))
        computed, left_out = results.setdefault(case.section, ([], []))
        try:
            computed.append(case.compute())
        except TgdslError as error:
            left_out.append((case.name, str(error)))
    if begun is not None:
        begun("", len(reported), len(reported))
    return results


def sheet(name: str, begun: Begun | None = None) -> Sheet:
    """Compute the sheet `oracles` or `hard`."""
    return sheet_of(name, run(CASES if name == "oracles" else HARD, begun))


def sheet_of(name: str, results: Results) -> Sheet:
    """Return the sheet `oracles` of comparisons, or `hard` of hard cases."""
    entry = entry_of if name == "oracles" else hard_entry_of
    sections = tuple(
        Section(title, tuple(map(entry, computed)), tuple(left_out)) for title, (computed, left_out) in results.items()
    )
    if name == "oracles":
        return Sheet(name, "tgdsl against known results", ABOUT, HEADER, sections)
    return Sheet(name, "numerical hard cases of tgdsl", HARD_ABOUT, HARD_HEADER, sections)


def entry_of(comparison: Comparison) -> Entry:
    """Return a comparison as an entry."""
    c = comparison
    unit = "" if c.unit in ("", "1") else f" {c.unit}"
    paper = "" if c.paper_error is None else f"{c.paper_error:.2g}{unit}"
    cells = (_quantity(c), f"{c.magnitude:.3g}", f"{c.error:.1e}", f"{c.used:.2g}", paper, c.source)
    record = {
        "kinds": " ".join(c.kinds), "quantity": c.quantity, "unit": c.unit, "error": c.error, "of_allowed": c.used,
        "rtol": c.rtol, "atol": c.atol, "paper_error": c.paper_error, "source": c.source, "equation": c.equation,
        "over": list(c.at), "exact": c.exact.tolist(), "ours": c.ours.tolist(),
        "paper": None if c.paper is None else c.paper.tolist(),
    }  # fmt: skip
    figure = f"error {c.error:.1e}{unit}" + (f", the paper's {paper}" if paper else "")
    return Entry(c.name, cells, record, (c.equation, c.source), lambda axes: draw(c, axes), c.holds, c.defects, figure)


def _quantity(comparison: Comparison) -> str:
    return comparison.quantity + ("" if comparison.unit in ("", "1") else f" [{comparison.unit}]")


def draw(comparison: Comparison, axes: Axes) -> None:
    """Draw exact values as lines or bars, ours as dots, the paper's as crosses."""
    exact, ours = np.atleast_2d(comparison.exact), np.atleast_2d(comparison.ours)
    paper = None if comparison.paper is None else np.atleast_2d(comparison.paper)
    is_labelled = isinstance(comparison.at[0], str)
    x = np.arange(exact.shape[1]) if is_labelled else np.array(comparison.at)
    shown = slice(None, None, max(1, len(x) // 60))
    style = {"markersize": 13, "markeredgewidth": 1.6} if is_labelled else {"linewidth": 1.0}
    for i in range(len(exact)):
        axes.plot(x, exact[i], "_" if is_labelled else "-", color=INK, zorder=1, **style)
        axes.plot(x[shown], ours[i][shown], "o", markersize=3.2, color=OURS, zorder=2)
        if paper is not None:
            axes.plot(x[shown], paper[i][shown], "x", markersize=4, color=PAPER, zorder=3)
    names = [("exact", INK, "-"), ("tgdsl", OURS, "o"), *([("paper", PAPER, "x")] if paper is not None else [])]
    for name, color, mark in names:
        axes.plot([], [], mark, color=color, markersize=4, label=name)
    axes.legend(fontsize=6.5, frameon=False, labelcolor=FAINT)
    if is_labelled:
        _label(axes, comparison.at)
    elif comparison.is_log:
        axes.set_xscale("symlog", linthresh=float(np.abs(x[x != 0]).min())) if (x <= 0).any() else axes.set_xscale("log")
    unit = f" [{comparison.label_unit}]" if comparison.label_unit not in ("", "1") else ""
    axes.set_xlabel(f"{comparison.label}{unit}", fontsize=7.5)
    axes.set_ylabel(_quantity(comparison), fontsize=7.5)
    axes.yaxis.offsetText.set_fontsize(6.5)


def _label(axes: Axes, labels: Sequence[Any]) -> None:
    step = max(1, -(-len(labels) // 18))
    axes.set_xticks(range(0, len(labels), step))
    is_long = max(map(len, labels)) * len(labels[::step]) > 40
    axes.set_xticklabels(labels[::step], rotation=50 if is_long else 0, ha="right" if is_long else "center")
    axes.margins(x=0.12)


def hard_entry_of(case: HardCase) -> Entry:
    """Return a hard case as an entry."""
    spans = {name: f"{limit.worst:.1e} ≤ {limit.most:.0e}" for name, limit in case.errors.items()}
    is_finite = "yes" if case.is_finite else "no"
    cells = (case.risk, spans.get("float64", ""), spans.get("float32", ""), case.unit, is_finite, case.reference)
    record: dict[str, Any] = {"risk": case.risk, "reference": case.reference, "unit": case.unit, "finite": case.is_finite}
    for name, limit in case.errors.items():
        record |= {f"{name}_worst": limit.worst, f"{name}_allowed": limit.most, f"{name}_errors": limit.errors.tolist()}
    record["parts"] = list(case.parts)
    figure = ", ".join(f"{name} {limit.worst:.1e} {case.unit}" for name, limit in case.errors.items())
    notes = (case.risk, f"against {case.reference}")
    return Entry(case.name, cells, record, notes, lambda axes: draw_hard(case, axes), case.holds, case.defects, figure)


def draw_hard(case: HardCase, axes: Axes) -> None:
    """Draw the error of each part, and the largest allowed one as a line."""
    x = np.arange(len(case.parts))
    for i, (name, limit) in enumerate(case.errors.items()):
        errors = np.maximum(np.nan_to_num(limit.errors, nan=1e9, posinf=1e9), FLOOR)
        axes.plot(x + 0.15 * i, errors, "o", markersize=4, color=COLORS[name], label=name)
        axes.axhline(max(limit.most, FLOOR), color=COLORS[name], linewidth=0.8, linestyle="--")
    axes.set_yscale("log")
    axes.set_ylabel(f"error [{case.unit}]", fontsize=7.5)
    axes.legend(fontsize=6.5, frameon=False, labelcolor=FAINT)
    step = max(1, -(-len(x) // 20))
    axes.set_xticks(x[::step])
    axes.set_xticklabels(list(case.parts[::step]), rotation=50, ha="right")
    axes.margins(x=0.1, y=0.15)
