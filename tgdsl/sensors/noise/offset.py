"""Offset: y = x + b + n_t + d_t, n_t ~ N(0, σ²), d_t = d_(t−1) + w_t, w_t ~ N(0, σ_rw²), each channel alone; d = 0 at reset.

n and w are drawn once per sample, both of one random word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import SpecModel
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.fields import NO_AMPLITUDE, AnyAmplitude, NonNegativeAmplitude
from tgdsl.sensors.noise.reference import ReferenceCall, normal_pair
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import Now, Number, Signal, Stage, Table, compact


class OffsetKnobs(SpecModel):
    """Knobs of the offset."""

    bias: AnyAmplitude = NO_AMPLITUDE
    """Constant offset [unit of the reading]."""
    white_noise: NonNegativeAmplitude = NO_AMPLITUDE
    """σ, standard deviation of additive Gaussian noise [unit of the reading]."""
    drift: NonNegativeAmplitude = NO_AMPLITUDE
    """Standard deviation of the random walk's step at each reading [unit of the reading]; the walk starts at reset."""


class OffsetValues(NamedTuple):
    """b, σ and σ_rw; None where there is none."""

    bias: Tensor | None
    white_noise: Tensor | None
    drift: Tensor | None


class OffsetMemory(NamedTuple):
    """d; None without drift."""

    walk: Tensor | None = None


class OffsetStage(Stage[OffsetValues, OffsetMemory]):
    """y = x + b + n + d."""

    name = "offset"
    Knobs = OffsetKnobs
    numbers = {"bias": Number(9, unit=None), "white_noise": Number(10, unit=None), "drift": Number(11, unit=None)}
    Values = OffsetValues
    Memory = OffsetMemory

    @property
    def terms(self) -> tuple[str, ...]:
        return tuple(self.numbers)

    def active(self, values: Table) -> tuple[str, ...]:
        return tuple(name for name in self.numbers if values[name].any())

    def constants(self, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        return {name: compact(values[name]) for name in self.active(values)}

    def remembers(self, terms: Sequence[str]) -> tuple[str, ...]:
        return ("walk",) if "drift" in terms else ()

    def purposes(self, constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
        return (random.READING,) if {"white_noise", "drift"} & constants.keys() else ()

    def forward(self, signal: Signal, values: OffsetValues, memory: OffsetMemory, now: Now) -> tuple[Signal, OffsetMemory]:
        if values.bias is not None:
            signal = signal + values.bias
        if values.white_noise is None and values.drift is None:
            return signal, memory
        channels, rows = signal.shape[1:]
        index = torch.arange(channels * rows, dtype=torch.int32, device=signal.device).view(channels, rows)
        first, second = now.streams[random.READING]
        word = random.words(random.Stream(first[..., None], second[..., None]), index)
        noise, step = random.normal_pair(word, signal.dtype)
        if values.white_noise is not None:
            signal = signal + values.white_noise * noise
        if values.drift is None or memory.walk is None:
            return signal, memory
        step = values.drift * step
        step = step if now.is_sample is None else torch.where(now.is_sample[..., None], step, 0.0)
        walk = torch.where(now.age[..., None] == 0, 0.0, memory.walk) + step
        return signal + walk, OffsetMemory(walk)

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        noise, step = normal_pair(call.words(random.READING, signal.shape[1]))
        if call.is_sample:
            memory["walk"] = memory.get("walk", 0.0) + call.number("drift") * step
        return signal + call.number("bias") + (call.number("white_noise") * noise + memory["walk"])


OFFSET = OffsetStage()
