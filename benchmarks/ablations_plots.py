"""Plots of ablations: score over control steps of each student, a panel per placement, resolution and noise."""

from __future__ import annotations

import io
import math

import numpy as np
from ablations_kept import Ablation, Taught
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tgdsl.rl.spec import touch_types
from tgdsl.rl.students.keys import NONE

MOST_LINES, MOST_COLUMNS = 10, 3
"""Lines of students in a panel, and panels side by side."""
COLOURS = {name: colormaps["tab10"](i % 10) for i, name in enumerate(touch_types())} | {NONE: "black"}
"""Colour of each type, the same in all plots."""


def plot(ablation: Ablation) -> Figure:
    """Return the plot of an ablation; a panel shows at most ten types, the best."""
    touch = [each for each in ablation.taught if each.row.type != NONE]
    blind = [each for each in ablation.taught if each.row.type == NONE]
    places = list(dict.fromkeys(each.where for each in touch)) or [each.where for each in blind]
    columns = min(MOST_COLUMNS, math.ceil(math.sqrt(len(places))))
    rows = math.ceil(len(places) / columns)
    figure = Figure(figsize=(1.5 + 4.2 * columns, 3.4 * rows), dpi=100, layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axes, where in zip(panels, places, strict=False):
        own = [each for each in touch if each.where == where]
        panel(axes, ablation, own + [each for each in blind if each.row.resolution == where[1]], where)
    for axes in panels[len(places) :]:
        axes.set_axis_off()
    for axes in panels[::columns]:
        axes.set_ylabel(score_label(ablation))
    handles = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", frameon=False, fontsize=8)
    return figure


def panel(axes: Axes, ablation: Ablation, taught: list[Taught], where: tuple[str, str, str]) -> None:
    """Draw the students of one place: the mean over seeds, and from the least to the largest of them."""
    ranked = sorted(taught, key=lambda each: each.row.score * (1 if ablation.made["is_less_better"] else -1))
    for each in ranked[:MOST_LINES]:
        draw(axes, ablation, each, COLOURS[each.row.type], each.row.type)
    draw_yardsticks(axes, ablation)
    left_out = f" (best {MOST_LINES} of {len(ranked)})" if len(ranked) > MOST_LINES else ""
    axes.set_title(", ".join(part for part in where if part) + left_out, fontsize=9, loc="left")


def draw(axes: Axes, ablation: Ablation, taught: Taught, colour: tuple[float, ...] | str, label: str) -> None:
    """Draw students that differ in their seeds alone: the mean over seeds, and from the least to the largest of them."""
    curves = ablation.curves[taught.row.resolution]
    score, millions = np.stack([curves.score[name] for name in taught.names]), curves.samples / 1e6
    axes.plot(millions, score.mean(axis=0), color=colour, linewidth=1.3, label=label)
    axes.fill_between(millions, score.min(axis=0), score.max(axis=0), color=colour, alpha=0.15, linewidth=0)


def draw_yardsticks(axes: Axes, ablation: Ablation) -> None:
    """Draw teacher and joints at rest; name the axis of control steps."""
    for name, kept, dashes in (("teacher", ablation.teacher, "--"), ("joints at rest", ablation.rest, ":")):
        if kept is not None:
            axes.axhline(kept["score"], color="black", linestyle=dashes, linewidth=1.0, label=name)
    axes.set_xlabel("million control steps of each student", fontsize=9)
    axes.grid(True, color="#e3e5e8", linewidth=0.6)


def score_label(ablation: Ablation) -> str:
    """Return what stands at the axis of scores."""
    unit = ablation.made["unit"]
    return f"score [{unit}]" if len(unit) < 20 else unit


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG: the same bytes for the same figure."""
    content = io.BytesIO()
    FigureCanvasAgg(figure).print_png(content, metadata={"Software": None})
    return content.getvalue()
