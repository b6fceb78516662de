"""Hysteresis: ξ ← e^(−r) ξ + (1 − e^(−r))/r (x_t − x_(t−1)), r = Δt/τ; x ← x + β ξ. ξ = 0 at reset.

It is a Maxwell branch, exact for signals that are linear between calls, so it is the same at any step. The paper's
ξ ← e^(−r) ξ + x_t − x_(t−1) depends on the step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import Range, RangeOf, SpecModel, Usual
from tgdsl.sensors.noise.fields import ZERO
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import Now, Number, Signal, Stage
from tgdsl.tensors.fusion import materialised


class Hysteresis(SpecModel):
    """Viscoelastic memory of the substrate: one Maxwell branch."""

    strength: Annotated[Range, RangeOf("number", ge=0.0)]
    """β, overshoot after a step, as a share of the step."""
    time_constant: Annotated[Range, RangeOf("time", gt=0.0), Usual("time", high=3600.0)]
    """τ, time constant of the decay [s]."""


class HysteresisKnobs(SpecModel):
    """Knob of the hysteresis."""

    hysteresis: Hysteresis | None = None
    """Viscoelastic memory."""


class HysteresisValues(NamedTuple):
    """β and τ [s]."""

    hysteresis_strength: Tensor
    hysteresis_time: Tensor


class HysteresisMemory(NamedTuple):
    """ξ, and the signal of the last call."""

    lag: Tensor
    last: Tensor


class HysteresisStage(Stage[HysteresisValues, HysteresisMemory]):
    """x ← x + β ξ."""

    name = "hysteresis"
    Knobs = HysteresisKnobs
    numbers = {"hysteresis_strength": Number(3, "strength "), "hysteresis_time": Number(4, "time constant ", " s")}
    Values = HysteresisValues
    Memory = HysteresisMemory
    needs_dt = True

    def values_of(self, knobs: Any) -> Mapping[str, Range]:
        own = knobs.hysteresis
        strength, time = (own.strength, own.time_constant) if own else (ZERO, (1.0, 1.0))
        return {"hysteresis_strength": strength, "hysteresis_time": time}

    def forward(
        self, signal: Signal, values: HysteresisValues, memory: HysteresisMemory, now: Now
    ) -> tuple[Signal, HysteresisMemory]:
        assert now.dt is not None
        ratio = now.dt / values.hysteresis_time
        ramp = torch.where(ratio > 0, -torch.expm1(-ratio) / torch.where(ratio > 0, ratio, 1.0), 1.0)
        decay, ramp = materialised(torch.exp(-ratio)), materialised(ramp)
        lag = torch.where(now.age[..., None] == 0, 0.0, decay * memory.lag + ramp * (signal - memory.last))
        return signal + values.hysteresis_strength * lag, HysteresisMemory(lag, signal)

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        lag = memory.get("lag", 0.0)
        if "last" in memory:
            r = call.dt / call.number("hysteresis_time")
            lag = np.exp(-r) * lag - np.expm1(-r) / r * (signal - memory["last"])
        memory.update(lag=lag, last=signal)
        return signal + call.number("hysteresis_strength") * lag


HYSTERESIS = HysteresisStage()
