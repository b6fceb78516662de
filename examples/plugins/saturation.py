"""A stage of noise from outside tgdsl: saturation, y ← max(−s, min(s, y)) with s the end of the sensor's range.

Make it known before documents are read: `tgdsl.sensors.noise.register(SATURATION)`, or by the entry point `tgdsl.noise_stages`.
Documents then write `noise: {saturation: {force: 2}}`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import SpecModel
from tgdsl.sensors.noise.fields import NO_AMPLITUDE, NonNegativeAmplitude
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage


class SaturationKnobs(SpecModel):
    """Knob of the saturation."""

    saturation: NonNegativeAmplitude = NO_AMPLITUDE
    """Largest magnitude that is read [unit of the reading]; 0: none."""


class SaturationValues(NamedTuple):
    """Largest magnitude; 0: none."""

    saturation: Tensor


class SaturationStage(Stage[SaturationValues, NoMemory]):
    """Clips what is read."""

    name = "saturation"
    Knobs = SaturationKnobs
    numbers = {"saturation": Number(100, unit=None)}
    Values = SaturationValues
    after = "offset"

    def forward(self, signal: Signal, values: SaturationValues, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        """Clip a batch of signals."""
        end = torch.where(values.saturation > 0, values.saturation, torch.inf)
        return torch.minimum(torch.maximum(signal, -end), end), memory

    def reference(self, signal: np.ndarray, call: ReferenceCall, memory: dict[str, Any]) -> np.ndarray:
        """Clip the signal of one environment."""
        end = call.number("saturation")
        return np.where(end > 0, np.clip(signal, -end, end), signal)


SATURATION = SaturationStage()
