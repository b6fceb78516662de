"""Pictures of touch: the robot with its taxels coloured by reading, beside one heat map per link. No display is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from tgdsl.errors import did_you_mean
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.source import Simulator
from tgdsl.view.cameras import ViewError
from tgdsl.view.markers import Markers, markers_of, touched
from tgdsl.view.raster import unit
from tgdsl.view.scene import draw_markers, render_scene
from tgdsl.view.style import DPI, FAINT, HEAT, INK, SUPERSAMPLING

Array = np.ndarray
SIZE = (16.0, 9.0)
"""Width and height of the picture [inch]."""
VIEW = (0.0125, 0.06, 0.55, 0.82)  # the 3-D view in the figure: left, bottom, width, height
MAX_MAPS = 12
_TITLE = {1: 11, 2: 11, 3: 9, 4: 7.8}  # size of the maps' titles, by how many stand side by side


def picture(
    touch: TactileModule,
    sim: Simulator,
    readings: Mapping[str, Tensor],
    path: Path,
    *,
    env: int = 0,
    reading: str | None = None,
    title: str = "",
    view: str | None = None,
) -> Path:
    """Draw one reading of one environment: the robot with its taxels, and a heat map per link.

    Args:
        touch: The module.
        sim: The scene, at the instant of the readings.
        readings: What the module read, by name.
        path: PNG file to write; its folder is made if need be.
        env: Which environment.
        reading: Which reading of taxels; default: a kinematic taxel's, if there is any, or else the first.
        title: What to write above it all; default: the reading's name.
        view: From where: one of `cameras.VIEWS`, or azimuth and elevation in degrees, "30,20"; default: see
            `cameras.best_camera`.

    Returns:
        The path.

    Raises:
        ViewError: If there is no such reading, environment or view.
        FileError: If the file cannot be written.
    """
    output = chosen_output(touch, readings, reading)
    if not 0 <= env < sim.num_envs:
        raise ViewError(f"environment {env} does not exist, expected 0 to {sim.num_envs - 1}")
    markers = markers_of(touch, sim, output, readings[output.name], env)
    markers = replace(markers, would_read=touched(touch, sim, output, readings, env))
    table = touch.taxels[output.sensor]
    norm = Normalize(0.0, float(markers.value.max()) or 1.0)
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    width, height = (SUPERSAMPLING * round(part * size * DPI) for part, size in zip(VIEW[2:], SIZE, strict=True))
    draw_markers(figure.add_axes(VIEW), render_scene(touch, sim, markers, env, width, height, view), markers, norm)
    _draw_maps(figure, markers, table, norm)
    resolution = touch.plan.origin.resolution
    figure.text(0.016, 0.955, title or output.name, size=19, weight="bold", color=INK, va="center")
    parts = [output.name] if title else []
    parts += [output.kind, f"resolution {resolution}"] if resolution else [output.kind]
    count = f"{markers.is_touched.sum()} of {len(table)} taxels touched"
    parts += [count + ("" if markers.would_read is None else " before noise"), markers.headline, f"environment {env}"]
    figure.text(0.016, 0.912, "   ·   ".join(parts), size=11.5, color=FAINT, va="center")
    with atomic_open(with_folder(path)) as file:
        figure.savefig(file, format="png")
    return path


def chosen_output(touch: TactileModule, readings: Mapping[str, Tensor], name: str | None = None) -> Output:
    """Return the reading of taxels that a picture is of: the one named, or a kinematic taxel's, or else the first.

    Raises:
        ViewError: If there is none.
    """
    known = {output.name: output for output in touch.outputs if output.name in readings and output.rows == "taxel"}
    if not known:
        raise ViewError("there is nothing to draw: the readings given hold none of this module's taxels")
    if name is None:
        return next((output for output in known.values() if output.kind == "kinematic_taxel"), next(iter(known.values())))
    if name not in known:
        raise ViewError(f'there is no reading "{name}"; {did_you_mean(name, known, "readings")}')
    return known[name]


# The maps -------------------------------------------------------------------------------------------------------------


def _draw_maps(figure: Figure, markers: Markers, table: Array, norm: Normalize) -> None:
    """Draw one map per link, the most touched first, and the colour bar that all share."""
    links = list(dict.fromkeys(table["link"].tolist()))
    links.sort(key=lambda link: -markers.value[table["link"] == link].sum())
    shown, names = links[:MAX_MAPS], short_names(links)
    columns = int(np.ceil(np.sqrt(len(shown))))
    rows = -(-len(shown) // columns)
    grid = figure.add_gridspec(rows, columns, left=0.60, right=0.985, bottom=0.15, top=0.83, hspace=0.36, wspace=0.16)
    for i, link in enumerate(shown):
        axes = figure.add_subplot(grid[i], anchor="N")
        chosen = np.flatnonzero(table["link"] == link)
        _draw_map(axes, markers.value[chosen], table[chosen], norm)
        axes.set_title(
            f"{names[link]}\n{markers.summary(chosen)}", fontsize=_TITLE[min(columns, 4)], color=INK, linespacing=1.35
        )
    if len(links) > MAX_MAPS:
        rest = f"and {len(links) - MAX_MAPS} more links, touched less or not at all"
        figure.text(0.985, 0.912, rest, size=10.5, color=FAINT, ha="right", va="center")
    if markers.is_read.any():
        _draw_colour_bar(figure, markers, norm)
    else:
        figure.text(0.7925, 0.083, f"{markers.quantity}: nothing is touched", size=10.5, color=FAINT, ha="center", va="center")


def _draw_colour_bar(figure: Figure, markers: Markers, norm: Normalize) -> None:
    axes = figure.add_axes((0.645, 0.075, 0.295, 0.016))
    bar = figure.colorbar(ScalarMappable(norm, HEAT), cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.set_xlabel(f"{markers.label}   (grey: zero)", fontsize=10.5, color=INK)
    axes.tick_params(labelsize=9.5, colors=INK, length=3)


def _draw_map(axes: Axes, value: Array, table: Array, norm: Normalize) -> None:
    """Draw one link: a grid by row (down) and column (right), or scattered taxels in the plane of their mean tangent."""
    shown = np.where(value > 0, value, -1.0)
    active = table["radius"] > 0
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    if (table["row"] >= 0).all():
        cells = np.full((table["row"].max() + 1, table["column"].max() + 1), np.nan)
        cells[table["row"][active], table["column"][active]] = shown[active]
        axes.patch.set(facecolor="#f6f7f8", hatch="////", edgecolor="#d9dce0", linewidth=0)
        edge = 9.0 / max(9, *cells.shape)
        axes.pcolormesh(np.ma.masked_invalid(cells), cmap=HEAT, norm=norm, edgecolors="white", linewidth=edge)
        axes.set(aspect="equal", ylim=(len(cells), 0))
        return
    normal = unit(table["normal"].mean(axis=0), table["normal"][0])
    across = table["tangent"].mean(axis=0)
    across = unit(across - (across @ normal) * normal, table["tangent"][0])
    x, y = 1e3 * table["pos"] @ across, 1e3 * table["pos"] @ np.cross(normal, across)
    size = 0.03 * axes.get_window_extent().height * 72 / DPI
    axes.scatter(x[active], y[active], c=shown[active], cmap=HEAT, norm=norm, s=size**2, linewidths=0)
    axes.patch.set_facecolor("#f6f7f8")
    axes.margins(0.12)
    axes.set_aspect("equal", "datalim")


def short_names(links: list[str]) -> dict[str, str]:
    """Return the names without the leading words that all share, but with at least two words each."""
    words = {link: link.split("_") for link in links}
    shared = 0
    while len(links) > 1 and len({tuple(own[: shared + 1]) for own in words.values()}) == 1:
        shared += 1
    return {link: "_".join(own[max(min(shared, len(own) - 2), 0) :]) for link, own in words.items()}
