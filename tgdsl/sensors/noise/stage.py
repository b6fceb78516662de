"""A stage of a sensor's noise: one class with its knobs, its batched form, and its definition in float64.

A stage of one's own is a subclass in one file. `stages.register` makes it known, or the entry point `tgdsl.noise_stages`; every
kind that has noise then has its knobs.

Shapes: `env` environments, `channel` numbers of a signal, `row` its rows, `end` lowest and highest value of a range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.fields.models import Range, SpecModel
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.fields import Amplitude
from tgdsl.sensors.noise.random import Stream
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal

Signal = Float[Tensor, "env channel row"]
"""What noise disturbs."""


class Now(NamedTuple):
    """When a reading is made.

    Attributes:
        dt: Time since the last call [s].
        step: Number of this call of each environment, (env, 1).
        age: Calls since each environment's reset, (env, 1); 0 at the first one.
        ages: Time since each of the calls before this one, the last one first (env, call) [s]; None without a delay.
        is_sample: Whether each environment's sensor takes a sample now, (env, 1); None: always.
        period: Time between samples [s], a scalar; None: one is taken at every call.
        streams: The sensor's random numbers, by purpose.
    """

    dt: Tensor | None
    step: Tensor
    age: Tensor
    ages: Tensor | None
    is_sample: Tensor | None
    period: Tensor | None
    streams: Mapping[int, Stream]


NO_CLOCK = Now(*[None] * 6, {})  # type: ignore[arg-type]
"""What a sensor gets whose noise depends neither on time nor on chance."""


def uniform(now: Now, purpose: int, row: int, like: Tensor) -> Tensor:
    """Return a uniform number between 0 and 1 for each of the last axis of `like`: those of a row of a purpose, (env, …)."""
    count = like.shape[-1]
    index = torch.arange(count, dtype=torch.int32, device=like.device) + row * count
    return random.uniform(random.words(now.streams[purpose], index), like.dtype)


class Number(NamedTuple):
    """A number of a stage's knobs.

    Attributes:
        draw: Which random number of an episode says where in its range it is, one for each number; None: it is not drawn.
        label: What precedes its value in an account of a module; None: it is not shown.
        unit: Its unit; None: that of the reading.
        knob: The knob that it is of, if that has another name.
    """

    draw: int | None
    label: str | None = ""
    unit: str | None = ""
    knob: str = ""


class NoMemory(NamedTuple):
    """A stage that remembers nothing."""


Values = TypeVar("Values")
Memory = TypeVar("Memory")
Table = Mapping[str, Float[np.ndarray, "end channel row"]]
"""Values of a stage's numbers."""


class Stage(Generic[Values, Memory]):
    """A stage of noise.

    Attributes:
        name: Its name in a plan.
        Knobs: Fields that it adds to the knobs of a sensor, with neutral defaults.
        numbers: The numbers that `values_of` reads of the knobs, by the names of constants.
        Values: What `forward` gets: a NamedTuple of constants, (env or 1, channel or 1, row or 1); None where one is left out.
        Memory: What it carries from one call to the next: a NamedTuple of (env, channel, row). What there was before the first
            call is of no use: it starts where `Now.age` is 0.
        needs_dt: Whether it needs the time since the last call.
        after: Name of the stage that it follows; "": that before it in `STAGES`, or the last one.
    """

    name: ClassVar[str]
    Knobs: ClassVar[type[SpecModel]]
    numbers: ClassVar[Mapping[str, Number]]
    Values: ClassVar[type[Any]]
    Memory: ClassVar[type[Any]] = NoMemory
    needs_dt: ClassVar[bool] = False
    after: ClassVar[str] = ""

    @property
    def terms(self) -> tuple[str, ...]:
        """Its names in a plan: several if parts of it can be off by themselves."""
        return (self.name,)

    def values_of(self, knobs: Any) -> Mapping[str, Range | Amplitude]:
        """Return its numbers of some knobs, neutral where it is off; default: knobs of the same names."""
        return {name: getattr(knobs, name) for name in self.numbers}

    def active(self, values: Table) -> tuple[str, ...]:
        """Return which of its terms some row has; default: its only one, where the first number is not 0."""
        return self.terms if values[next(iter(self.numbers))].any() else ()

    def constants(self, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        """Return what `forward` reads of the values of a sensor whose layout has its taxels; default: all of them."""
        return {name: compact(values[name]) for name in self.numbers}

    def remembers(self, terms: Sequence[str]) -> tuple[str, ...]:
        """Return which fields of its memory there are, of a sensor with these terms; default: all."""
        return self.Memory._fields

    def purposes(self, constants: Mapping[str, np.ndarray]) -> tuple[int, ...]:
        """Return what it draws random numbers for, see `random`."""
        return ()

    def past(self, values: Table) -> float:
        """Return for how long its memory holds each call [s]; 0: it holds the last one alone."""
        return 0.0

    def typed(self, values: Mapping[str, Tensor]) -> Values:
        """Return its values of those of all stages."""
        return self.Values(*[values.get(name) for name in self.Values._fields])

    def forward(self, signal: Signal, values: Values, memory: Memory, now: Now) -> tuple[Signal, Memory]:
        """Return the disturbed signal, here the same, and the new memory; where that is a ring, the entry of this call."""
        return signal, memory

    def reference(self, signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        """Return the disturbed signal (row, channel) of one environment; `memory` is empty at the first call of an episode."""
        return signal


def compact(value: Float[np.ndarray, "end channel row"]) -> np.ndarray:
    """Return values without the axes along which nothing changes; those of channels and rows become 1."""
    for axis in (1, 2):
        first = value.take([0], axis)
        value = first if (value == first).all() else value
    return value[0] if (value[0] == value[1]).all() else value
