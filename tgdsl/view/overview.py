"""One picture of all that a module reads: a panel per reading, the same view of the same instant, vectors as arrows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.boxes import Boxes, boxes_of, draw_boxes, is_boxed
from tgdsl.view.cameras import ViewError
from tgdsl.view.markers import Markers, Pose, markers_of, touched
from tgdsl.view.picture import chosen_output
from tgdsl.view.scene import RenderedScene, draw_colour_bar, draw_markers, rendered, seen
from tgdsl.view.style import DPI, FAINT, HEAT, INK, SUPERSAMPLING, new_figure, save_figure
from tgdsl.view.table import outputs_on_taxels

PANEL = (3.9, 3.7)  # width and height of a panel [inch]
ALONE = 1.6  # how much larger a panel is that stands alone
ARROW = 0.09  # length of the longest arrow, as a part of the panel's width


def drawn_outputs(touch: TactileModule) -> list[Output]:
    """Return the readings that an overview has panels of: of taxels, of bodies that carry them, and of boxes of links."""
    on_taxels = outputs_on_taxels(touch)
    return [output for output in touch.outputs if output in on_taxels or is_boxed(touch, output)]


def overview(touch: TactileModule, sim: Simulation, readings: Mapping[str, Tensor], path: Path, **options: Any) -> Path:
    """Write `drawing` as a PNG file; return the path."""
    return save_figure(drawing(touch, sim, readings, **options), path)


def drawing(
    touch: TactileModule,
    sim: Simulation,
    readings: Mapping[str, Tensor],
    *,
    env: int = 0,
    title: str = "",
    view: str | None = None,
    temperatures: tuple[float, float] | None = None,
) -> Figure:
    """Draw every reading of taxels, bodies or boxes of one environment, a panel for each, whose axes are the figure's.

    Each panel has a separate scale. An arrow is a vector's projection on the picture; the longest has the same length in every
    panel. Readings of bodies have one large marker per body; readings of boxes, such as temperatures of cells, colour them.

    `view` is as in `picture.drawing`; `temperatures` are the lowest and highest temperature of the colours [°C]; default: of
    the readings in each panel.

    Raises:
        ViewError: If there is nothing to draw, or no such environment or view.
    """
    outputs = [output for output in drawn_outputs(touch) if output.name in readings]
    if not outputs:
        raise ViewError("there is nothing to draw: the readings given hold none of this module's sensors")
    if not 0 <= env < sim.num_envs:
        raise ViewError(f"environment {env} does not exist, expected 0 to {sim.num_envs - 1}")
    panels = {
        o.name: boxes_of(touch, o, readings[o.name], env, temperatures)
        if is_boxed(touch, o)
        else markers_of(touch, sim, o, readings[o.name], env)
        for o in outputs
    }
    columns = min(len(outputs), 4)
    rows = -(-len(outputs) // columns)
    panel = [(ALONE if len(outputs) == 1 else 1.0) * side for side in PANEL]
    width, height = (SUPERSAMPLING * round(0.94 * size * DPI) for size in (panel[0], 0.82 * panel[1]))
    lead = _lead(touch, sim, readings, panels, env)
    layouts = [reading.layout for reading in panels.values() if isinstance(reading, Boxes)]
    in_view = seen(touch, sim, lead, env, width, height, view, layouts)
    scene = rendered(in_view) if len(layouts) < len(panels) else None
    figure = new_figure(columns * panel[0], rows * panel[1] + 0.5)
    bottom, top = 0.5 / figure.get_figheight(), 1 - 1.0 / figure.get_figheight()
    grid = figure.add_gridspec(rows, columns, left=0.01, right=0.99, bottom=bottom, top=top, wspace=0.06, hspace=0.3)
    for i, output in enumerate(outputs):
        axes = figure.add_subplot(grid[i])
        reading = panels[output.name]
        if isinstance(reading, Boxes):
            draw_boxes(axes, sim, in_view, reading, env)
        elif scene is not None:
            norm = Normalize(0.0, float(reading.value.max()) or 1.0)
            draw_markers(axes, scene, reading, norm)
            _draw_arrows(axes, scene, reading)
            if reading.is_read.any():
                draw_colour_bar(axes.inset_axes((0.46, -0.06, 0.5, 0.022)), norm, HEAT, reading.colour_label)
        axes.set_title(f"{output.name}  ·  {output.kind}", fontsize=11, color=INK, loc="left", pad=18, weight="bold")
        axes.text(0, 1.02, reading.headline, transform=axes.transAxes, fontsize=9.5, color=FAINT)
    figure.text(0.012, 1 - 0.26 / figure.get_figheight(), title, size=15, weight="bold", color=INK, va="center")
    return figure


def _lead(
    touch: TactileModule, sim: Simulation, readings: Mapping[str, Tensor], panels: Mapping[str, Markers | Boxes], env: int
) -> Markers:
    """Return what the camera is to face: taxels of the reading that a picture is of, or else bodies, or else boxes."""
    markers = {name: panel for name, panel in panels.items() if isinstance(panel, Markers)}
    outputs = [output for output in touch.outputs if output.name in markers]
    if not outputs:
        first = next(panel for panel in panels.values() if isinstance(panel, Boxes))
        return first.markers(sim.model, Pose(*sim.body_poses(env)))
    has_taxels = any(output.rows == "taxel" for output in outputs)
    output = chosen_output(touch, readings) if has_taxels else outputs[0]
    return replace(markers[output.name], would_read=touched(touch, sim, output, readings, env))


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
