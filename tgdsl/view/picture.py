"""Pictures of touch: the robot with its taxels coloured by reading, and one heat map per link. No display is needed.

Shapes: `taxel` taxels of one sensor, `h` and `w` rows and columns of cells or pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import KDTree
from torch import Tensor

from tgdsl.console.tables import TaxelTable
from tgdsl.errors import did_you_mean
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.cameras import ViewError
from tgdsl.view.markers import Markers, markers_of, touched
from tgdsl.view.raster import Viewport, unit
from tgdsl.view.scene import draw_colour_bar, draw_markers, rendered, seen
from tgdsl.view.style import DPI, FAINT, HEAT, INK, SUPERSAMPLING, new_figure, pixels_of, save_figure, shortened

Array = np.ndarray
SIZE = (16.0, 9.0)  # width and height of the picture [inch]
VIEW = (0.0125, 0.06, 0.55, 0.82)  # the 3-D view in the figure: left, bottom, width, height
MAX_MAPS = 12
_NAME_SPACING = 0.028  # least distance of the names of links, as a part of the 3-D view's height
HEAT_MAP_WIDTH = 340  # columns of pixels of the live page's maps together
_HEAD, _MARGIN = 16, 4  # rows of the title of a map there, and pixels around it
_TITLE = {1: 11, 2: 11, 3: 9, 4: 7.8}  # size of the maps' titles, by how many stand side by side


def picture(touch: TactileModule, sim: Simulation, readings: Mapping[str, Tensor], path: Path, **options: Any) -> Path:
    """Write `drawing` as a PNG file; return the path."""
    return save_figure(drawing(touch, sim, readings, **options), path)


def drawing(
    touch: TactileModule,
    sim: Simulation,
    readings: Mapping[str, Tensor],
    *,
    env: int = 0,
    reading: str | None = None,
    title: str = "",
    view: str | None = None,
) -> Figure:
    """Draw one reading of one environment: the robot with its taxels, then a map for each link, whose axes have its name.

    The default reading is a kinematic taxel's, if there is any, or else the first; the default title is its name. A view is one
    of `cameras.VIEWS`, or azimuth and elevation in degrees, "30,20"; default: see `cameras.best_camera`.

    Raises:
        ViewError: If there is no such reading, environment or view.
    """
    output = chosen_output(touch, readings, reading)
    if not 0 <= env < sim.num_envs:
        raise ViewError(f"environment {env} does not exist, expected 0 to {sim.num_envs - 1}")
    markers = markers_of(touch, sim, output, readings[output.name], env)
    markers = replace(markers, would_read=touched(touch, sim, output, readings, env))
    table = touch.taxels[output.sensor]
    norm = Normalize(0.0, float(markers.value.max()) or 1.0)
    figure = new_figure(*SIZE)
    width, height = (SUPERSAMPLING * round(part * size * DPI) for part, size in zip(VIEW[2:], SIZE, strict=True))
    links = list(dict.fromkeys(table["link"].tolist()))
    links.sort(key=lambda link: -markers.value[table["link"] == link].sum())
    names = short_names(links)
    if len(links) > MAX_MAPS:
        rest = f"not shown: {len(links) - MAX_MAPS} of {len(links)} links, touched less or not at all"
        figure.text(0.985, 0.912, rest, size=10.5, color=FAINT, ha="right", va="center")
    maps = {link: np.flatnonzero(table["link"] == link) for link in links[:MAX_MAPS]}
    axes, scene = figure.add_axes(VIEW), rendered(seen(touch, sim, markers, env, width, height, view))
    draw_markers(axes, scene, markers, norm)
    _draw_names(axes, scene.viewport, {names[link]: markers.pos[ids].mean(axis=0) for link, ids in maps.items()})
    _draw_maps(figure, sim.model, markers, table, maps, names, norm)
    resolution = touch.plan.origin.resolution
    figure.text(0.016, 0.955, title or output.name, size=19, weight="bold", color=INK, va="center")
    parts = [output.name] if title else []
    parts += [output.kind, f"resolution {resolution}"] if resolution else [output.kind]
    count = f"{markers.is_touched.sum()} of {len(table)} taxels touched"
    count += f" (above {markers.threshold_label})" if markers.threshold else ""
    parts += [count + ("" if markers.would_read is None else " before noise"), markers.headline, f"environment {env}"]
    figure.text(0.016, 0.912, "   ·   ".join(parts), size=11.5, color=FAINT, va="center")
    return figure


def chosen_output(touch: TactileModule, readings: Mapping[str, Tensor], name: str | None = None) -> Output:
    """Return the reading of taxels that a picture is of: the one named, or a kinematic taxel's, or else the first."""
    outputs = {output.name: output for output in touch.outputs if output.name in readings and output.rows == "taxel"}
    if not outputs:
        raise ViewError("there is nothing to draw: the readings given hold none of this module's taxels")
    if name is None:
        return next((output for output in outputs.values() if output.kind == "kinematic_taxel"), next(iter(outputs.values())))
    if name not in outputs:
        raise ViewError(f'there is no reading "{name}"; {did_you_mean(name, outputs, "readings")}')
    return outputs[name]


def _draw_names(axes: Axes, viewport: Viewport, places: Mapping[str, Float[Array, " 3"]]) -> None:
    """Write the names of links at the left and right edge of the 3-D view, each with a line to its taxels."""
    at = {name: (float(x), float(y)) for name, (x, y, _) in ((name, viewport.project(pos)) for name, pos in places.items())}
    for is_left in (True, False):
        side = sorted((name for name in at if (at[name][0] < viewport.width / 2) == is_left), key=lambda name: at[name][1])
        row = -np.inf
        for name in side:
            row = max(at[name][1], row + _NAME_SPACING * viewport.height)
            axes.annotate(
                name,
                at[name],
                (0.0 if is_left else viewport.width, row),
                fontsize=8.5,
                color=INK,
                ha="left" if is_left else "right",
                va="center",
                zorder=7,
                arrowprops={"arrowstyle": "-", "color": FAINT, "linewidth": 0.6, "shrinkA": 1, "shrinkB": 0},
                bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.8},
            )


def _draw_maps(
    figure: Figure,
    model: mujoco.MjModel,
    markers: Markers,
    table: Array,
    maps: Mapping[str, Int[Array, " chosen"]],
    names: Mapping[str, str],
    norm: Normalize,
) -> None:
    """Draw one map per link, the most touched first, and the colour bar that all share."""
    columns = int(np.ceil(np.sqrt(len(maps))))
    rows = -(-len(maps) // columns)
    grid = figure.add_gridspec(rows, columns, left=0.60, right=0.985, bottom=0.15, top=0.82, hspace=0.44, wspace=0.16)
    size = _TITLE[min(columns, 4)]
    for i, (link, taxel_ids) in enumerate(maps.items()):
        axes = figure.add_subplot(grid[i], anchor="N", label=link)
        along, is_tip = distal(model, str(table["body"][taxel_ids[0]]), table["pos"][taxel_ids])
        _draw_map(axes, markers.value[taxel_ids], table[taxel_ids], along, norm)
        mark = "▲ tip" if is_tip else "▲ distal"
        axes.set_title(f"{names[link]}\n{markers.summary(taxel_ids)}", fontsize=size, color=INK, linespacing=1.35, pad=17)
        axes.annotate(mark, (0.5, 1.0), (0, 3), "axes fraction", "offset points", fontsize=size - 1, color=FAINT, ha="center")
    if markers.is_read.any():
        draw_colour_bar(figure.add_axes((0.645, 0.06, 0.295, 0.016)), norm, HEAT, markers.colour_label, 10.0)
    else:
        figure.text(0.7925, 0.083, f"{markers.quantity}: nothing is touched", size=10.5, color=FAINT, ha="center", va="center")


def distal(model: mujoco.MjModel, body: str, pos: Float[Array, "taxel 3"]) -> tuple[Float[Array, " 3"], bool]:
    """Return the direction in a body's frame in which the robot goes on from its joint, and whether it ends there.

    It leads to the bodies that move against this one, or else to its taxels, at `pos` in its frame [m]. It begins at the
    joint's anchor, or at the parent's origin where the joint slides, as a slide has no anchor.
    """
    body_id = model.body(body).id
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    base = body_id
    while model.body_parentid[base] and not model.body_jntnum[base]:
        base = model.body_parentid[base]
    rigid = [i for i in range(model.nbody) if model.body_weldid[i] == model.body_weldid[body_id]]
    ends = [i for i in range(model.nbody) if model.body_parentid[i] in rigid and model.body_jntnum[i] and i != base]
    rotation = state.xmat[body_id].reshape(3, 3)
    end = state.xpos[ends].mean(axis=0) if ends else state.xpos[body_id] + rotation @ pos.mean(axis=0)
    joint, start = int(model.body_jntadr[base]), state.xpos[base]
    if joint >= 0:
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        start = state.xpos[model.body_parentid[base]] if slides else state.xanchor[joint]
    return (end - start) @ rotation, not ends


class FlatMap(NamedTuple):
    """Taxels of a link in the plane of their mean normal, seen from outside, with the distal end up."""

    places: Float[Array, "taxel 2"]  # to the right and up [m]; of grids, before their quarter turns
    cells: Int[Array, "h w"] | None  # which taxel each cell of a grid has, -1 for none; None: they are scattered
    size: Float[Array, " 2"]  # height and width of the cells together [m]


def flat_map(table: Array, along: Float[Array, " 3"]) -> FlatMap:
    """Return the map of a link's taxels; `along` shall be up: a grid is turned by quarters until it nearly is.

    Unturned, columns of a grid run to the right and rows down.
    """
    normal = unit(table["normal"].mean(axis=0), table["normal"][0])
    across = table["tangent"].mean(axis=0)
    across = unit(across - (across @ normal) * normal, table["tangent"][0])
    is_grid = bool((table["row"] >= 0).all())
    level = along - (along @ normal) * normal
    if not is_grid and np.linalg.norm(level) > 0.1 * np.linalg.norm(along):
        across = unit(np.cross(level, normal), across)
    up = np.cross(normal, across)
    places = table["pos"] @ np.stack([across, up], axis=1)
    if not is_grid:
        return FlatMap(places, None, np.ptp(places, axis=0)[::-1])
    active = np.flatnonzero(table["radius"] > 0)
    cells = np.full((table["row"].max() + 1, table["column"].max() + 1), -1)
    cells[table["row"][active], table["column"][active]] = active
    pitch = np.ptp(places, axis=0)[::-1] / np.maximum(np.array(cells.shape) - 1, 1)
    pitch = np.where(pitch > 0, pitch, pitch.max() or 1.0)  # of a single row or column there is no pitch
    quarters = int(np.argmax(np.array([up, across, -up, -across]) @ along))
    size = pitch * cells.shape
    return FlatMap(places, np.rot90(cells, quarters), size[::-1] if quarters % 2 else size)


def _draw_map(axes: Axes, value: Array, table: Array, along: Float[Array, " 3"], norm: Normalize) -> None:
    """Draw one link with its distal end up: a grid as cells, scattered taxels as dots."""
    heat = np.where(value > 0, value, -1.0)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    places, cells, size = flat_map(table, along)
    axes.patch.set_facecolor("#f6f7f8")
    if cells is not None:
        axes.patch.set(hatch="////", edgecolor="#d9dce0", linewidth=0)
        edge = 9.0 / max(9, *cells.shape)
        image = np.ma.masked_array(heat[cells], cells < 0)
        axes.pcolormesh(image, cmap=HEAT, norm=norm, edgecolors="white", linewidth=edge)
        high, wide = size / cells.shape
        axes.set(aspect=np.clip(high / wide, 0.4, 2.5), ylim=(len(cells), 0))
        return
    x, y = 1e3 * places[table["radius"] > 0].T
    width = 0.03 * axes.get_window_extent().height * 72 / DPI
    axes.scatter(x, y, c=heat[table["radius"] > 0], cmap=HEAT, norm=norm, s=width**2, linewidths=0)
    axes.margins(0.12)
    axes.set_aspect("equal", "datalim")


def short_names(links: list[str]) -> dict[str, str]:
    """Return the names without the leading words that all share, but with at least two words each."""
    words = {link: link.split("_") for link in links}
    shared = 0
    while len(links) > 1 and len({tuple(parts[: shared + 1]) for parts in words.values()}) == 1:
        shared += 1
    return {link: "_".join(parts[max(min(shared, len(parts) - 2), 0) :]) for link, parts in words.items()}


class HeatMaps:
    """Maps of all links that carry taxels, as one image."""

    def __init__(self, model: mujoco.MjModel, table: TaxelTable):
        links = list(dict.fromkeys(table["link"].tolist()))
        columns = math.ceil(math.sqrt(len(links)))
        side = HEAT_MAP_WIDTH // columns
        room = side - 2 * _MARGIN
        rows = -(-len(links) // columns)
        self._taxel: Int[Array, "h w"] = np.full((rows * (side + _HEAD), columns * side), -1)
        figure = new_figure(self._taxel.shape[1] / DPI, self._taxel.shape[0] / DPI)
        for i, (link, name) in enumerate(short_names(links).items()):
            row, column = divmod(i, columns)
            top, left = row * (side + _HEAD), column * side
            taxel_ids = np.flatnonzero(table["link"] == link)
            along, _ = distal(model, str(table["body"][taxel_ids[0]]), table["pos"][taxel_ids])
            map_ = _map_of(table[taxel_ids], along, room)
            first = top + _HEAD + _MARGIN + (room - len(map_)) // 2, left + _MARGIN + (room - map_.shape[1]) // 2
            pixels = self._taxel[first[0] : first[0] + len(map_), first[1] : first[1] + map_.shape[1]]
            pixels[:] = np.where(map_ >= 0, taxel_ids[map_], -1)
            height, width = self._taxel.shape
            x, y = (left + side / 2) / width, 1 - (top + _HEAD / 2) / height
            figure.text(x, y, shortened(name, side // 6), size=6.5, color=INK, ha="center", va="center")
        self._blank, self._drawn = pixels_of(figure), self._taxel >= 0

    def image(self, colour: UInt8[Array, "taxel 3"]) -> UInt8[Array, "h w 3"]:
        """Return the maps with taxels in these colours."""
        result = self._blank.copy()
        result[self._drawn] = colour[self._taxel[self._drawn]]
        return result


def _map_of(table: TaxelTable, along: Float[Array, " 3"], room: int) -> Int[Array, "h w"]:
    """Return which taxel of a link each pixel of its map shows, -1 for none; the map has at most `room` pixels a side."""
    places, cells, size = flat_map(table, along)
    if cells is not None:
        height, width = np.maximum(1, np.floor(room * size / size.max())).astype(int)
        row, column = np.arange(height) * len(cells) // height, np.arange(width) * cells.shape[1] // width
        return cells[row[:, None], column]
    apart = KDTree(places).query(places, k=min(2, len(places)))[0].reshape(len(places), -1)[:, -1]
    reach = 0.5 * float(np.median(apart)) or 1e-3
    pixel = float((size + 2 * reach).max()) / room
    height, width = np.maximum(1, np.floor((size + 2 * reach) / pixel)).astype(int)
    left, top = places[:, 0].min() - reach, places[:, 1].max() + reach
    x, y = np.meshgrid(left + pixel * (np.arange(width) + 0.5), top - pixel * (np.arange(height) + 0.5))
    active = np.flatnonzero(table["radius"] > 0)
    distance, taxel = KDTree(places[active]).query(np.stack([x, y], axis=-1))
    return np.where(distance < reach, active[taxel], -1)
