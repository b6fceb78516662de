"""Readings in the scene of the live page: a disc for each taxel or body, or surfaces of links in the colours of their cells.

Shapes: `row` rows of one reading that are drawn.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import matplotlib
import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import Colormap, Normalize
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor
from trimesh.remesh import subdivide_to_size

from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.view.boxes import boxes_of, is_boxed, norm_between
from tgdsl.view.markers import magnitude, quantity_of, read_now, rows_of
from tgdsl.view.meshes import body_surfaces
from tgdsl.view.style import DISC_RADIUS, HEAT, LIVE_REST, WARMTH

Array = np.ndarray
MAGNITUDE = "magnitude"
LIFT = 2e-4  # how far discs and arrows begin above the surface [m]
_HEAT = HEAT.with_extremes(under="#{:02x}{:02x}{:02x}".format(*LIVE_REST))
_SIGNED = matplotlib.colormaps["coolwarm"]


class Rows(NamedTuple):
    """Rows of a reading in the frames of their bodies."""

    body: Int[Array, " row"]
    link: Array  # names, (row,)
    pos: Float[Array, "row 3"]  # [m]
    normal: Float[Array, "row 3"]  # outward unit normal
    size: Float[Array, " row"]  # width of the patch that a row stands for [m]; 0 marks an inactive filler
    label: list[str]


class Shown(NamedTuple):
    """What the rows read in one environment, and their colours."""

    value: Float[Array, " row"]  # [`unit`]
    unit: str
    quantity: str
    norm: Normalize
    colours: Colormap
    vector: Float[Array, "row 3"] | None = None  # of vectors that are not small, in the frames of their bodies [`unit`]

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return f"{self.quantity} [{self.unit}]"

    @property
    def colour(self) -> UInt8[Array, "row 3"]:
        """The colour of each row."""
        return (255 * np.asarray(self.colours(self.norm(self.value)))[:, :3]).astype(np.uint8)


class Layer(ABC):
    """One reading in the scene. The ends of its colours are the lowest and the highest value so far."""

    total = "sum"  # how rows are summed up: the name of NumPy's function
    output: Output
    channels: tuple[str, ...]  # what it can be coloured by
    rows: Rows

    def __init__(self) -> None:
        self._ends: dict[str, tuple[float, float]] = {}
        self.members: list[tuple[Any, str, Any]] = []  # drawn elements: viser's handle, its link, its row or rows

    def show(self, links: Collection[str]) -> None:
        """Show these links, and hide the others."""
        for handle, link, _ in self.members:
            handle.visible = link in links

    def remove(self) -> None:
        """Take the layer out of the scene."""
        for handle, _, _ in self.members:
            handle.remove()

    @abstractmethod
    def read(self, readings: Tensor, env: int, channel: str) -> Shown:
        """Return what one environment reads; of stacked calls the last one."""

    @abstractmethod
    def paint(self, colour: UInt8[Array, "row 3"]) -> None:
        """Colour the rows."""

    def _widened(self, channel: str, value: Float[Array, " row"]) -> tuple[float, float]:
        """Return the lowest and highest value so far."""
        finite = value[np.isfinite(value)]
        low, high = self._ends.get(channel, (np.inf, -np.inf))
        self._ends[channel] = float(finite.min(initial=low)), float(finite.max(initial=high))
        return self._ends[channel]


def add_discs(
    scene: Any,
    path: str,
    pos: Float[Array, "row 3"],
    normal: Float[Array, "row 3"],
    size: Float[Array, " row"],
    rank: int = 0,
    colour: tuple[int, int, int] = LIVE_REST,
) -> Any:
    """Add a disc for each row to viser's scene; return their handle.

    Args:
        scene: Viser's scene.
        path: Name of the node, below the node of the rows' body.
        pos: Positions in the frame of the body [m].
        normal: Outward unit normals in that frame.
        size: Widths of the patches that rows stand for [m].
        rank: How many readings are drawn below this one.
        colour: Red, green and blue.
    """
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    corners = np.vstack([[0, 0, 0], np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)])
    faces = np.array([[0, 1 + i, 1 + (i + 1) % 16] for i in range(16)])
    turns = [Rotation.align_vectors(n[None], [[0, 0, 1]])[0].as_quat(scalar_first=True) for n in normal]
    return scene.add_batched_meshes_simple(
        path,
        corners,
        faces,
        np.array(turns),
        pos + (1 + rank) * LIFT * normal,
        batched_scales=0.6**rank * np.clip(0.45 * size, *DISC_RADIUS),
        batched_colors=np.tile(np.array(colour, dtype=np.uint8), (len(pos), 1)),
        side="double",
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
    )


class DiscLayer(Layer):
    """A disc at each taxel or body; `rank` is 0 for the chosen reading: others have smaller discs on top."""

    def __init__(
        self, scene: Any, model: mujoco.MjModel, touch: TactileModule, output: Output, rank: int, pick: Callable[[int], None]
    ):
        super().__init__()
        self.output, self.channels = output, (MAGNITUDE, *output.channels)
        names, taxels = rows_of(touch, output)
        body = np.array([model.body(name).id for name in names], dtype=np.int64)
        table = touch.taxels[output.sensor]
        if output.rows == "body":
            links = [str(table["link"][table["body"] == name][0]) for name in names]
            labels = list(names)
        else:
            links = [str(link) for link in table["link"]]
            labels = [f"{link}, taxel {i}" for i, link in enumerate(links)]
        normal = taxels.normal / np.linalg.norm(taxels.normal, axis=1, keepdims=True)
        self.rows = Rows(body, np.array(links), taxels.pos, normal, taxels.size, labels)
        for link, owner in dict.fromkeys(zip(links, body.tolist(), strict=True)):
            rows = np.flatnonzero((body == owner) & (np.array(links) == link) & (taxels.size > 0))
            if not len(rows):
                continue
            path = f"/body{owner}/{output.name}/{link}"
            handle = add_discs(scene, path, taxels.pos[rows], normal[rows], taxels.size[rows], rank)
            handle.on_click(lambda event, rows=rows: pick(int(rows[event.instance_index])))
            self.members.append((handle, link, rows))

    def read(self, readings: Tensor, env: int, channel: str) -> Shown:
        output, values = self.output, read_now(readings, env)
        if channel != MAGNITUDE:
            i = output.channels.index(channel)
            most = max(map(abs, self._widened(channel, values[:, i])))
            return Shown(
                values[:, i], _unit(output.units[i]), channel, Normalize(-most - 1e-9, most + 1e-9, clip=True), _SIGNED
            )
        value = magnitude(values, output.units)
        quantity, vector = quantity_of(output)
        most = max(1e-9, self._widened(channel, value)[1])
        along = values[:, :3] * (value > 0)[:, None] if vector else None
        return Shown(value, _unit(output.units[0]), quantity, Normalize(1e-12, most, clip=False), _HEAT, along)

    def paint(self, colour: UInt8[Array, "row 3"]) -> None:
        for handle, _, rows in self.members:
            handle.batched_colors = colour[rows]


class SurfaceLayer(Layer):
    """The surfaces of links, each triangle in the colour of the nearest cell, as `Boxes.painter` has it."""

    total = "mean"

    def __init__(self, scene: Any, model: mujoco.MjModel, touch: TactileModule, output: Output, pick: Callable[[int], None]):
        super().__init__()
        self.output, self.channels = output, (output.channels[0],)
        boxes = boxes_of(touch, output, torch.zeros(1, *output.shape), 0)
        layout, self._chosen = boxes.layout, boxes.chosen
        self._quantity, self._unit = boxes.label.split(" [")[0], boxes.unit
        links = [layout.links[i] for i in layout.link_id]
        length = np.linalg.norm(layout.normal, axis=1, keepdims=True)
        normal = np.where(length > 1e-6, layout.normal / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])  # cells of a plate: 0
        body = np.array([model.body(link.body).id for link in links], dtype=np.int64)
        labels = [f"{link.body}, cell {i}" for i, link in zip(boxes.chosen, links, strict=True)]
        self.rows = Rows(body, np.array([link.name for link in links]), layout.pos, normal, np.sqrt(layout.area), labels)
        self.bodies = frozenset(body.tolist())  # those whose surface this layer draws
        for i, link in enumerate(layout.links):
            rows = np.flatnonzero(layout.link_id == i)
            owner = model.body(link.body).id
            surfaces = body_surfaces(model, owner, [link])
            if not len(rows) or not surfaces:
                continue
            sides = boxes.size[rows[0]]
            vertices = np.concatenate([each.corners for each in surfaces]).reshape(-1, 3)
            faces = np.arange(len(vertices)).reshape(-1, 3)
            vertices, faces = subdivide_to_size(vertices, faces, float(np.median(sides)), max_iter=20)[:2]
            nearest = KDTree(layout.pos[rows] / sides).query(vertices[faces].mean(axis=1) / sides)[1]
            for cell in np.unique(nearest):
                triangles = vertices[faces[nearest == cell]].reshape(-1, 3)
                places, merged = np.unique(triangles.round(9), axis=0, return_inverse=True)
                row = int(rows[cell])
                name = f"/body{owner}/{output.name}/{link.name}/{row}"
                handle = scene.add_mesh_simple(name, places, merged.reshape(-1, 3), color=LIVE_REST, flat_shading=True)
                handle.on_click(lambda _, row=row: pick(row))
                self.members.append((handle, link.name, row))

    def read(self, readings: Tensor, env: int, channel: str) -> Shown:
        value = read_now(readings, env)[:, 0]
        norm = norm_between(*self._widened(channel, value))
        return Shown(value[self._chosen], self._unit, self._quantity, norm, WARMTH)

    def paint(self, colour: UInt8[Array, "row 3"]) -> None:
        colours = [tuple(rgb) for rgb in colour.tolist()]
        for handle, _, row in self.members:
            handle.color = colours[row]


def layer_of(
    scene: Any, model: mujoco.MjModel, touch: TactileModule, output: Output, rank: int, pick: Callable[[int], None]
) -> Layer:
    """Draw a reading over `rank` others in viser's scene; `pick` is called with the row that a user clicks."""
    if is_boxed(touch, output):
        return SurfaceLayer(scene, model, touch, output, pick)
    return DiscLayer(scene, model, touch, output, rank, pick)


def _unit(unit: str) -> str:
    return {"1": "", "degC": "°C"}.get(unit, unit)
