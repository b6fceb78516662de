"""Readings of boxes: temperatures of a link's cells, or of whole links, where they are in the world and how warm they are.

Shapes: `box` boxes of one reading.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.layout.layout import Layout
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.markers import Markers, Pose, in_world, read_now
from tgdsl.view.scene import Paint, Seen, draw_colour_bar, draw_image, draw_scale_bar, rendered
from tgdsl.view.style import WARMTH

Array = np.ndarray
FLAT = 0.5  # half of the range of the colours where all that is read is the same [the reading's unit]


@dataclass(frozen=True, eq=False)
class Boxes:
    """The boxes of one reading in one environment, and what they read."""

    layout: Layout  # boxes at the surface of their link, as taxels: centre, mean normal and area of the exposed faces
    chosen: Int[Array, " shown"]  # indices of these boxes: the others are inside
    size: Float[Array, "shown 3"]  # their sides, along the axes of their body [m]
    value: Float[Array, " box"]  # reading of each box, hidden ones too
    label: str  # quantity and unit
    unit: str  # as it is printed
    ends: tuple[float, float] | None = None  # lowest and highest value of the colours; None: of the readings

    @property
    def norm(self) -> Normalize:
        """The range of the colours: `ends`, or one that holds all values."""
        if self.ends is not None:
            return Normalize(*self.ends, clip=True)
        return norm_between(float(self.value.min()), float(self.value.max()))

    @property
    def headline(self) -> str:
        """The range of the readings: `temperature 22.00 … 24.13 °C`, or one number where all are equal."""
        ends = dict.fromkeys(f"{end:.2f}" for end in (self.value.min(), self.value.max()))
        return f"{self.label.split(' [')[0]} {' … '.join(ends)} {self.unit}"

    def markers(self, model: mujoco.MjModel, pose: Pose) -> Markers:
        """Return the boxes at the surface as markers; those count as read that differ most from the middle value."""
        bodies = [self.layout.links[i].body for i in self.layout.link_id]
        pos, normal = in_world(model, pose, bodies, self.layout.pos, self.layout.normal)
        away = np.abs(self.value[self.chosen] - np.median(self.value))
        away = np.where(away >= 0.5 * away.max(), away, 0.0) if away.max() > 1e-6 else np.zeros(len(away))
        return Markers(pos, normal, np.sqrt(self.layout.area), away, self.label, self.unit)

    def painter(self, model: mujoco.MjModel, pose: Pose) -> Paint:
        """Return what colours a point of a link's surface: the box there, or the nearest one."""
        members = {
            model.body(link.body).id: np.flatnonzero(self.layout.link_id == i) for i, link in enumerate(self.layout.links)
        }
        colour = WARMTH(self.norm(self.value[self.chosen]))[:, :3]

        def paint(points: Float[Array, "point 3"], body: Int[Array, " point"]) -> Float[Array, "point 3"]:
            result = np.full(points.shape, np.nan)
            for link, boxes in members.items():
                at = np.flatnonzero(body == link)
                if len(at) and len(boxes):
                    local = Rotation.from_quat(pose.quat[link], scalar_first=True).inv().apply(points[at] - pose.pos[link])
                    sides = self.size[boxes[0]]  # the same for all boxes of a link: nearest in sides is the box itself
                    result[at] = colour[boxes[KDTree(self.layout.pos[boxes] / sides).query(local / sides)[1]]]
            return result

        return paint


def norm_between(low: float, high: float) -> Normalize:
    """Return the range from the lowest to the highest value; where both are the same, `FLAT` to either side."""
    return Normalize(low - FLAT, high + FLAT) if high - low < 1e-6 * max(1.0, abs(high)) else Normalize(low, high)


def is_boxed(touch: TactileModule, output: Output) -> bool:
    """Return whether each row of a reading is a box of a link: its table has the box's centre and sides."""
    names = (touch.rows[output.name].dtype.names or ()) if output.name in touch.rows else ()
    return {"pos", "size"} <= set(names) and bool({"link", "body"} & set(names)) and len(output.channels) == 1


def boxes_of(
    touch: TactileModule, output: Output, values: Tensor, env: int, temperatures: tuple[float, float] | None = None
) -> Boxes:
    """Return the boxes of a reading (see `is_boxed`) in one environment, and what they read; of stacked calls the last one.

    `temperatures`: lowest and highest temperature of the colours [°C]; default: of the readings.
    """
    table, links = touch.rows[output.name], touch.plan.sensor_of(output.name).links
    key = "link" if "link" in (table.dtype.names or ()) else "body"
    names = [link.name if key == "link" else link.body for link in links]
    link_id = np.array([names.index(name) for name in table[key]], dtype=np.int64)
    pos, size = table["pos"], table["size"]
    exposed = _exposed(link_id, pos, size)
    visible = np.flatnonzero((exposed > 0).any(axis=(1, 2)))
    exposed, link_id, pos = exposed[visible], link_id[visible], pos[visible]
    area = exposed.sum(axis=(1, 2))
    normal = (exposed[:, 1] - exposed[:, 0]) / area[:, None]  # shorter than 1 at edges, zero for a box with all faces exposed
    unit = "°C" if output.units[0] == "degC" else output.units[0]
    tangent = np.roll(normal, 1, axis=1)
    layout = Layout(links, {}, link_id, pos, normal, tangent, np.sqrt(area), area, np.full((len(area), 2), -1))
    ends = temperatures if unit == "°C" else None
    return Boxes(layout, visible, size[visible], read_now(values, env)[:, 0], f"{output.channels[0]} [{unit}]", unit, ends)


def _exposed(link_id: Int[Array, " box"], pos: Float[Array, "box 3"], size: Float[Array, "box 3"]) -> Float[Array, "box 2 3"]:
    """Return the area of each box's faces, lower and upper across x, y and z, that is on the box of its link [m²]."""
    result = np.zeros((len(pos), 2, 3))
    area = size.prod(axis=1, keepdims=True) / size
    for link in np.unique(link_id):
        members = link_id == link
        low, high, slack = pos[members] - 0.5 * size[members], pos[members] + 0.5 * size[members], 0.1 * size[members]
        result[members, 0] = area[members] * (low < low.min(axis=0) + slack)
        result[members, 1] = area[members] * (high > high.max(axis=0) - slack)
    return result


def draw_boxes(axes: Axes, sim: Simulation, seen: Seen, boxes: Boxes, env: int) -> None:
    """Draw the robot in the colours of the boxes of its links, with a bar that says them; objects are faint."""
    scene = rendered(seen, boxes.painter(sim.model, Pose(*sim.body_poses(env))))
    draw_image(axes, scene.image, scene.viewport)
    draw_scale_bar(axes, scene.viewport, -44.0)
    draw_colour_bar(axes.inset_axes((0.46, -0.06, 0.5, 0.022)), boxes.norm, WARMTH, boxes.label)
