"""What taxels read over a run, for a video: each as a coloured sphere in MuJoCo's scene, and a bar for each link.

Shapes: `step` control steps, `link` links with a bar.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import to_rgb
from torch import Tensor

from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.view.markers import Pose, in_world, magnitude, read_now
from tgdsl.view.picture import MAX_MAPS, short_names
from tgdsl.view.style import DPI, HEAT, INK, REST, new_figure, pixels_of, shortened

Array = np.ndarray
RADIUS = (0.16, 0.36)  # of the sphere of a taxel that reads nothing, or something, as a part of its patch's width
_ROW, _LABELS, _WIDTH = 18, 120, 300  # height of a bar's row, width of the names, and of all [pixel]
_LETTERS = 18  # of a name, from its end


class TouchTrace:
    """Readings of the taxels of one environment over a run."""

    def __init__(self, touch: TactileModule, output: Output, num_steps: int):
        self._table, self._output = touch.taxels[output.sensor], output
        # magnitude of each taxel's reading at the start of each control step [the reading's unit]; 0 until it is added
        self.values: Float[Array, "step taxel"] = np.zeros((num_steps, len(self._table)))

    def add(self, step: int, readings: Mapping[str, Tensor], env: int = 0) -> None:
        """Keep what an environment reads at the start of a control step; steps beyond the last are left out."""
        if step < len(self.values):
            self.values[step] = magnitude(read_now(readings[self._output.name], env), self._output.units)

    def draw(self, scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData, step: int) -> None:
        """Add the taxels to a scene: colours run to the largest reading of the run; what reads nothing is small and grey."""
        table, value = self._table, self.values[step]
        pos, _ = in_world(model, Pose(data.xpos, data.xquat), table["body"], table["pos"], table["normal"])
        colour = np.array(HEAT(np.where(value > 0, value / (self.values.max() or 1.0), -1.0))).astype(np.float32)
        size = np.sqrt(table["area"]) * np.where(value > 0, RADIUS[1], RADIUS[0])
        sphere, turn = mujoco.mjtGeom.mjGEOM_SPHERE, np.eye(3).ravel()
        for i in np.flatnonzero(table["radius"] > 0)[: scene.maxgeom - scene.ngeom]:
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], sphere, np.full(3, size[i]), pos[i], turn, colour[i])
            scene.ngeom += 1

    def bars(self) -> LinkBars:
        """Return the bars of the links: sums of magnitudes, or the largest of lengths and of contact bits."""
        links = list(dict.fromkeys(self._table["link"].tolist()))
        reduce = np.sum if self._output.units[0] in ("N", "N·m") else np.max
        each = np.stack([reduce(self.values[:, self._table["link"] == link], axis=1) for link in links], axis=1)
        link_ids = np.sort(np.argsort(-each.max(axis=0, initial=0.0), kind="stable")[:MAX_MAPS])
        names, unit = short_names(links), self._output.units[0]
        stem = self._output.channels[0].removesuffix("_x")
        full = float(each.max(initial=0.0))
        quantity = f"Σ |{stem}|" if reduce is np.sum else f"largest {stem}"
        title = f"{quantity}, full: {full:.3g} {'' if unit == '1' else unit}; spheres: up to {self.values.max(initial=0.0):.2g}"
        return LinkBars(tuple(names[links[i]] for i in link_ids), each[:, link_ids] / (full or 1.0), title.strip())


class LinkBars:
    """Bars at the lower left of a frame; `parts` is how full each is at each step, from 0 to 1."""

    def __init__(self, names: tuple[str, ...], parts: Float[Array, "step link"], title: str):
        self.parts = parts
        height = _ROW * (len(names) + 1)
        figure = new_figure(_WIDTH / DPI, height / DPI)
        figure.text(6 / _WIDTH, 1 - 9 / height, title, size=7.5, color=INK, va="center")
        for i, name in enumerate(names):
            y = 1 - (_ROW * (i + 1) + 9) / height
            figure.text((_LABELS - 6) / _WIDTH, y, shortened(name, _LETTERS), size=7.5, color=INK, ha="right", va="center")
        self._labels = pixels_of(figure)

    def draw(self, frame: UInt8[Array, "row column 3"], step: int) -> UInt8[Array, "row column 3"]:
        """Return a frame with the bars of a step over it."""
        panel = self._labels.copy()
        for i, part in enumerate(self.parts[step]):
            rows = slice(_ROW * (i + 1) + 4, _ROW * (i + 2) - 4)
            room = _WIDTH - _LABELS - 8
            panel[rows, _LABELS : _LABELS + room] = np.round(255 * np.array(to_rgb(REST)))
            panel[rows, _LABELS : _LABELS + round(room * part)] = np.round(255 * np.array(HEAT(part)[:3]))
        drawn = frame.copy()
        under = drawn[-panel.shape[0] :, : panel.shape[1]]
        under[:] = np.round(0.15 * under + 0.85 * panel)
        return drawn
