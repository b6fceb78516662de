"""Taxels as dots: where they are in one environment, and how much they read.

Shapes: `taxel` taxels of one sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.module import Output, TactileModule
from tgdsl.runtime.batch import BatchSimulation

Array = np.ndarray


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


def dots_of(touch: TactileModule, sim: BatchSimulation, output: Output, values: Tensor, env: int) -> Dots:
    """Return where the taxels of a reading are in one environment, and the magnitude of what they read.

    Args:
        touch: The module.
        sim: The scene, at the instant of the reading.
        output: Which reading; its magnitude is the norm over the channels that share the first one's unit.
        values: The reading of all environments.
        env: Which environment.
    """
    table = touch.taxels[sensor_of(touch, output.name)]
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


def sensor_of(touch: TactileModule, reading: str) -> str:
    """Return the name of the sensor that a reading is of."""
    return next(sensor.name for sensor in touch.plan.sensors if reading in sensor.readings)
