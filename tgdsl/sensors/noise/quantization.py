"""Quantization: y ← q round(y/q). Gradients pass the quantiser as if it were not there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import SpecModel
from tgdsl.sensors.noise.fields import NO_AMPLITUDE, NonNegativeAmplitude
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage
from tgdsl.tensors.fusion import materialised


class QuantizationKnobs(SpecModel):
    """Knob of the quantiser."""

    quantization: NonNegativeAmplitude = NO_AMPLITUDE
    """Step of the quantiser [unit of the reading]; 0: none."""


class QuantizationValues(NamedTuple):
    """q."""

    quantization: Tensor


class QuantizationStage(Stage[QuantizationValues, NoMemory]):
    """y ← q round(y/q)."""

    name = "quantization"
    Knobs = QuantizationKnobs
    numbers = {"quantization": Number(12, unit=None)}
    Values = QuantizationValues

    def forward(self, signal: Signal, values: QuantizationValues, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        step = values.quantization
        per_step = materialised(torch.where(step > 0, 1 / torch.where(step > 0, step, 1.0), 0.0))
        level = torch.where(step > 0, step * torch.round(signal * per_step), signal)
        return level.detach() + (signal - signal.detach()) if signal.requires_grad else level, memory

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        q = call.number("quantization")
        return np.where(q > 0, q * np.round(signal / np.where(q > 0, q, 1.0)), signal)


QUANTIZATION = QuantizationStage()
