"""One picture of all that a module reads: a panel per reading, the same view of the same instant, vectors as arrows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from tgdsl.files.write import atomic_open, with_folder
from tgdsl.module.module import TactileModule
from tgdsl.runtime.source import Simulator
from tgdsl.view.cameras import ViewError
from tgdsl.view.markers import Markers, markers_of, touched
from tgdsl.view.picture import chosen_output
from tgdsl.view.scene import RenderedScene, draw_markers, render_scene
from tgdsl.view.style import DPI, FAINT, INK, SUPERSAMPLING
from tgdsl.view.table import outputs_on_taxels

PANEL = (3.9, 3.7)
"""Width and height of a panel [inch]."""
ARROW = 0.09
"""Length of the longest arrow, as a part of the panel's width."""


def overview(
    touch: TactileModule,
    sim: Simulator,
    readings: Mapping[str, Tensor],
    path: Path,
    *,
    env: int = 0,
    title: str = "",
    view: str | None = None,
) -> Path:
    """Draw every reading of one environment, and write the picture.

    Each panel has a scale of its own. An arrow is a vector as it is, in the plane of the picture; the longest is as long in
    every panel. Readings of bodies have one large marker per body.

    Args:
        touch: The module.
        sim: The scene, at the instant of the readings.
        readings: What the module read, by name.
        path: PNG file to write; its folder is made if need be.
        env: Which environment.
        title: What to write above it all.
        view: From where, as in `view.picture`.

    Returns:
        The path.

    Raises:
        ViewError: If there is no such environment or view, or nothing to draw.
        FileError: If the file cannot be written.
    """
    figure = drawing(touch, sim, readings, env=env, title=title, view=view)
    with atomic_open(with_folder(path)) as file:
        figure.savefig(file, format="png")
    return path


def drawing(
    touch: TactileModule,
    sim: Simulator,
    readings: Mapping[str, Tensor],
    *,
    env: int = 0,
    title: str = "",
    view: str | None = None,
) -> Figure:
    """Return what `overview` writes; its axes are the panels, one for each reading of taxels or bodies."""
    outputs = [output for output in outputs_on_taxels(touch) if output.name in readings]
    if not outputs:
        raise ViewError("there is nothing to draw: the readings given hold none of this module's sensors")
    if not 0 <= env < sim.num_envs:
        raise ViewError(f"environment {env} does not exist, expected 0 to {sim.num_envs - 1}")
    markers = [markers_of(touch, sim, output, readings[output.name], env) for output in outputs]
    columns = min(len(outputs), 4)
    rows = -(-len(outputs) // columns)
    width, height = (SUPERSAMPLING * round(0.94 * size * DPI) for size in (PANEL[0], 0.82 * PANEL[1]))
    has_taxels = any(output.rows == "taxel" for output in outputs)
    lead = outputs.index(chosen_output(touch, readings)) if has_taxels else 0
    markers[lead] = replace(markers[lead], would_read=touched(touch, sim, outputs[lead], readings, env))
    scene = render_scene(touch, sim, markers[lead], env, width, height, view)
    figure = Figure(figsize=(columns * PANEL[0], rows * PANEL[1] + 0.5), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        rows,
        columns,
        left=0.01,
        right=0.99,
        bottom=0.34 / figure.get_figheight(),
        top=1 - 1.0 / figure.get_figheight(),
        wspace=0.06,
        hspace=0.3,
    )
    for i, (output, own) in enumerate(zip(outputs, markers, strict=True)):
        axes = figure.add_subplot(grid[i])
        draw_markers(axes, scene, own, Normalize(0.0, float(own.value.max()) or 1.0))
        _draw_arrows(axes, scene, own)
        axes.set_title(f"{output.name}  ·  {output.kind}", fontsize=11, color=INK, loc="left", pad=18, weight="bold")
        axes.text(0, 1.02, own.headline, transform=axes.transAxes, fontsize=9.5, color=FAINT)
    figure.text(0.012, 1 - 0.26 / figure.get_figheight(), title, size=15, weight="bold", color=INK, va="center")
    return figure


def _draw_arrows(axes: Axes, scene: RenderedScene, markers: Markers) -> None:
    """Draw vectors from where they are read."""
    if markers.vector is None or not markers.is_read.any():
        return
    camera = scene.viewport.camera
    along = markers.vector[markers.is_read] @ np.stack([camera.right, camera.up]).T
    along *= ARROW * scene.viewport.width / np.linalg.norm(markers.vector, axis=1).max()
    at = scene.viewport.project(markers.pos[markers.is_read])[:, :2]
    style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.0045, "headwidth": 3.4, "headlength": 4}
    axes.quiver(*at.T, *along.T, color=INK, zorder=6, **style)
