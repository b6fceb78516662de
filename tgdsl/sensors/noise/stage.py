"""A stage of a sensor's noise: a class with its numbers, its batched form, and its definition in float64.

A stage of a user is a subclass in one file with its `Knobs`. `pipeline.register` makes it known, or the entry point
`tgdsl.noise_stages`; every kind that has noise then has its knobs.

Shapes: `env` environments, `channel` numbers of a signal, `row` its rows, `end` lowest and highest value of a range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple, dataclass_transform, get_args, get_origin, get_type_hints

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.fields.models import Range, SpecModel
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.random import Stream
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.spec import ZERO, Amplitude

Signal = Float[Tensor, "env channel row"]  # the signal that noise disturbs


class Now(NamedTuple):
    """Time and random numbers of a reading."""

    dt: Tensor | None  # time since the last call [s]
    step: Tensor  # number of this call of each environment, (env, 1)
    age: Tensor  # calls since each environment's reset, (env, 1); 0 at the first one
    # time since each of the calls before this one, the last one first (env, call) [s]; None without a delay
    ages: Tensor | None
    is_sample: Tensor | None  # whether each environment's sensor takes a sample now, (env, 1); None: always
    period: Tensor | None  # time between samples [s], a scalar; None: each call takes one
    streams: Mapping[int, Stream]  # the sensor's random numbers, by purpose


NO_CLOCK = Now(*[None] * 6, {})  # type: ignore[arg-type]
"""Of a sensor whose noise has neither time nor random numbers."""


def uniform(now: Now, purpose: int, row: int, like: Tensor) -> Tensor:
    """Return a uniform number between 0 and 1 for each of the last axis of `like`: one row of a purpose, (env, …)."""
    count = like.shape[-1]
    index = torch.arange(count, dtype=torch.int32, device=like.device) + row * count
    return random.uniform(random.words(now.streams[purpose], index), like.dtype)


@dataclass(frozen=True)
class Number:
    """Marks a field of a stage as a number of the knobs."""

    draw: int | None  # which random number of an episode says where in its range it is, unique to it; None: it is not drawn
    label: str | None = ""  # text before its value in `explain`; None: it is not shown
    unit: str | None = ""  # its unit in `explain`, where " %" shows shares as percentages; None: the unit of the reading
    knob: str | None = ""  # the path of its range in the knobs, `gain.0`; "": its name; None: it is of no knob
    absent: Range = ZERO  # its range where such a knob is None
    # the value that has no effect: a stage is left out where all rows have it. None: it does not decide.
    neutral: float | None = 0.0
    stream: int | None = None  # purpose of the random numbers that it needs, see `random`


class NoMemory(NamedTuple):
    """Memory of a stage without any."""


Table = Mapping[str, Float[np.ndarray, "end channel row"]]  # values of a stage's numbers


@dataclass_transform(frozen_default=True, eq_default=False)
class Stage:
    """A stage of noise; an instance holds its numbers at one call.

    A field is `name: Annotated[Tensor, Number(…)]`, (env or 1, channel or 1, row or 1); of `Tensor | None` it is None where it
    is neutral in all rows. Subclasses are frozen dataclasses without being marked as such.
    """

    name: ClassVar[str]  # its name in a plan
    Knobs: ClassVar[type[SpecModel]] = SpecModel  # fields that it adds to the knobs of a sensor, with neutral defaults
    # its memory: a NamedTuple of (env, channel, row). The content before the first call, where `Now.age` is 0, is arbitrary.
    Memory: ClassVar[type[Any]] = NoMemory
    needs_dt: ClassVar[bool] = False  # whether it needs the time since the last call
    after: ClassVar[str] = ""  # name of the stage that it follows; "": the one before it in `STAGES`, or the last one
    is_split: ClassVar[bool] = False  # whether a plan names its active numbers instead of the stage
    numbers: ClassVar[Mapping[str, Number]]  # its numbers by name, from the fields
    _optional: ClassVar[frozenset[str]]

    def __init_subclass__(cls) -> None:
        """Collect the numbers."""
        dataclass(frozen=True, eq=False)(cls)
        hints = get_type_hints(cls, include_extras=True)
        marked = {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Annotated}
        cls.numbers = {name: args[1] for name, args in marked.items()}
        cls._optional = frozenset(name for name, args in marked.items() if type(None) in get_args(args[0]))

    @classmethod
    def terms(cls) -> tuple[str, ...]:
        """Return its names in plans."""
        return tuple(cls.numbers) if cls.is_split else (cls.name,)

    @classmethod
    def ranges(cls, knobs: Any) -> dict[str, Range | Amplitude]:
        """Return its numbers of some knobs."""
        result = {}
        for name, number in cls.numbers.items():
            value: Any = knobs
            for part in () if number.knob is None else (number.knob or name).split("."):
                value = value[int(part)] if part.isdigit() else getattr(value, part, None)
            result |= {} if number.knob is None else {name: number.absent if value is None else value}
        return result

    @classmethod
    def active(cls, values: Table) -> tuple[str, ...]:
        """Return which of its terms some row has."""
        names = tuple(name for name, n in cls.numbers.items() if n.neutral is not None and (values[name] != n.neutral).any())
        return names if cls.is_split or not names else (cls.name,)

    @classmethod
    def constants(cls, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        """Return the constants of a sensor with these values, whose layout has its taxels."""
        left_out = {name for name in cls._optional if (values[name] == cls.numbers[name].neutral).all()}
        return {name: compact(values[name]) for name in cls.numbers if name not in left_out}

    @classmethod
    def remembered(cls, terms: Sequence[str]) -> tuple[str, ...]:
        """Return which fields of its memory a sensor with these terms has; default: all."""
        return cls.Memory._fields

    @classmethod
    def past(cls, values: Table) -> float:
        """Return for how long its memory holds each call [s]; 0: it holds the last one alone."""
        return 0.0

    @classmethod
    def of(cls, values: Mapping[str, Tensor]) -> Stage:
        """Return the stage with its numbers, from the values of all stages."""
        return cls(**{name: values.get(name) for name in cls.numbers})

    def forward(self, signal: Signal, memory: Any, now: Now) -> tuple[Signal, Any]:
        """Return the disturbed signal, here the same, and the new memory; where that is a ring, the entry of this call."""
        return signal, memory

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        """Return the disturbed signal (row, channel) of one environment; `memory` is empty at the first call of an episode."""
        return signal


def compact(value: Float[np.ndarray, "end channel row"]) -> np.ndarray:
    """Return values without the axes along which nothing changes; channels and rows become axes of length 1."""
    for axis in (1, 2):
        first = value.take([0], axis)
        value = first if (value == first).all() else value
    return value[0] if (value[0] == value[1]).all() else value
