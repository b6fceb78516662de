"""Delay: x ← x(t − Δ), Δ = Δ_read + U[0, J] at each reading, the same for all taxels.

The signal is linear between calls, and before the first call equal to the first one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import Range, RangeOf, SpecModel, Usual
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.fields import ZERO
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import Now, Number, Signal, Stage, Table
from tgdsl.tensors.fusion import materialised

TimeRange = Annotated[Range, RangeOf("time", ge=0.0)]


class DelayKnobs(SpecModel):
    """Knobs of the delay."""

    read_delay: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
    """Age of what is read [s]; between two calls the signal counts as linear."""
    jitter: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
    """Largest additional age, drawn uniformly at each reading for all taxels together [s]."""


class DelayValues(NamedTuple):
    """Δ_read and J [s]."""

    read_delay: Tensor
    jitter: Tensor | None


class DelayMemory(NamedTuple):
    """The signals of the last calls, (env, call, channel, row); the new one is this call's, (env, channel, row)."""

    ring: Tensor


class DelayStage(Stage[DelayValues, DelayMemory]):
    """x ← x(t − Δ)."""

    name = "delay"
    Knobs = DelayKnobs
    numbers = {"read_delay": Number(7, unit=" s"), "jitter": Number(8, "jitter ", " s")}
    Values = DelayValues
    Memory = DelayMemory
    needs_dt = True

    def active(self, values: Table) -> tuple[str, ...]:
        return self.terms if values["read_delay"].any() or values["jitter"].any() else ()

    def constants(self, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        constants = super().constants(values, layout)
        if not values["jitter"].any():
            del constants["jitter"]
        return constants

    def purposes(self, constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
        return (random.JITTER,) if "jitter" in constants else ()

    def past(self, values: Table) -> float:
        return float((values["read_delay"][1] + values["jitter"][1]).max())

    def forward(self, signal: Signal, values: DelayValues, memory: DelayMemory, now: Now) -> tuple[Signal, DelayMemory]:
        assert now.ages is not None
        late, ring = values.read_delay[:, 0], memory.ring
        if values.jitter is not None:
            index = torch.zeros_like(now.streams[random.JITTER].first[:1, 0])
            word = random.words(now.streams[random.JITTER], index)
            late = late + values.jitter[:, 0] * random.uniform(word, late.dtype)
        length = ring.shape[1]
        ages = now.ages[:, :length]
        newer = torch.minimum((ages[:, None] <= late[..., None]).sum(dim=-1), torch.clamp(now.age, max=length))
        is_oldest = newer >= torch.clamp(now.age, max=length)
        start = torch.where(newer > 0, ages.gather(1, (newer - 1).clamp(min=0)), 0.0)
        rest = (late - start) / (ages.gather(1, newer.clamp(max=length - 1)) - start)
        rest, newer = materialised(torch.where(is_oldest, 0.0, rest)), materialised(newer)
        after, before = (_entry(ring, materialised((now.step - newer - k) % length)) for k in (0, 1))
        after = torch.where(newer[:, None] == 0, signal, after)
        return torch.where(rest[:, None] > 0, after + rest[:, None] * (before - after), after), DelayMemory(signal)

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        times, signals = memory.setdefault("times", []), memory.setdefault("signals", [])
        times.append(times[-1] + call.dt if times else 0.0)
        signals.append(signal)
        late = call.number("read_delay") + call.uniform(random.JITTER)[0, 0] * call.number("jitter")
        past, result = np.array(signals), np.empty(signal.shape)
        for place in np.ndindex(signal.shape):
            result[place] = np.interp(times[-1] - late[place], times, past[:, *place])
        return result


def _entry(ring: Tensor, slot: Tensor) -> Signal:
    """Return what a ring (env, call, channel, row) holds at a place, (env, 1) or (env, row)."""
    env = torch.arange(ring.shape[0], device=ring.device)
    if slot.shape[1] == 1:  # whole signals, which lie together
        return ring[env, slot[:, 0]]
    place = slot[:, None, None].expand(-1, 1, *ring.shape[2:])
    return ring.gather(1, place)[:, 0]


DELAY = DelayStage()
