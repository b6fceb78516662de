"""Pictures of touch: the robot with its taxels coloured by reading, beside one heat map per link. No display is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from torch import Tensor

from tgdsl.errors import did_you_mean
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.source import Simulator
from tgdsl.view.cameras import ViewError as ViewError
from tgdsl.view.cameras import best_camera, camera_of
from tgdsl.view.dots import Dots, Pose, dots_of, touched
from tgdsl.view.shot import Screen, Shot, is_seen, rasterise, robot_bodies, screen_for, shaded, smaller, solid_of, unit

Array = np.ndarray
SIZE, DPI = (16.0, 9.0), 100
VIEW = (0.0125, 0.06, 0.55, 0.82)  # the 3-D view in the figure: left, bottom, width, height
FINE = 2  # pixels of the 3-D view per pixel of the file, along each axis
MAX_MAPS = 12
_TITLE = {1: 11, 2: 11, 3: 9, 4: 7.8}  # size of the maps' titles, by how many stand side by side
INK, FAINT, REST = "#2b2f36", "#7b828c", "#d3d6da"
_LIT, _OTHER, _OBJECT = np.array([0.83, 0.84, 0.86]), np.array([0.60, 0.62, 0.66]), np.array([0.33, 0.55, 0.83])
_HEAT = LinearSegmentedColormap.from_list("touch", matplotlib.colormaps["YlOrRd"](np.linspace(0.2, 0.93, 256)))
_HEAT = _HEAT.with_extremes(under=REST, bad=(0, 0, 0, 0))


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
    dots = dots_of(touch, sim, output, readings[output.name], env)
    dots = replace(dots, would_read=touched(touch, sim, output, readings, env))
    table = touch.taxels[output.sensor]
    norm = Normalize(0.0, float(dots.value.max()) or 1.0)
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    width, height = (FINE * round(part * size * DPI) for part, size in zip(VIEW[2:], SIZE, strict=True))
    draw_dots(figure.add_axes(VIEW), scene_of(touch, sim, dots, env, width, height, view), dots, norm)
    _draw_maps(figure, dots, table, norm)
    resolution = touch.plan.origin.resolution
    figure.text(0.016, 0.955, title or output.name, size=19, weight="bold", color=INK, va="center")
    parts = [output.name] if title else []
    parts += [output.kind, f"resolution {resolution}"] if resolution else [output.kind]
    count = f"{dots.is_touched.sum()} of {len(table)} taxels touched"
    parts += [count + ("" if dots.would_read is None else " before noise"), dots.headline, f"environment {env}"]
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


# The scene ------------------------------------------------------------------------------------------------------------


class Backdrop(NamedTuple):
    """The robot and the felt objects as pixels, row 0 at the bottom, and how they were drawn."""

    image: Array
    shot: Shot
    screen: Screen


def scene_of(
    touch: TactileModule, sim: Simulator, dots: Dots, env: int, width: int, height: int, view: str | None = None
) -> Backdrop:
    """Draw robot and felt objects, seen from where some taxels are in view.

    Args:
        touch: The module.
        sim: The scene.
        dots: The taxels.
        env: Which environment.
        width: Columns, before `FINE` of them become one pixel.
        height: Rows, likewise.
        view: From where; default: see `cameras.best_camera`.
    """
    model, pose = sim.model, Pose(*sim.body_poses(env))
    carriers = {model.body(link.body).id for link in touch.plan.links}
    framed, robot = robot_bodies(model, carriers)
    felt = {model.body(target.body).id for target in touch.plan.objects}
    hand, objects = (solid_of(sim.env_model(env), pose, bodies) for bodies in (robot - felt, felt))
    frame = np.isin(hand.body, list(framed))
    layout, top = touch.plan.layout(), min(framed)
    camera = best_camera(dots, hand, model, layout, pose, top) if view is None else camera_of(view, model, [layout], pose, top)
    box = _window(camera.project(hand.corners[frame] if frame.any() else dots.pos[:, None]), camera.project(objects.corners))
    screen = screen_for(camera, box, width, height)
    shot = rasterise(screen.project(hand.corners), width, height)
    colour = np.where(np.isin(hand.body, list(carriers))[:, None], _LIT, _OTHER)
    image = shaded(np.ones((height, width, 3)), shot, hand, colour, camera, 1.0, screen.scale)
    veil = rasterise(screen.project(objects.corners), width, height)
    veil.face[veil.near < shot.near] = -1
    image = shaded(image, veil, objects, np.broadcast_to(_OBJECT, (len(objects.body), 3)), camera, 0.4, screen.scale)
    return Backdrop(smaller(image, FINE), shot, screen)


def draw_dots(axes: Axes, scene: Backdrop, dots: Dots, norm: Normalize) -> None:
    """Draw taxels on their scene; those behind a surface of the robot as rings if they read, else not at all."""
    screen = scene.screen
    extent = (-0.5, screen.width - 0.5, -0.5, screen.height - 0.5)
    axes.imshow(scene.image, origin="lower", extent=extent, interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    axes.autoscale(False)
    at = screen.project(dots.pos)
    seen = is_seen(dots, at, scene.shot, screen.camera)
    size = np.minimum(dots.size, np.median(dots.size))
    area = (np.clip(0.62 * screen.scale / FINE * size, 3.5, 20.0) * 72 / DPI) ** 2
    shown, hidden, rest = seen & dots.is_read, ~seen & dots.is_read, seen & ~dots.is_read & (dots.size > 0)
    axes.scatter(*at[rest, :2].T, s=0.3 * area[rest], c="#8d949e", linewidths=0, zorder=3)
    ring = _HEAT(norm(dots.value[hidden]))
    axes.scatter(*at[hidden, :2].T, s=0.6 * area[hidden], facecolors="none", edgecolors=list(ring), linewidths=1.0, zorder=4)
    order = np.argsort(dots.value[shown], kind="stable")
    place, value, size = at[shown, :2][order], dots.value[shown][order], area[shown][order]
    axes.scatter(*place.T, s=size, c=value, cmap=_HEAT, norm=norm, edgecolors=INK, linewidths=0.5, zorder=5)
    draw_ruler(axes, screen.scale, screen.width, -44.0)


def draw_ruler(axes: Axes, scale: float, width: int, row: float) -> None:
    """Draw a round number of millimetres at the left of a row [pixel], for a view of `scale` pixels per metre."""
    steps = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000])
    length = steps[np.abs(steps * scale / 1000 / width - 0.12).argmin()]
    end = 8 + length * scale / 1000
    axes.plot([8, end], [row, row], color=INK, linewidth=1.6, solid_capstyle="butt", clip_on=False)
    axes.text(end + 16, row - 1, f"{length} mm", fontsize=9.5, color=INK, va="center")


def _window(hand: Array, objects: Array) -> Array:
    """Return the lower and upper corner of what is to be seen: the hand, and objects unless they are far off."""
    low, high = hand[..., :2].min(axis=(0, 1)), hand[..., :2].max(axis=(0, 1))
    room = 0.3 * (high - low).max()
    if len(objects):
        near = objects[..., :2].reshape(-1, 2)
        near = near[((near > low - room) & (near < high + room)).all(axis=1)]
        low, high = np.vstack([near, [low]]).min(axis=0), np.vstack([near, [high]]).max(axis=0)
    margin = 0.03 * (high - low).max()
    return np.stack([low - margin, high + margin])


# The maps -------------------------------------------------------------------------------------------------------------


def _draw_maps(figure: Figure, dots: Dots, table: Array, norm: Normalize) -> None:
    """Draw one map per link, the most touched first, and the colour bar that all share."""
    links = list(dict.fromkeys(table["link"].tolist()))
    links.sort(key=lambda link: -dots.value[table["link"] == link].sum())
    shown, names = links[:MAX_MAPS], short_names(links)
    columns = int(np.ceil(np.sqrt(len(shown))))
    rows = -(-len(shown) // columns)
    grid = figure.add_gridspec(rows, columns, left=0.60, right=0.985, bottom=0.15, top=0.83, hspace=0.36, wspace=0.16)
    for i, link in enumerate(shown):
        axes = figure.add_subplot(grid[i], anchor="N")
        chosen = np.flatnonzero(table["link"] == link)
        _draw_map(axes, dots.value[chosen], table[chosen], norm)
        axes.set_title(f"{names[link]}\n{dots.summary(chosen)}", fontsize=_TITLE[min(columns, 4)], color=INK, linespacing=1.35)
    if len(links) > MAX_MAPS:
        rest = f"and {len(links) - MAX_MAPS} more links, touched less or not at all"
        figure.text(0.985, 0.912, rest, size=10.5, color=FAINT, ha="right", va="center")
    if dots.is_read.any():
        _draw_scale(figure, dots, norm)
    else:
        figure.text(0.7925, 0.083, f"{dots.quantity}: nothing is touched", size=10.5, color=FAINT, ha="center", va="center")


def _draw_scale(figure: Figure, dots: Dots, norm: Normalize) -> None:
    axes = figure.add_axes((0.645, 0.075, 0.295, 0.016))
    bar = figure.colorbar(ScalarMappable(norm, _HEAT), cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.set_xlabel(f"{dots.label}   (grey: zero)", fontsize=10.5, color=INK)
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
        axes.pcolormesh(np.ma.masked_invalid(cells), cmap=_HEAT, norm=norm, edgecolors="white", linewidth=edge)
        axes.set(aspect="equal", ylim=(len(cells), 0))
        return
    normal = unit(table["normal"].mean(axis=0), table["normal"][0])
    across = table["tangent"].mean(axis=0)
    across = unit(across - (across @ normal) * normal, table["tangent"][0])
    x, y = 1e3 * table["pos"] @ across, 1e3 * table["pos"] @ np.cross(normal, across)
    size = 0.03 * axes.get_window_extent().height * 72 / DPI
    axes.scatter(x[active], y[active], c=shown[active], cmap=_HEAT, norm=norm, s=size**2, linewidths=0)
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
