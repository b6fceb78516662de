"""Noise of a sensor: from knobs to constants and memory, and from the true signal to the reading, in the order of `STAGES`.

A stage that no taxel has is left out. A sensor with a rate holds its reading between its samples.

Shapes: `env` environments, `row` rows of a reading, `channel` its channels, `end` lowest and highest value of a range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import LowerError, TgdslError, did_you_mean
from tgdsl.files.plugins import Registry
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.profiles import Knobs
from tgdsl.sensors.noise.spec import ALL, quantity, range_of
from tgdsl.sensors.noise.stage import Now, Signal, Stage
from tgdsl.sensors.noise.stages import STAGES
from tgdsl.tensors.fusion import materialised

StageType = type[Stage]


def _wrong(stage: object) -> str:
    if isinstance(stage, type) and issubclass(stage, Stage):
        return ""
    type_name = stage.__name__ if isinstance(stage, type) else type(stage).__name__
    return f"found {type_name}, expected a subclass of tgdsl.sensors.noise.stage.Stage"


REGISTRY = Registry("tgdsl.noise_stages", "noise stage", "noise stages", STAGES, _wrong)
register = REGISTRY.register


def more_knobs() -> tuple[type[Any], ...]:
    """Return the models of the knobs of stages that are not tgdsl's."""
    return tuple(stage.Knobs for stage in REGISTRY.known()[len(STAGES) :])


def knobs_of(knobs: frozenset[str]) -> frozenset[str]:
    """Return a kind's knobs and the knobs of users' stages; none if the kind has none."""
    return knobs.union(*(model.model_fields for model in more_knobs())) if knobs else knobs


def known_stages() -> tuple[StageType, ...]:
    """Return all stages in their order.

    Raises:
        TgdslError: If two stages share a knob, a number or its draw.
    """
    stages, result, owners = REGISTRY.known(), list(STAGES), dict[object, str]()
    for stage in stages:
        draws = [number.draw for number in stage.numbers.values() if number.draw is not None]
        for name in (*stage.Knobs.model_fields, *(f"number {name}" for name in stage.numbers), *draws):
            if (other := owners.setdefault(name, stage.name)) != stage.name:
                shared = f"the draw {name}" if isinstance(name, int) else f'"{name}"'
                raise TgdslError(f'the noise stages "{other}" and "{stage.name}" both have {shared}; expected another one')
    for stage in stages[len(STAGES) :]:
        names = [other.name for other in result]
        result.insert(names.index(stage.after) + 1 if stage.after in names else len(result), stage)
    return tuple(result)


def stages_of(terms: Sequence[str]) -> tuple[StageType, ...]:
    """Return the stages that a plan names.

    Raises:
        TgdslError: If one of them is not known.
    """
    stages = known_stages()
    if missing := set(terms).difference(*(stage.terms() for stage in stages)):
        raise TgdslError(
            f'the noise stage "{min(missing)}" is not known; install its package, or `tgdsl.sensors.noise.register` it'
        )
    return tuple(stage for stage in stages if set(stage.terms()) & set(terms))


@dataclass(frozen=True, eq=False)
class LoweredNoise:
    """Noise, ready to be planned."""

    terms: tuple[str, ...]  # names of its stages
    # their constants: (channel or 1, row or 1), or (end, …) where an environment draws its own; and kernels
    constants: Mapping[str, np.ndarray]
    memory: Mapping[str, float]  # names of its memory, and how long each call is held [s]; 0: the last call alone
    radius: float  # largest disturbance of a radius [m]
    streams: tuple[int, ...]  # purposes of its random numbers
    needs_dt: bool  # whether it needs the time since the last call


def lower_noise(
    knobs: Sequence[Knobs], which: Int[np.ndarray, " row"], channels: Sequence[str], layout: Layout
) -> LoweredNoise:
    """Lower a sensor's noise.

    Args:
        knobs: The different sets of knobs that its rows have.
        which: Which of them each row has.
        channels: Names of the signal's channels.
        layout: The sensor's taxels.

    Raises:
        LowerError: If a knob names a quantity that the reading does not have.
    """
    terms: list[str] = []
    constants: dict[str, np.ndarray] = {}
    memory: dict[str, float] = {}
    needs_dt = False
    numbers = {name: number for stage in known_stages() for name, number in stage.numbers.items()}
    for stage in known_stages():
        tables = [_table(stage, each, channels) for each in knobs]
        values = {name: np.stack([table[name] for table in tables], axis=-1)[..., which] for name in tables[0]}
        if active := stage.active(values):
            terms += active
            constants |= stage.constants(values, layout)
            memory |= dict.fromkeys(stage.remembered(active), stage.past(values))
            needs_dt |= stage.needs_dt
    drawn = numbers.keys() & constants.keys()
    streams = {stream for name in drawn if (stream := numbers[name].stream) is not None}
    streams |= {random.PARAMETER for name in drawn if numbers[name].draw is not None and constants[name].ndim == 3}
    radius = float(constants["radius_noise"].max()) if "radius_noise" in terms else 0.0
    return LoweredNoise(tuple(terms), constants, memory, radius, tuple(sorted(streams)), needs_dt)


def _table(stage: StageType, knobs: Knobs, channels: Sequence[str]) -> dict[str, Float[np.ndarray, "end channel"]]:
    """Return the values of a stage's numbers for each channel."""
    quantities = list(dict.fromkeys(quantity(channel) for channel in channels))
    result = {}
    for name, value in stage.ranges(knobs).items():
        for key in () if isinstance(value, tuple) else value:
            if key != ALL and key not in quantities:
                knob = (stage.numbers[name].knob or name).split(".")[0]
                problem = f'"{knob}" names "{key}", which this sensor does not read'
                raise LowerError(problem, field="noise", hint=did_you_mean(key, quantities, "quantities"))
        result[name] = np.array([range_of(value, channel) for channel in channels]).T
    return result


def draws_of(stages: Sequence[StageType]) -> dict[str, int]:
    """Return which random number of an episode says where in its range each number is."""
    numbers = {name: number.draw for stage in stages for name, number in stage.numbers.items()}
    return {name: draw for name, draw in numbers.items() if draw is not None}


def draw(stages: Sequence[StageType], constants: Mapping[str, Tensor], now: Now) -> tuple[Stage, ...]:
    """Return stages with their values; of a range, (end, channel, row), each environment draws its own at reset."""
    draws, values = draws_of(stages), {}
    for name, value in constants.items():
        if name in draws and value.ndim == 3:
            index = torch.full((1,), draws[name], dtype=torch.int32, device=value.device)
            share = materialised(random.uniform(random.words(now.streams[random.PARAMETER], index), value.dtype))
            low, high = value
            values[name] = low + share[..., None] * (high - low)
        else:
            values[name] = value[None] if name in draws else value
    return tuple(stage.of(values) for stage in stages)


def disturb(
    signal: Signal, stages: Sequence[Stage], path: str, memory: Mapping[str, Tensor], now: Now
) -> tuple[Signal, dict[str, Tensor]]:
    """Return the disturbed signal and the new memory.

    Args:
        signal: The signal.
        stages: The stages.
        path: Start of the names of this sensor's part of the memory.
        memory: By name (env, channel, row); of a ring, (env, call, channel, row), the new one holds this call alone.
        now: When.
    """
    new: dict[str, Tensor] = {}
    for stage in stages:
        past = stage.Memory(*[memory.get(path + name) for name in stage.Memory._fields])
        signal, state = stage.forward(signal, past, now)
        named = zip(stage.Memory._fields, state, strict=True)
        new |= {path + name: value for name, value in named if value is not None}
    return signal, new
