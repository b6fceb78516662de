"""Pictures of touch: the robot with its taxels coloured by reading, beside one heat map per link. Matplotlib's Agg, no display.

Shapes: `taxel` taxels of one sensor, `face` triangles, `h` and `w` rows and columns of pixels, row 0 at the bottom.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os.path import commonprefix
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
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
VIEW = (0.012, 0.02, 0.55, 0.86)  # the 3-D view in the figure: left, bottom, width, height
MAX_MAPS = 12
INK, FAINT, REST = "#2b2f36", "#7b828c", "#d3d6da"
_LIT, _OTHER, _OBJECT = np.array([0.83, 0.84, 0.86]), np.array([0.60, 0.62, 0.66]), np.array([0.33, 0.55, 0.83])
_HEAT = LinearSegmentedColormap.from_list("touch", matplotlib.colormaps["YlOrRd"](np.linspace(0.22, 1, 256)))
_HEAT = _HEAT.with_extremes(under=REST, bad=(0, 0, 0, 0))
_PRIMITIVES = {
    GeomType.mjGEOM_BOX: lambda size: trimesh.creation.box(2 * size),
    GeomType.mjGEOM_SPHERE: lambda size: trimesh.creation.icosphere(subdivisions=3, radius=size[0]),
    GeomType.mjGEOM_ELLIPSOID: lambda size: trimesh.creation.icosphere(subdivisions=3).apply_scale(size),
    GeomType.mjGEOM_CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2 * size[1], sections=64),
    GeomType.mjGEOM_CAPSULE: lambda size: trimesh.creation.capsule(
        2 * size[1], size[0], count=[32, 32], transform=trimesh.transformations.translation_matrix([0, 0, -size[1]])
    ),
}


class ViewError(TgdslError):
    """A picture that cannot be drawn of what was given."""


@dataclass(frozen=True, eq=False)
class Dots:
    """The taxels of one sensor in one environment, and what they read.

    Attributes:
        pos: Position in the world [m].
        normal: Outward unit normal in the world.
        size: Width of the patch that the taxel stands for [m].
        value: Magnitude of the reading, in `unit`.
        quantity: What is read, such as `force`.
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


class Camera(NamedTuple):
    """An orthographic camera: image axes and viewing direction as unit vectors of the world, and a point that it looks at."""

    right: Float[Array, "3"]
    up: Float[Array, "3"]
    toward: Float[Array, "3"]
    centre: Float[Array, "3"]

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
    parts += [f"{dots.is_read.sum()} of {len(table)} taxels touched", _summary(dots, slice(None)), f"environment {env}"]
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
    stem = commonprefix([output.channels[i] for i in same]).rstrip("_")
    unit = "" if output.units[0] == "1" else output.units[0]
    if unit and 0 < value.max() < 0.1:
        value, unit = (1e3 * value, f"m{unit}") if value.max() >= 1e-4 else (1e6 * value, f"µ{unit}")
    return Dots(
        pos=sim.batch.xpos[env][body] + rotation.apply(table["pos"]),
        normal=rotation.apply(table["normal"]),
        size=np.sqrt(table["area"]),
        value=value,
        quantity=stem or output.name,
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


def _summary(dots: Dots, chosen: Any) -> str:
    """Return the sum (of forces and the like, not of depths) and the maximum of some taxels."""
    value, unit = dots.value[chosen], f" {dots.unit}" if dots.unit else ""
    if not dots.unit:
        return f"sum {value.sum():.3g}"
    total = "" if dots.unit.endswith("m") and "·" not in dots.unit else f"sum |{dots.quantity}| {value.sum():.3g}{unit}, "
    return f"{total}max {value.max():.3g}{unit}"
