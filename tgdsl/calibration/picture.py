"""Pictures of a fit: measurements, the sensor's readings, and their difference.

A target of one sample whose rows have places is a field of arrows over the link; one over time is lines of its largest rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from tgdsl.calibration.checks import TargetErrors
from tgdsl.calibration.problem import Part, Problem, Solution
from tgdsl.view.style import FAINT, INK, new_figure, save_figure

MEASURED, FITTED, RESIDUAL = "#3d5a80", "#c8553d", "#588157"
_PANEL = (5.0, 4.4)
MOST_LINES = 3


def picture(problem: Problem, solution: Solution, errors: Sequence[TargetErrors], path: Path) -> Path:
    """Draw each target and its fit, left, and the residuals, right; return the path of the PNG file."""
    num = len(problem.parts)
    figure = new_figure(2 * _PANEL[0], num * _PANEL[1], layout="constrained")
    panels = figure.subplots(num, 2, squeeze=False)
    for i, (part, error) in enumerate(zip(problem.parts, errors, strict=True)):
        draw = _field if part.target.value.shape[0] == 1 and problem.places[error.reading] is not None else _lines
        draw(panels[i], part, solution.predicted[i].reshape(part.target.value.shape), problem.places[error.reading], error.unit)
        held = "" if error.held_out is None else f", held out {error.held_out:.3f}"
        title = f"{Path(error.recording).name}: {error.reading}, relative RMSE {error.error:.3f}{held}"
        panels[i, 0].set_title(title, loc="left", fontsize=11, color=INK)
        panels[i, 1].set_title("residual: fit − measured", loc="left", fontsize=11, color=INK)
    return save_figure(figure, path)


def _field(panels: Sequence[Axes], part: Part, fitted: np.ndarray, places: np.ndarray | None, unit: str) -> None:
    """Draw arrows at the rows' places, in the plane of their largest spread; residuals are magnified."""
    assert places is not None
    centred = places - places.mean(axis=0)
    axes = np.sort(np.argsort(np.ptp(centred, axis=0))[-2:])
    weight = part.weight.reshape(part.target.value.shape)[0].max(axis=1)
    measured, is_used = part.target.value[0], weight > 0
    num = min(2, measured.shape[1])
    vectors = [np.pad(value[:, :num], ((0, 0), (0, 2 - num))) for value in (measured, fitted[0], fitted[0] - measured)]
    spread = np.ptp(centred[:, axes], axis=0).max() or 1.0
    scale = np.linalg.norm(vectors[0][is_used], axis=1).max() / (0.12 * spread) or 1.0
    typical = 3 * np.linalg.norm(vectors[2][is_used], axis=1).mean()
    larger = max(1.0, 10 ** np.floor(np.log10(scale * 0.12 * spread / typical))) if typical > 0 else 1.0
    at = 1e3 * places[:, axes][is_used].T
    style = {"angles": "xy", "scale_units": "xy", "width": 0.004}
    panels[0].quiver(*at, *vectors[0][is_used].T, color=MEASURED, scale=scale / 1e3, label="measured", **style)
    panels[0].quiver(*at, *vectors[1][is_used].T, color=FITTED, scale=scale / 1e3, label="fit", **style)
    panels[1].quiver(*at, *vectors[2][is_used].T, color=RESIDUAL, scale=scale / 1e3 / larger, label=f"× {larger:g}", **style)
    for panel in panels:
        panel.set_aspect("equal")
        panel.set_xlabel(f"{'xyz'[axes[0]]} [mm]", fontsize=9, color=INK)
        panel.set_ylabel(f"{'xyz'[axes[1]]} [mm]", fontsize=9, color=INK)
        panel.legend(fontsize=8, frameon=False, loc="upper right")


def _lines(panels: Sequence[Axes], part: Part, fitted: np.ndarray, places: np.ndarray | None, unit: str) -> None:
    """Draw the numbers of the target that vary most over time."""
    samples = part.target.value.shape[0]
    measured, fit = part.target.value.reshape(samples, -1), fitted.reshape(samples, -1)
    used = part.weight.reshape(samples, -1) > 0
    size = np.where(used, measured, 0.0).std(axis=0) if samples > 1 else abs(measured[0])
    for j in np.argsort(size)[::-1][:MOST_LINES]:
        is_used = used[:, j]
        panels[0].plot(part.target.time[is_used], measured[is_used, j], color=MEASURED, linewidth=0.8)
        panels[0].plot(part.target.time[is_used], fit[is_used, j], color=FITTED, linewidth=0.8)
        panels[1].plot(part.target.time[is_used], (fit - measured)[is_used, j], color=RESIDUAL, linewidth=0.8)
    panels[0].legend(("measured", "fit"), fontsize=8, frameon=False)
    panels[1].axhline(0, color=FAINT, linewidth=0.8, zorder=0)
    for panel in panels:
        panel.set_xlabel("time [s]", fontsize=9, color=INK)
        panel.set_ylabel(f"[{unit}]", fontsize=9, color=INK)
