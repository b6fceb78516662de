"""Pictures of touch: the robot with its taxels coloured by reading, beside one heat map per link. Matplotlib's Agg, no display.

Shapes: `taxel` taxels of one sensor, `face` triangles, `h` and `w` rows and columns of pixels, row 0 at the bottom.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import matplotlib
import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.module import Output, TactileModule
from tgdsl.runtime.batch import BatchSimulation

Array = np.ndarray
GeomType = mujoco.mjtGeom
SIZE, DPI = (16.0, 9.0), 100
VIEW = (0.0125, 0.06, 0.55, 0.82)  # the 3-D view in the figure: left, bottom, width, height
FINE = 2  # pixels of the 3-D view per pixel of the file, along each axis
MAX_MAPS = 12
INK, FAINT, REST = "#2b2f36", "#7b828c", "#d3d6da"
_LIT, _OTHER, _OBJECT = np.array([0.83, 0.84, 0.86]), np.array([0.60, 0.62, 0.66]), np.array([0.33, 0.55, 0.83])
_HEAT = LinearSegmentedColormap.from_list("touch", matplotlib.colormaps["YlOrRd"](np.linspace(0.2, 0.93, 256)))
_HEAT = _HEAT.with_extremes(under=REST, bad=(0, 0, 0, 0))
_PRIMITIVES = {
    GeomType.mjGEOM_BOX: lambda size: trimesh.creation.box(2 * size),
    GeomType.mjGEOM_SPHERE: lambda size: trimesh.creation.icosphere(subdivisions=3, radius=size[0]),
    GeomType.mjGEOM_ELLIPSOID: lambda size: trimesh.creation.icosphere(subdivisions=3).apply_scale(size),
    GeomType.mjGEOM_CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2 * size[1], sections=64),
    GeomType.mjGEOM_CAPSULE: lambda size: trimesh.creation.capsule(2 * size[1], size[0], count=[32, 32]),
}


class ViewError(TgdslError):
    """A picture that cannot be drawn of what was given."""


@dataclass(frozen=True, eq=False)
class Dots:
    """The taxels of one sensor in one environment, and what they read.

    Attributes:
        pos: Position in the world [m].
        normal: Outward unit normal in the world.
        size: Width of the patch that the taxel stands for [m]; 0 marks an inactive filler.
        value: Magnitude of the reading, in `unit`.
        quantity: What is read, such as `|force|`.
        unit: Its unit, with the prefix that suits the values; empty for plain numbers.
    """

    pos: Float[Array, "taxel 3"]
    normal: Float[Array, "taxel 3"]
    size: Float[Array, " taxel"]
    value: Float[Array, " taxel"]
    quantity: str
    unit: str

    @property
    def is_read(self) -> Bool[Array, " taxel"]:
        """Which taxels read anything: those that are coloured."""
        return self.value > 0

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return f"{self.quantity} [{self.unit}]" if self.unit else self.quantity

    def summary(self, chosen: Int[Array, " chosen"] | slice = slice(None)) -> str:
        """Return the sum of some taxels' magnitudes, unless they are lengths, and the largest."""
        value, unit = self.value[chosen], f" {self.unit}" if self.unit else ""
        if not value.any():
            return f"0{unit}"
        total = "" if self.unit in ("m", "mm", "µm") else f"Σ {value.sum():.3g}{unit}"
        most = f"max {value.max():.2g}{unit}" if self.unit else ""
        return " · ".join(part for part in (total, most) if part)


def picture(
    touch: TactileModule,
    sim: BatchSimulation,
    readings: Mapping[str, Tensor],
    path: Path,
    *,
    env: int = 0,
    reading: str | None = None,
    title: str = "",
) -> Path:
    """Draw one reading of one environment: the robot with its taxels, and a heat map per link.

    Args:
        touch: The module.
        sim: The scene, at the instant of the readings.
        readings: What the module read, by name.
        path: PNG file to write; its folder is made if need be.
        env: Which environment.
        reading: Which reading; default: a kinematic taxel's, if there is any, or else the first.
        title: What to write above it all; default: the reading's name.

    Returns:
        The path.

    Raises:
        ViewError: If there is no such reading or environment.
    """
    output = _chosen(touch, readings, reading)
    if not 0 <= env < sim.num_envs:
        raise ViewError(f"environment {env} does not exist, expected 0 to {sim.num_envs - 1}")
    dots = dots_of(touch, sim, output, readings[output.name], env)
    table = touch.taxels[_sensor(touch, output.name)]
    norm = Normalize(0.0, float(dots.value.max()) or 1.0)
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    _draw_scene(figure.add_axes(VIEW), touch, sim, dots, table, env, norm)
    _draw_maps(figure, dots, table, norm)
    resolution = touch.plan.origin.resolution
    figure.text(0.016, 0.955, title or output.name, size=19, weight="bold", color=INK, va="center")
    parts = [output.name] if title else []
    parts += [output.kind, f"resolution {resolution}"] if resolution else [output.kind]
    parts += [f"{dots.is_read.sum()} of {len(table)} taxels touched", f"{dots.quantity} {dots.summary()}", f"environment {env}"]
    figure.text(0.016, 0.912, "   ·   ".join(parts), size=11.5, color=FAINT, va="center")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")
    return path


def dots_of(touch: TactileModule, sim: BatchSimulation, output: Output, values: Tensor, env: int) -> Dots:
    """Return where the taxels of a reading are in one environment, and the magnitude of what they read.

    Args:
        touch: The module.
        sim: The scene, at the instant of the reading.
        output: Which reading; its magnitude is the norm over the channels that share the first one's unit.
        values: The reading of all environments.
        env: Which environment.
    """
    table = touch.taxels[_sensor(touch, output.name)]
    body = np.array([sim.model.body(name).id for name in table["body"]])
    rotation = Rotation.from_quat(sim.batch.xquat[env][body], scalar_first=True)
    same = [i for i, unit in enumerate(output.units) if unit == output.units[0]]
    value = np.linalg.norm(values[env].detach().cpu().double().numpy()[:, same], axis=1)
    stem = output.channels[0].removesuffix("_x")
    unit = "" if output.units[0] == "1" else output.units[0]
    if unit and 0 < value.max() < 0.1:
        value, unit = (1e3 * value, f"m{unit}") if value.max() >= 1e-4 else (1e6 * value, f"µ{unit}")
    return Dots(
        pos=sim.batch.xpos[env][body] + rotation.apply(table["pos"]),
        normal=rotation.apply(table["normal"]),
        size=np.sqrt(table["area"]) * (table["radius"] > 0),
        value=value,
        quantity=f"|{stem}|" if len(same) > 1 else stem,
        unit=unit,
    )


def _chosen(touch: TactileModule, readings: Mapping[str, Tensor], name: str | None) -> Output:
    known = {output.name: output for output in touch.outputs if output.name in readings}
    if not known:
        raise ViewError("there is nothing to draw: the readings given hold none of this module's")
    if name is None:
        return next((output for output in known.values() if output.kind == "kinematic_taxel"), next(iter(known.values())))
    if name not in known:
        raise ViewError(f'there is no reading "{name}"; {did_you_mean(name, known, "readings")}')
    return known[name]


def _sensor(touch: TactileModule, reading: str) -> str:
    return next(sensor.name for sensor in touch.plan.sensors if reading in sensor.readings)


# The scene ------------------------------------------------------------------------------------------------------------


def _draw_scene(
    axes: Axes, touch: TactileModule, sim: BatchSimulation, dots: Dots, table: Array, env: int, norm: Normalize
) -> None:
    """Draw robot, felt objects and taxels; those behind a surface of the robot as rings if they read, else not at all."""
    model = sim.model
    carriers = {model.body(name).id for name in table["body"]}
    framed, robot = _robot_bodies(model, carriers)
    felt = {model.body(target.body).id for target in touch.plan.objects}
    hand, objects = (solid_of(sim, env, bodies) for bodies in (robot - felt, felt))
    frame = np.isin(hand.body, list(framed))
    camera = camera_for(dots, sim.batch.xpos[env][min(framed)])
    box = _window(camera.project(hand.corners[frame] if frame.any() else dots.pos[:, None]), camera.project(objects.corners))
    width, height = (FINE * round(part * size * DPI) for part, size in zip(VIEW[2:], SIZE, strict=True))
    scale = min(width / (box[1, 0] - box[0, 0]), height / (box[1, 1] - box[0, 1]))
    corner = box.mean(axis=0) - np.array([width, height]) / 2 / scale

    def pixels(points: Array) -> Array:
        placed = camera.project(points)
        placed[..., :2] = (placed[..., :2] - corner) * scale
        return placed

    shot = rasterise(pixels(hand.corners), width, height)
    colour = np.where(np.isin(hand.body, list(carriers))[:, None], _LIT, _OTHER)
    image = _shaded(np.ones((height, width, 3)), shot, hand, colour, camera, 1.0, scale)
    veil = rasterise(pixels(objects.corners), width, height)
    veil.face[veil.near < shot.near] = -1
    image = _shaded(image, veil, objects, np.broadcast_to(_OBJECT, (len(objects.body), 3)), camera, 0.4, scale)
    image = image.reshape(height // FINE, FINE, width // FINE, FINE, 3).mean(axis=(1, 3))
    axes.imshow(image, origin="lower", extent=(-0.5, width - 0.5, -0.5, height - 0.5), interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    axes.autoscale(False)
    _draw_dots(axes, pixels(dots.pos), is_seen(dots, pixels(dots.pos), shot, camera), dots, norm, scale)
    _draw_ruler(axes, scale, width)


def _draw_dots(axes: Axes, at: Array, seen: Array, dots: Dots, norm: Normalize, scale: float) -> None:
    size = np.minimum(dots.size, np.median(dots.size))
    area = (np.clip(0.62 * scale / FINE * size, 3.5, 20.0) * 72 / DPI) ** 2
    shown, hidden, rest = seen & dots.is_read, ~seen & dots.is_read, seen & ~dots.is_read & (dots.size > 0)
    axes.scatter(*at[rest, :2].T, s=0.3 * area[rest], c="#8d949e", linewidths=0, zorder=3)
    ring = _HEAT(norm(dots.value[hidden]))
    axes.scatter(*at[hidden, :2].T, s=0.6 * area[hidden], facecolors="none", edgecolors=list(ring), linewidths=1.0, zorder=4)
    order = np.argsort(dots.value[shown], kind="stable")
    place, value, size = at[shown, :2][order], dots.value[shown][order], area[shown][order]
    axes.scatter(*place.T, s=size, c=value, cmap=_HEAT, norm=norm, edgecolors=INK, linewidths=0.5, zorder=5)


def _draw_ruler(axes: Axes, scale: float, width: int) -> None:
    steps = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000])
    length = steps[np.abs(steps * scale / 1000 / width - 0.12).argmin()]
    end = 8 + length * scale / 1000
    axes.plot([8, end], [-44, -44], color=INK, linewidth=1.6, solid_capstyle="butt", clip_on=False)
    axes.text(end + 16, -45, f"{length} mm", fontsize=9.5, color=INK, va="center")


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


def _robot_bodies(model: mujoco.MjModel, carriers: set[int]) -> tuple[set[int], set[int]]:
    """Return the bodies to fit in the view (the smallest subtree that holds all taxels), and all of the robot's."""
    above = [[0]]
    for body in range(1, model.nbody):
        above.append([*above[model.body_parentid[body]], body])
    roots = {int(model.body_rootid[body]) for body in carriers}
    robot = {body for body in range(model.nbody) if model.body_rootid[body] in roots}
    top = max(set.intersection(*(set(above[body]) for body in carriers)))
    return {body for body in robot if top in above[body]}, robot


# Camera, triangles and pixels -----------------------------------------------------------------------------------------


class Camera(NamedTuple):
    """An orthographic camera: image axes and viewing direction as unit vectors of the world, and a point that it looks at."""

    right: Float[Array, " 3"]
    up: Float[Array, " 3"]
    toward: Float[Array, " 3"]
    centre: Float[Array, " 3"]

    def project(self, points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return image x, image y and nearness to the camera [m], from the centre."""
        return (points - self.centre) @ np.stack([self.right, self.up, self.toward]).T


class Solid(NamedTuple):
    """Triangles in the world: corners [m], unit normals at the corners, and the body of each."""

    corners: Float[Array, "face 3 3"]
    normals: Float[Array, "face 3 3"]
    body: Int[Array, " face"]


class Shot(NamedTuple):
    """What each pixel shows: nearness [m] (−inf: nothing), the face, and the weights of its corners."""

    near: Float[Array, "h w"]
    face: Int[Array, "h w"]
    weights: Float[Array, "h w 3"]


def camera_for(dots: Dots, root: Float[Array, " 3"]) -> Camera:
    """Return a camera that the most strongly read taxels face, a little from the side.

    Args:
        dots: The taxels; where none reads anything, all count alike.
        root: Where the hand begins [m]: the image's up is the world's, or else leads away from here.
    """
    weight = dots.value if dots.is_read.any() else np.ones(len(dots.value))
    toward = _unit(weight @ dots.normal, np.array([0.0, 0.0, 1.0]))
    along = dots.pos.mean(axis=0) - root
    for up in (np.array([0.0, 0.0, 1.0]), along, np.array([0.0, 1.0, 0.0])):
        across = up - (up @ toward) * toward
        if np.linalg.norm(across) > 0.5 * np.linalg.norm(up) > 0:
            break
    up = _unit(across, up)
    toward = _unit(toward - 0.38 * up + 0.28 * np.cross(up, toward), toward)
    right = _unit(np.cross(up, toward), up)
    return Camera(right, np.cross(toward, right), toward, dots.pos.mean(axis=0))


def is_seen(dots: Dots, at: Array, shot: Shot, camera: Camera) -> Bool[Array, " taxel"]:
    """Return which taxels face the camera with nothing of the robot between."""
    height, width = shot.near.shape
    column = np.clip(np.rint(at[:, 0]), 0, width - 1).astype(int)
    row = np.clip(np.rint(at[:, 1]), 0, height - 1).astype(int)
    slack = np.maximum(0.2 * dots.size, 5e-4)  # [m] for taxels a little under the surface
    return (dots.normal @ camera.toward > 0) & (at[:, 2] + slack >= shot.near[row, column])


def solid_of(sim: BatchSimulation, env: int, bodies: set[int]) -> Solid:
    """Return the triangles of some bodies in one environment: of their geoms that collide, or else of all; planes not."""
    model = sim.model
    parts = [Solid(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0, dtype=np.int64))]
    for body in sorted(bodies):
        own = [i for i in range(model.ngeom) if model.geom_bodyid[i] == body]
        for geom in [i for i in own if model.geom_contype[i] or model.geom_conaffinity[i]] or own:
            corners, normals = _triangles(model, geom)
            in_body = Rotation.from_quat(model.geom_quat[geom], scalar_first=True)
            in_world = Rotation.from_quat(sim.batch.xquat[env][body], scalar_first=True)
            centre = sim.batch.xpos[env][body] + in_world.apply(model.geom_pos[geom])
            matrix = (in_world * in_body).as_matrix().T
            parts.append(Solid(corners @ matrix + centre, normals @ matrix, np.full(len(corners), body)))
    return Solid(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _triangles(model: mujoco.MjModel, geom: int) -> tuple[Float[Array, "face 3 3"], Float[Array, "face 3 3"]]:
    """Return corners and normals of a geom in its own frame; none of one without a bounded surface."""
    kind, mesh = GeomType(int(model.geom_type[geom])), int(model.geom_dataid[geom])
    if kind in (GeomType.mjGEOM_MESH, GeomType.mjGEOM_SDF) and mesh >= 0:
        first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertices = model.mesh_face[first : first + count] + model.mesh_vertadr[mesh]
        normals = model.mesh_facenormal[first : first + count] + model.mesh_normaladr[mesh]
        return model.mesh_vert[vertices].astype(np.float64), model.mesh_normal[normals].astype(np.float64)
    if kind not in _PRIMITIVES:
        return np.zeros((0, 3, 3)), np.zeros((0, 3, 3))
    shape = _PRIMITIVES[kind](model.geom_size[geom])
    shape.apply_translation(-shape.bounds.mean(axis=0))  # trimesh puts capsules elsewhere in some versions
    flat = kind in (GeomType.mjGEOM_BOX, GeomType.mjGEOM_CYLINDER)
    return np.array(shape.triangles), shape.face_normals[:, None].repeat(3, axis=1) if flat else shape.vertex_normals[
        shape.faces
    ]


def rasterise(corners: Float[Array, "face 3 3"], width: int, height: int) -> Shot:
    """Return what each pixel shows: the nearest triangle, by z-buffer.

    Args:
        corners: Corners as (column [pixel], row [pixel], nearness [m]).
        width: Number of columns.
        height: Number of rows.
    """
    face, row, left, right = _spans(corners, width, height)
    count = np.maximum(right - left + 1, 0)
    inside = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    face, row, column = np.repeat(face, count), np.repeat(row, count), np.repeat(left, count) + inside
    edges = corners[:, 1:, :2] - corners[:, :1, :2]
    inverse = np.linalg.pinv(edges) if len(edges) else edges
    relative = np.stack([column, row], axis=-1) - corners[face, 0, :2]
    second = np.einsum("pi,pij->pj", relative, inverse[face])
    weights = np.clip(np.column_stack([1 - second.sum(axis=1), second]), 0, 1)
    nearness = (weights * corners[face, :, 2]).sum(axis=1)
    pixel = row * width + column
    near = np.full(height * width, -np.inf)
    np.maximum.at(near, pixel, nearness)
    won = nearness == near[pixel]
    shot = Shot(near, np.full(height * width, -1), np.zeros((height * width, 3)))
    shot.face[pixel[won]] = face[won]
    shot.weights[pixel[won]] = weights[won]
    return Shot(*(part.reshape(height, width, *part.shape[1:]) for part in shot))


def _spans(corners: Array, width: int, height: int) -> tuple[Array, Array, Array, Array]:
    """Return face, row, first and last column of each run of pixels that a triangle covers in a row."""
    low = np.clip(np.ceil(corners[:, :, 1].min(axis=1)), 0, height).astype(int)
    high = np.clip(np.floor(corners[:, :, 1].max(axis=1)), -1, height - 1).astype(int)
    count = np.maximum(high - low + 1, 0)
    face = np.repeat(np.arange(len(corners)), count)
    row = np.repeat(low, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    left, right = np.full(len(face), np.inf), np.full(len(face), -np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        (x, y), (x_end, y_end) = corners[face, first, :2].T, corners[face, second, :2].T
        rise = np.where(y_end == y, np.nan, y_end - y)
        part = (row - y) / rise
        crossing = np.where((part >= 0) & (part <= 1), x + part * (x_end - x), np.nan)
        left, right = np.fmin(left, crossing), np.fmax(right, crossing)
    left, right = np.where(left > right, 1, left), np.where(left > right, 0, right)
    first = np.clip(np.ceil(left - 1e-9), 0, width).astype(int)
    return face, row, first, np.clip(np.floor(right + 1e-9), -1, width - 1).astype(int)


def _shaded(image: Array, shot: Shot, solid: Solid, colour: Array, camera: Camera, opacity: float, scale: float) -> Array:
    """Return the image with a solid drawn over it: lit from the upper right, edges in depth drawn dark."""
    drawn = shot.face >= 0
    face, weights = shot.face[drawn], shot.weights[drawn]
    normal = np.einsum("pi,pij->pj", weights, solid.normals[face])
    normal *= np.where(normal @ camera.toward < 0, -1, 1)[:, None]
    light = _unit(0.85 * camera.toward + 0.4 * camera.up + 0.35 * camera.right, camera.toward)
    lit = 0.55 + 0.5 * np.clip(normal @ light, 0, 1)
    image[drawn] += opacity * (np.minimum(colour[face] * lit[:, None], 1) - image[drawn])
    near = np.where(drawn, shot.near, -1.0)
    jump = np.maximum(*(np.abs(np.diff(near, axis=axis, append=near.take([-1], axis))) for axis in (0, 1)))
    image[jump > np.maximum(6 / scale, 0.002)] *= 0.62
    return image


def _unit(vector: Array, otherwise: Array) -> Array:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else otherwise


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
        axes.set_title(f"{names[link]}\n{dots.summary(chosen)}", fontsize=9 if columns > 2 else 11, color=INK, linespacing=1.35)
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
    normal = _unit(table["normal"].mean(axis=0), table["normal"][0])
    across = table["tangent"].mean(axis=0)
    across = _unit(across - (across @ normal) * normal, table["tangent"][0])
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
