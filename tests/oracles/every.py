"""All oracles, by field, and what is reported of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from oracles import (
    bodies,
    cooling,
    filters,
    forces,
    friction,
    geometry,
    half_space,
    hearing,
    heat,
    kinematic,
    layer,
    markers,
    modes,
    noise,
    proximity,
    sound,
)
from oracles.results import Comparison, Oracle
from tgdsl.report.sheets.run import Begun, Run, run_groups
from tgdsl.report.sheets.sheet import Entry, Section, Sheet
from tgdsl.view.style import FAINT, INK

FIELDS: Mapping[str, tuple[Oracle, ...]] = {
    "contact mechanics: half-space": half_space.ORACLES,
    "contact mechanics: bonded layer": layer.ORACLES,
    "contact mechanics: markers": markers.ORACLES,
    "contact mechanics: friction": friction.ORACLES,
    "forces: contacts": forces.ORACLES,
    "forces: depth and velocity": kinematic.ORACLES,
    "forces: bodies and bits": bodies.ORACLES,
    "geometry": geometry.ORACLES,
    "proximity": proximity.ORACLES,
    "noise": noise.ORACLES,
    "filters": filters.ORACLES,
    "heat: conduction and contact": heat.ORACLES,
    "heat: losses and lag": cooling.ORACLES,
    "sound: contacts and motors": sound.ORACLES,
    "sound: microphone": hearing.ORACLES,
    "sound: modes of bodies": modes.ORACLES,
}
"""The oracles of each field."""
OURS, PAPER = "#1f6f8b", "#c0392b"
HEADER = ("comparison", "quantity", "largest exact", "error", "of allowed", "error of the paper's", "source")
ABOUT = (
    "Each quantity as tgdsl computes it, its exact value, and the paper's formula (Chung et al., Tactile Genesis) where it "
    "differs. Errors are absolute, in the quantity's unit, the largest of all points; `of allowed` is the share of what may be "
    "off there, and holds up to 1."
)


def run(fields: Mapping[str, tuple[Oracle, ...]] = FIELDS, begun: Begun | None = None) -> Run[Comparison]:
    """Return by field all comparisons, and what could not be computed here, and why: see `sheets.run`."""
    return run_groups(fields, begun)


def sheet_of(found: Run[Comparison]) -> Sheet:
    """Return what is reported of comparisons, by field."""
    sections = [
        Section(field, tuple(map(entry_of, comparisons)), tuple(left_out)) for field, (comparisons, left_out) in found.items()
    ]
    return Sheet("oracles", "tgdsl against what is known", ABOUT, HEADER, tuple(sections))


def entry_of(found: Comparison) -> Entry:
    """Return a comparison as an entry."""
    unit = "" if found.unit in ("", "1") else f" {found.unit}"
    paper = "" if found.paper_error is None else f"{found.paper_error:.2g}{unit}"
    cells = (
        f"{found.quantity}{f' [{found.unit}]' if unit else ''}",
        f"{found.magnitude:.3g}",
        f"{found.error:.1e}",
        f"{found.used:.2g}",
        paper,
        found.source,
    )
    record = {
        "kinds": " ".join(found.kinds),
        "quantity": found.quantity,
        "unit": found.unit,
        "error": found.error,
        "of_allowed": found.used,
        "rtol": found.rtol,
        "atol": found.atol,
        "paper_error": found.paper_error,
        "source": found.source,
        "equation": found.equation,
        "over": list(found.over.values),
        "exact": found.exact.tolist(),
        "ours": found.ours.tolist(),
        "paper": None if found.paper is None else found.paper.tolist(),
    }
    notes = (found.equation, found.source)
    figure = f"error {found.error:.1e}{unit}" + (f", the paper's {paper}" if paper else "")
    return Entry(found.name, cells, record, notes, lambda axes: draw(found, axes), found.holds, found.defects, figure)


def draw(found: Comparison, axes: Axes) -> None:
    """Draw exact values as lines or bars' ends, ours as dots, the paper's as crosses."""
    exact, ours = np.atleast_2d(found.exact), np.atleast_2d(found.ours)
    paper = None if found.paper is None else np.atleast_2d(found.paper)
    numbers = found.over.numbers
    x = np.arange(exact.shape[1]) if numbers is None else numbers
    shown = slice(None, None, max(1, len(x) // 60))
    for i in range(len(exact)):
        line = {"color": INK, "linewidth": 1.0, "zorder": 1}
        if numbers is None:
            axes.plot(x, exact[i], "_", markersize=13, markeredgewidth=1.6, color=INK, zorder=1)
        else:
            axes.plot(x, exact[i], **line)
        axes.plot(x[shown], ours[i][shown], "o", markersize=3.2, color=OURS, zorder=2)
        if paper is not None:
            axes.plot(x[shown], paper[i][shown], "x", markersize=4, color=PAPER, zorder=3)
    names = [("exact", INK, "-"), ("tgdsl", OURS, "o"), *([("paper", PAPER, "x")] if paper is not None else [])]
    for name, color, mark in names:
        axes.plot([], [], mark, color=color, markersize=4, label=name)
    axes.legend(fontsize=6.5, frameon=False, labelcolor=FAINT)
    if numbers is None:
        _label(axes, found.over.values)
    elif found.over.is_log:
        axes.set_xscale("symlog", linthresh=float(np.abs(x[x != 0]).min())) if (x <= 0).any() else axes.set_xscale("log")
    unit = f" [{found.over.unit}]" if found.over.unit not in ("", "1") else ""
    axes.set_xlabel(f"{found.over.label}{unit}", fontsize=7.5)
    axes.set_ylabel(f"{found.quantity}{f' [{found.unit}]' if found.unit not in ('', '1') else ''}", fontsize=7.5)
    axes.yaxis.offsetText.set_fontsize(6.5)


def _label(axes: Axes, labels: tuple[object, ...]) -> None:
    step = max(1, -(-len(labels) // 18))
    axes.set_xticks(range(0, len(labels), step))
    is_long = max(len(str(label)) for label in labels) * len(labels[::step]) > 40
    axes.set_xticklabels(
        [str(label) for label in labels[::step]], rotation=50 if is_long else 0, ha="right" if is_long else "center"
    )
    axes.margins(x=0.12)
