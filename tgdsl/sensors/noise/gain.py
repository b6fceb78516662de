"""Gain of each taxel: x ← γ_j x, γ_j ~ U[γ_low, γ_high] at reset. An elastomer's gain is of the depth at each taxel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import model_validator
from torch import Tensor

from tgdsl.fields.models import Range, RangeOf, SpecModel
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage, Table, uniform

Factor = Annotated[Range, RangeOf("number", gt=0.0)]


class GainKnobs(SpecModel):
    """Knob of the gain."""

    gain: tuple[Factor, Factor] = ((1.0, 1.0), (1.0, 1.0))
    """Lowest and highest gain: each probe draws its own at reset."""

    @model_validator(mode="after")
    def _ordered(self) -> GainKnobs:
        if self.gain[0][0] > self.gain[1][1]:
            raise ValueError(f"gain [{self.gain[0][0]:g}, {self.gain[1][1]:g}] is not ordered, expected [low, high]")
        return self


class GainValues(NamedTuple):
    """Lowest and highest gain."""

    gain_low: Tensor
    gain_high: Tensor


class GainStage(Stage[GainValues, NoMemory]):
    """x ← γ_j x."""

    name = "gain"
    Knobs = GainKnobs
    numbers = {"gain_low": Number(1, "from "), "gain_high": Number(2, "to ")}
    Values = GainValues

    def values_of(self, knobs: Any) -> Mapping[str, Range]:
        low, high = knobs.gain
        return {"gain_low": low, "gain_high": high}

    def active(self, values: Table) -> tuple[str, ...]:
        return self.terms if (values["gain_low"] != 1).any() or (values["gain_high"] != 1).any() else ()

    def purposes(self, constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
        return (random.GAIN,)

    def of_taxels(self, values: GainValues, now: Now, like: Tensor) -> Tensor:
        """Return each taxel's gain (env, taxel)."""
        low, high = values.gain_low[:, 0], values.gain_high[:, 0]
        share = uniform(now, random.GAIN, 0, like)
        return low + share * (high - low)

    def forward(self, signal: Signal, values: GainValues, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        return self.of_taxels(values, now, signal[:, 0])[:, None] * signal, memory

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        low, high = call.number("gain_low"), call.number("gain_high")
        return (low + call.uniform(random.GAIN)[:, :1] * (high - low)) * signal


GAIN = GainStage()
