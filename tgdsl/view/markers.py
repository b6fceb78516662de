"""Taxels and readings as markers: where they are in the world, how much they read, and which of them a camera shows.

Shapes: `taxel` taxels of one sensor or layout, `body` bodies of the model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.layout.layout import Layout
from tgdsl.module.memory import Memory, last_step
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.raster import Camera, Fragments

Array = np.ndarray
# magnitude up to which a reading is rounding: it is not drawn, not counted, and printed as 0 [the unit itself]
THRESHOLDS = {"N": 1e-3, "N·m": 1e-6, "m": 1e-6, "Pa": 1.0}
_PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"))


class Pose(NamedTuple):
    """Bodies in the world at one instant: origins [m], and orientations as quaternions w, x, y, z."""

    pos: Float[Array, "body 3"]
    quat: Float[Array, "body 4"]


@dataclass(frozen=True, eq=False)
class Taxels:
    """Taxels in one frame."""

    pos: Float[Array, "taxel 3"]  # [m]
    normal: Float[Array, "taxel 3"]  # outward unit normal
    size: Float[Array, " taxel"]  # width of the patch that the taxel stands for [m]; 0 marks an inactive filler


@dataclass(frozen=True, eq=False)
class Markers(Taxels):
    """The rows of one reading in one environment: taxels, or bodies, and what they read."""

    value: Float[Array, " taxel"]  # magnitude of the reading, in `unit`; 0 where it does not exceed `threshold`
    quantity: str  # name of the quantity, such as `|force|`
    unit: str  # with the prefix that suits the values; empty for plain numbers
    vector: Float[Array, "taxel 3"] | None = None  # the reading itself in the world, in SI units, if it is a vector
    scale: float = 1.0  # converts SI units to `unit`
    would_read: Bool[Array, " taxel"] | None = None  # whether each would read anything without noise; None: as `is_read`
    threshold: float = 0.0  # see `THRESHOLDS` [SI]; 0: any non-zero reading counts

    @property
    def is_read(self) -> Bool[Array, " taxel"]:
        """Which taxels read anything: these are coloured."""
        return self.value > 0

    @property
    def is_touched(self) -> Bool[Array, " taxel"]:
        """Which taxels read anything apart from noise: these are counted."""
        return self.is_read if self.would_read is None else self.would_read

    @property
    def threshold_label(self) -> str:
        """The threshold with a suitable prefix, such as `1 mN`; empty without a threshold."""
        base = self.unit if self.scale == 1.0 else self.unit[1:]
        factor, prefix = next(((f, p) for f, p in _PREFIXES if f * self.threshold >= 0.1), _PREFIXES[0])
        return f"{factor * self.threshold:g} {prefix}{base}" if self.threshold else ""

    @property
    def colour_label(self) -> str:
        """Label of the colours: quantity, unit, and the values drawn in grey."""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{self.quantity}{unit}   (grey: {f'up to {self.threshold_label}' if self.threshold else 'zero'})"

    def summary(self, chosen: Int[Array, " chosen"] | slice = slice(None)) -> str:
        """Return the sum of some taxels, unless they are lengths, and the largest magnitude.

        Vectors of a link are summed as vectors, `|Σ|`, as the table of `tgdsl run` does; magnitudes as they are, `Σ`.
        """
        value, unit = self.value[chosen], f" {self.unit}" if self.unit else ""
        if not value.any():
            return f"0{unit}"
        most = f"max {value.max():.2g}{unit}"
        if self._is_length:
            return most
        total = f"Σ {_number(value.sum())}" if self.vector is None else f"|Σ| {self._net(chosen)}"
        return f"{total}{unit} · {most}" if unit else total

    @property
    def headline(self) -> str:
        """All taxels: `Σ |force| 22.5 · |Σ force| 2.45 · max 0.3 N`. The forces of opposed fingers cancel in the second."""
        if self.vector is None or not self.value.any() or self._is_length:
            return f"{self.quantity} {self.summary()}"
        net = f"|Σ {self.quantity.strip('|')}| {self._net(slice(None))}"
        return f"Σ {self.quantity} {_number(self.value.sum())} · {net} · max {self.value.max():.2g} {self.unit}"

    @property
    def _is_length(self) -> bool:
        return self.unit in ("m", "mm", "µm")

    def _net(self, chosen: Int[Array, " chosen"] | slice) -> str:
        assert self.vector is not None
        size = float(np.linalg.norm(self.vector[chosen].sum(axis=0)))
        return _number(self.scale * size if size > self.threshold else 0.0)


def _number(number: float) -> str:
    return f"{number:.{3 if number >= 0.1 else 2}g}"


def taxels_of(model: mujoco.MjModel, pose: Pose, layout: Layout) -> Taxels:
    """Return a layout's taxels in the world."""
    bodies = [layout.links[i].body for i in layout.link_id]
    return Taxels(*in_world(model, pose, bodies, layout.pos, layout.normal), np.sqrt(layout.area) * (layout.radius > 0))


def in_world(
    model: mujoco.MjModel, pose: Pose, bodies: Iterable[str], pos: Float[Array, "taxel 3"], normal: Float[Array, "taxel 3"]
) -> tuple[Float[Array, "taxel 3"], Float[Array, "taxel 3"]]:
    """Return positions and normals in the world of taxels in the frames of their bodies, which go by name."""
    body = np.array([model.body(name).id for name in bodies], dtype=np.int64)
    rotation = Rotation.from_quat(pose.quat[body], scalar_first=True)
    return pose.pos[body] + rotation.apply(np.array(pos)), rotation.apply(np.array(normal))  # SciPy wants writable arrays


def rows_of(touch: TactileModule, output: Output) -> tuple[list[str], Taxels]:
    """Return the bodies of a reading's rows, by name, and the rows in their frames; a body's row is amid its taxels."""
    table = touch.taxels[output.sensor]
    taxels = Taxels(np.array(table["pos"]), np.array(table["normal"]), np.sqrt(table["area"]) * (table["radius"] > 0))
    if output.rows != "body":
        return list(table["body"]), taxels
    member = [table["body"] == name for name in output.bodies]
    parts = (taxels.pos, taxels.normal, 3 * taxels.size)
    return list(output.bodies), Taxels(*(np.array([part[mask].mean(axis=0) for mask in member]) for part in parts))


def read_now(values: Tensor, env: int) -> Float[Array, "row channel"]:
    """Return what one environment reads; of stacked calls the last one."""
    return last_step(values)[env].detach().cpu().double().numpy()


def markers_of(touch: TactileModule, sim: Simulation, output: Output, values: Tensor, env: int) -> Markers:
    """Return where the rows of a reading are in one environment, and their magnitudes; of stacked calls the last one's."""
    bodies, rows = rows_of(touch, output)
    pose = Pose(*sim.body_poses(env))
    pos, normal = in_world(sim.model, pose, bodies, rows.pos, rows.normal)
    same = [i for i, unit in enumerate(output.units) if unit == output.units[0]]
    read = read_now(values, env)
    value = magnitude(read, output.units)
    quantity, is_vector = quantity_of(output)
    unit, scale = "" if output.units[0] == "1" else output.units[0], 1.0
    if unit and 0 < value.max() < 0.1:
        scale, prefix = _PREFIXES[1 if value.max() >= 1e-4 else 2]
        unit = f"{prefix}{unit}"
    return Markers(
        pos=pos,
        normal=normal,
        size=rows.size,
        value=scale * value,
        scale=scale,
        vector=in_world(sim.model, pose, bodies, np.zeros_like(pos), read[:, same])[1] if is_vector else None,
        quantity=quantity,
        unit=unit,
        threshold=THRESHOLDS.get(output.units[0], 0.0),
    )


def quantity_of(output: Output) -> tuple[str, bool]:
    """Return what the magnitude of a reading is of, such as `|force|`, and whether the reading is a vector."""
    num, stem = output.units.count(output.units[0]), output.channels[0].removesuffix("_x")
    return f"|{stem}|" if num > 1 else stem, num == 3 and output.channels[0].endswith("_x")


def magnitude(values: Float[Array, "taxel channel"], units: Sequence[str]) -> Float[Array, " taxel"]:
    """Return the norm over the channels that share the first one's unit, or 0 up to that unit's threshold [that unit]."""
    size = np.linalg.norm(values[:, [unit == units[0] for unit in units]], axis=1)
    return np.where(size > THRESHOLDS.get(units[0], 0.0), size, 0.0)


def touched(
    touch: TactileModule, sim: Simulation, output: Output, readings: Mapping[str, Tensor], env: int
) -> Bool[Array, " taxel"] | None:
    """Return which taxels of a reading with noise would read something without it; None if the reading has no noise.

    The clean reading counts where it is among `readings`; the module's memory is neither read nor changed.
    """
    sensor = touch.plan.sensor_of(output.name)
    if sensor.noise is None or output.name != sensor.name:
        return None
    if (clean := readings.get(f"{sensor.name}/clean")) is not None:
        return magnitude(read_now(clean, env), output.units) > 0
    state = sim.state()
    memory = Memory(touch.plan.sensors, touch.plan.readings()).tensors(sim.num_envs, state.dt, touch.dtype, touch.device)
    tensors = {name: torch.as_tensor(getattr(state, name), device=touch.device) for name in touch.inputs.fields}
    with torch.no_grad():
        signal = touch.core(tensors, memory)[0][f"{sensor.name}/signal"]
    units = dict(zip(output.channels, output.units, strict=True))  # the signal of a contact bit is a depth
    return magnitude(signal[env].cpu().numpy().T, [units.get(channel, "m") for channel in sensor.signal]) > 0


def is_visible(taxels: Taxels, at: Float[Array, "taxel 3"], fragments: Fragments, camera: Camera) -> Bool[Array, " taxel"]:
    """Return which taxels, at (column [pixel], row [pixel], nearness [m]), face the camera, nothing of the robot between."""
    height, width = fragments.nearness.shape
    column = np.clip(np.rint(at[:, 0]), 0, width - 1).astype(int)
    row = np.clip(np.rint(at[:, 1]), 0, height - 1).astype(int)
    slack = np.maximum(0.2 * taxels.size, 5e-4)  # [m] for taxels a little under the surface
    return (taxels.normal @ camera.toward > 0) & (at[:, 2] + slack >= fragments.nearness[row, column])
