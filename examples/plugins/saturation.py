"""A stage of noise from outside tgdsl: saturation, y ← max(−s, min(s, y)) with s the end of the sensor's range.

Make it known before documents are read: `tgdsl.sensors.noise.register(Saturation)`, or by the entry point `tgdsl.noise_stages`.
Documents then write `noise: {saturation: {force: 2}}`.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import SpecModel
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.spec import NO_AMPLITUDE, NonNegativeAmplitude
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage


class SaturationKnobs(SpecModel):
    """Knob of the saturation."""

    saturation: NonNegativeAmplitude = NO_AMPLITUDE
    """Largest magnitude that is read [unit of the reading]; 0: none."""


class Saturation(Stage):
    """Clips what is read."""

    name = "saturation"
    Knobs = SaturationKnobs
    after = "offset"
    saturation: Annotated[Tensor, Number(100, unit=None)]

    def forward(self, signal: Signal, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        """Clip a batch of signals."""
        end = torch.where(self.saturation > 0, self.saturation, torch.inf)
        return torch.minimum(torch.maximum(signal, -end), end), memory

    @staticmethod
    def reference(signal: np.ndarray, call: ReferenceCall, memory: dict[str, Any]) -> np.ndarray:
        """Clip the signal of one environment."""
        end = call.number("saturation")
        return np.where(end > 0, np.clip(signal, -end, end), signal)
