"""Dead taxels: y ← z_j where M_j, M_j ~ Bernoulli(p), z_j = low + s_j (high − low), s_j ~ U[0, 1], both at reset.

M_j and s_j are of the taxel, the same in all its channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import Range, SpecModel
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.fields import NO_AMPLITUDE, ZERO, Amplitude, AnyAmplitude, Share
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage, Table, uniform
from tgdsl.tensors.fusion import materialised


class DeadKnobs(SpecModel):
    """Knobs of dead taxels."""

    dead_probability: Share = ZERO
    """Chance that a taxel is dead for an episode."""
    dead_range: tuple[AnyAmplitude, AnyAmplitude] = (NO_AMPLITUDE, NO_AMPLITUDE)
    """Lowest and highest stuck reading of a dead taxel, drawn at reset [unit of the reading]."""


class DeadValues(NamedTuple):
    """p, low, and high; None where it is the same as low, for all."""

    dead_probability: Tensor
    dead_low: Tensor
    dead_high: Tensor | None


class DeadStage(Stage[DeadValues, NoMemory]):
    """y ← z_j where M_j."""

    name = "dead"
    Knobs = DeadKnobs
    numbers = {
        "dead_probability": Number(13, "probability "),
        "dead_low": Number(14, "stuck from ", None, "dead_range"),
        "dead_high": Number(15, "to ", None, "dead_range"),
    }
    Values = DeadValues

    def values_of(self, knobs: Any) -> Mapping[str, Range | Amplitude]:
        low, high = knobs.dead_range
        return {"dead_probability": knobs.dead_probability, "dead_low": low, "dead_high": high}

    def constants(self, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        constants = super().constants(values, layout)
        if (np.ptp([*values["dead_low"], *values["dead_high"]], axis=0) == 0).all():
            del constants["dead_high"]
        return constants

    def purposes(self, constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
        return (random.DEAD,)

    def forward(self, signal: Signal, values: DeadValues, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        one = signal[:, 0]
        share = torch.zeros_like(one) if values.dead_high is None else uniform(now, random.DEAD, 1, one)
        is_dead = uniform(now, random.DEAD, 0, one) < values.dead_probability[:, 0]
        share = materialised(torch.where(is_dead, share, -1.0))
        share, stuck = share[:, None], values.dead_low
        if values.dead_high is not None:
            stuck = stuck + share * (values.dead_high - stuck)
        return torch.where(share < 0, signal, stuck), memory

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        share = call.uniform(random.DEAD, 2)
        low, high = call.number("dead_low"), call.number("dead_high")
        return np.where(share[:, :1] < call.number("dead_probability"), low + share[:, 1:] * (high - low), signal)


DEAD = DeadStage()
