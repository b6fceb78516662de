"""Readings as markers at their taxels: where these are in the world, and how much they read.

Shapes: `taxel` taxels of one sensor or layout, `body` bodies of the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.module.memory import Memory, last_step
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.view.taxels import Pose, Posed, Taxels, in_world

Array = np.ndarray
THRESHOLDS = {"N": 1e-3, "N·m": 1e-6, "m": 1e-6, "Pa": 1.0}
"""Magnitude up to which a reading is rounding: it is not drawn, not counted, and printed as 0 [the unit itself]."""


@dataclass(frozen=True, eq=False)
class Markers(Taxels):
    """The rows of one reading in one environment: taxels, or bodies, and what they read."""

    value: Float[Array, " taxel"]  # magnitude of the reading, in `unit`; 0 where it does not exceed `threshold`
    quantity: str  # what is read, such as `|force|`
    unit: str  # its unit, with the prefix that suits the values; empty for plain numbers
    vector: Float[Array, "taxel 3"] | None = None  # the reading itself in the world, in SI units, if it is a vector
    scale: float = 1.0  # what a number in SI units is multiplied with to be in `unit`
    would_read: Bool[Array, " taxel"] | None = None  # which of them would read anything without noise; None: those that do
    threshold: float = 0.0  # see `THRESHOLDS` [SI]; 0: whatever is read counts

    @property
    def is_read(self) -> Bool[Array, " taxel"]:
        """Which taxels read anything: those that are coloured."""
        return self.value > 0

    @property
    def is_touched(self) -> Bool[Array, " taxel"]:
        """Which taxels read anything, noise apart: those that are counted."""
        return self.is_read if self.would_read is None else self.would_read

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return f"{self.quantity} [{self.unit}]" if self.unit else self.quantity

    @property
    def threshold_label(self) -> str:
        """The threshold with the prefix that suits it, such as `1 mN`; empty where all that is read counts."""
        base = self.unit if self.scale == 1.0 else self.unit[1:]
        factor, prefix = next(((f, p) for f, p in ((1.0, ""), (1e3, "m"), (1e6, "µ")) if f * self.threshold >= 0.1), (1.0, ""))
        return f"{factor * self.threshold:g} {prefix}{base}" if self.threshold else ""

    @property
    def colour_label(self) -> str:
        """Label of the colours: quantity, unit, and what is grey."""
        return f"{self.label}   (grey: {f'up to {self.threshold_label}' if self.threshold else 'zero'})"

    def summary(self, chosen: Int[Array, " chosen"] | slice = slice(None)) -> str:
        """Return the sum of some taxels, unless they are lengths, and the largest magnitude.

        Vectors of a link are summed as vectors, `|Σ|`, as the table of `tgdsl run` does; magnitudes alone as they are, `Σ`.
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


def markers_of(touch: TactileModule, scene: Posed, output: Output, values: Tensor, env: int) -> Markers:
    """Return where the taxels of a reading are in one environment, and what they read.

    A reading of bodies has one marker for each, amid its taxels.

    Args:
        touch: The module.
        scene: The scene, at the instant of the reading.
        output: Which reading; its magnitude is the norm over the channels that share the first one's unit.
        values: The reading of all environments; of stacked calls the last one is shown.
        env: Which environment.
    """
    table = touch.taxels[output.sensor]
    pose = Pose(*scene.body_poses(env))
    pos, normal = in_world(scene.model, pose, table["body"], table["pos"], table["normal"])
    size = np.sqrt(table["area"]) * (table["radius"] > 0)
    bodies = np.array(table["body"])
    if output.rows == "body":
        member = np.array([bodies == body for body in output.bodies])
        pos, normal, size = (np.array([part[own].mean(axis=0) for own in member]) for part in (pos, normal, 3 * size))
        bodies = np.array(output.bodies)
    same = [i for i, unit in enumerate(output.units) if unit == output.units[0]]
    read = last_step(values)[env].detach().cpu().double().numpy()
    value = magnitude(read, output.units)
    is_vector = len(same) == 3 and output.channels[0].endswith("_x")
    stem = output.channels[0].removesuffix("_x")
    unit, scale = "" if output.units[0] == "1" else output.units[0], 1.0
    if unit and 0 < value.max() < 0.1:
        scale, unit = (1e3, f"m{unit}") if value.max() >= 1e-4 else (1e6, f"µ{unit}")
    return Markers(
        pos=pos,
        normal=normal,
        size=size,
        value=scale * value,
        scale=scale,
        vector=in_world(scene.model, pose, bodies, np.zeros_like(pos), read[:, same])[1] if is_vector else None,
        quantity=f"|{stem}|" if len(same) > 1 else stem,
        unit=unit,
        threshold=THRESHOLDS.get(output.units[0], 0.0),
    )


def magnitude(values: Float[Array, "taxel channel"], units: Sequence[str]) -> Float[Array, " taxel"]:
    """Return the norm over the channels that share the first one's unit, or 0 up to that unit's threshold [that unit]."""
    size = np.linalg.norm(values[:, [unit == units[0] for unit in units]], axis=1)
    return np.where(size > THRESHOLDS.get(units[0], 0.0), size, 0.0)


def touched(
    touch: TactileModule, sim: Simulation, output: Output, readings: Mapping[str, Tensor], env: int
) -> Bool[Array, " taxel"] | None:
    """Return which taxels of a reading with noise would read something without it; None if the reading has no noise.

    Args:
        touch: The module; what it remembers is neither read nor changed.
        sim: The scene, at the instant of the reading.
        output: Which reading.
        readings: All readings: where the clean one is among them, it is that one which counts.
        env: Which environment.
    """
    sensor = touch.plan.sensor_of(output.name)
    if sensor.noise is None or output.name != sensor.name:
        return None
    if (clean := readings.get(f"{sensor.name}/clean")) is not None:
        return magnitude(last_step(clean)[env].detach().cpu().numpy(), output.units) > 0
    state = sim.state()
    memory = Memory(touch.plan.sensors, touch.plan.readings()).tensors(sim.num_envs, state.dt, touch.dtype, touch.device)
    tensors = {name: torch.as_tensor(getattr(state, name), device=touch.device) for name in touch.inputs.fields}
    with torch.no_grad():
        signal = touch.core(tensors, memory)[0][f"{sensor.name}/signal"]
    units = dict(zip(output.channels, output.units, strict=True))  # the signal of a contact bit is a depth
    return magnitude(signal[env].cpu().numpy().T, [units.get(channel, "m") for channel in sensor.signal]) > 0
