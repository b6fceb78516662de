"""Results of fits: a calibration, lines of text, and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tgdsl.calibration.hand.fit import FingerFit, FitError
from tgdsl.calibration.hand.loads import Samples
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.wire.protocol import FINGERS
from tgdsl.view.style import FAINT, INK, new_figure, save_figure

AXIS_COLOURS = ("#c8553d", "#588157", "#3d5a80")
_PANEL = (3.6, 5.4)


def calibrated(base: Calibration, fits: Mapping[str, FingerFit], others: str | None = None) -> Calibration:
    """Return a calibration in N: fits by finger, and `base` for the others, or the scale and rotation of the finger `others`.

    A threshold of contact in counts means nothing in N, and is left out.

    Raises:
        FitError: If a finger was not fitted, `base` is in counts, and it is not said what it shall have.
    """
    if others is not None and others not in fits:
        raise FitError(f"the other fingers cannot be like {others}, which was not fitted; fitted: {', '.join(fits)}")
    left = [name for name in FINGERS if name not in fits]
    if left and others is None and base.units != "N":
        problem = f"{', '.join(left)}: no load was on them, so what their counts are in N is not known"
        raise FitError(f"{problem}; load them too, start from a calibration in N, or say --others {next(iter(fits))}")
    scale, rotation, bias, tare = (np.array(values) for values in (base.scale, base.rotation, base.bias, base.tare))
    for i, name in enumerate(FINGERS):
        fit = fits.get(name) or (fits[others] if others is not None else None)
        if fit is not None:
            scale[i], rotation[i], bias[i] = fit.scale, fit.rotation, 0.0
        if name in fits:
            tare[i] = fits[name].tare
    threshold = base.contact_threshold if base.units == "N" else None
    return replace(base, units="N", scale=scale, rotation=rotation, bias=bias, tare=tare, contact_threshold=threshold)


def report(fits: Mapping[str, FingerFit], samples: Mapping[str, Samples]) -> list[str]:
    """Return a line per fit and axis: residuals, and omitted readings."""
    lines = []
    for name, fit in fits.items():
        finger_samples = samples[name]
        lines.append(f"{name}: {len(finger_samples.counts)} readings; {fit_text(fit)}")
        for i, axis in enumerate("xyz"):
            size = f"RMS {fit.rms[i]:.4f} N, at most {fit.max_error[i]:.4f} N, R² {fit.r_squared[i]:.5f}"
            lines.append(f"  {axis}: loads {fit.force[:, i].min():.2f} to {fit.force[:, i].max():.2f} N; {size}")
        if finger_samples.num_left_out:
            taxels = ", ".join(map(str, finger_samples.saturated_taxels))
            left_out = f"{finger_samples.num_left_out} readings{f'; taxels {taxels}' if taxels else ''}"
            lines.append(f"  left out at the end of the range: {left_out}")
    return lines


def fit_text(fit: FingerFit) -> str:
    """Return a fit's numbers in one line."""
    scale = " ".join(f"{value:.5f}" for value in fit.scale)
    rows = "; ".join(" ".join(f"{value:.3f}" for value in row) for row in fit.rotation)
    return f"scale {scale} N per count, rotation [{rows}], tare {' '.join(f'{value:.2f}' for value in fit.tare)} counts"


def picture(fits: Mapping[str, FingerFit], path: Path, title: str) -> Path:
    """Write `drawing` as a PNG file; return the path."""
    return save_figure(drawing(fits, title), path)


def drawing(fits: Mapping[str, FingerFit], title: str) -> Figure:
    """Draw fitted over known forces, and their difference, a column per finger."""
    figure = new_figure(0.4 + _PANEL[0] * len(fits), _PANEL[1], layout="constrained")
    figure.suptitle(title, fontsize=13, weight="bold", color=INK, x=0.01, ha="left")
    panels = figure.subplots(2, len(fits), squeeze=False, sharex="col", height_ratios=[2, 1])
    for column, (name, fit) in enumerate(fits.items()):
        above, below = panels[0, column], panels[1, column]
        for i, (axis, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
            style = {"s": 5, "color": colour, "linewidths": 0, "alpha": 0.5}
            above.scatter(fit.force[:, i], fit.force[:, i] + fit.error[:, i], label=f"{axis}: RMS {fit.rms[i]:.3f} N", **style)
            below.scatter(fit.force[:, i], fit.error[:, i], **style)
        above.axline((0, 0), slope=1, color=FAINT, linewidth=0.8, zorder=0)
        below.axhline(0, color=FAINT, linewidth=0.8, zorder=0)
        above.set_title(name, loc="left", fontsize=11, color=INK)
        above.legend(fontsize=8, frameon=False, markerscale=2)
        _label(above, "fitted force [N]" if column == 0 else "", "")
        _label(below, "error [N]" if column == 0 else "", "known force, along the link [N]")
    return figure


def _label(axes: Axes, vertical: str, horizontal: str) -> None:
    axes.set_ylabel(vertical, fontsize=9, color=INK)
    axes.set_xlabel(horizontal, fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
