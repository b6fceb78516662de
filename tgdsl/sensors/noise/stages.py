"""Noise of a sensor: what lies between the true signal and the reading, stage by stage in the order of `STAGES`.

Each stage acts on each channel alone. Where a kind makes bits of its signal (`contact`, `link_contact`), noise acts on the
signal, before the threshold. A sensor with a rate holds its reading between its samples; its noise is drawn once per sample.

Source: Chung et al., *Tactile Genesis*, appendix, "Sensor Noise Model"; departures are in the files of the stages.

Shapes: `env` environments, `channel` numbers of the signal, `row` its rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.files.plugins import installed
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.crosstalk import CROSSTALK
from tgdsl.sensors.noise.dead import DEAD
from tgdsl.sensors.noise.delay import DELAY
from tgdsl.sensors.noise.gain import GAIN
from tgdsl.sensors.noise.hysteresis import HYSTERESIS
from tgdsl.sensors.noise.offset import OFFSET
from tgdsl.sensors.noise.quantization import QUANTIZATION
from tgdsl.sensors.noise.radius import RADIUS
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.release import RELEASE
from tgdsl.sensors.noise.spec import Knobs
from tgdsl.sensors.noise.stage import Now, Signal, Stage
from tgdsl.tensors.fusion import materialised

AnyStage = Stage[Any, Any]
STAGES: tuple[AnyStage, ...] = (
    RADIUS, GAIN, HYSTERESIS, CROSSTALK, DELAY, OFFSET, QUANTIZATION, DEAD, RELEASE,
)  # fmt: skip
"""The stages of tgdsl, in their order."""
GROUP = "tgdsl.noise_stages"
"""Group of the entry points by which packages bring stages."""
_registered: list[AnyStage] = []


def register(stage: AnyStage) -> None:
    """Make a stage known to all documents and artefacts that are read from now on."""
    _registered.append(stage)


def more_stages() -> tuple[AnyStage, ...]:
    """Return the stages of installed packages, and those that were registered.

    Raises:
        TgdslError: If two stages share a knob, a number or its draw.
    """
    more = (*(stage for stage, _ in installed(GROUP, "noise stage", _wrong)), *_registered)
    names: dict[object, str] = {}
    for stage in (*STAGES, *more):
        draws = [number.draw for number in stage.numbers.values() if number.draw is not None]
        for name in (*stage.Knobs.model_fields, *(f"number {name}" for name in stage.numbers), *draws):
            if (other := names.setdefault(name, stage.name)) != stage.name:
                problem = f"the draw {name}" if isinstance(name, int) else f'"{name}"'
                raise TgdslError(f'the noise stages "{other}" and "{stage.name}" both have {problem}; expected another one')
    return more


def knobs_of(knobs: frozenset[str]) -> frozenset[str]:
    """Return all knobs of a kind: its own, and those of `more_stages` if it has any."""
    return knobs.union(*(stage.Knobs.model_fields for stage in more_stages())) if knobs else knobs


def known_stages() -> tuple[AnyStage, ...]:
    """Return all stages in their order."""
    result = list(STAGES)
    for stage in more_stages():
        names = [other.name for other in result]
        result.insert(names.index(stage.after) + 1 if stage.after in names else len(result), stage)
    return tuple(result)


def _wrong(stage: object) -> str:
    return "" if isinstance(stage, Stage) else f"found {type(stage).__name__}, expected a tgdsl.sensors.noise.stage.Stage"


def stages_of(terms: Sequence[str]) -> tuple[AnyStage, ...]:
    """Return the stages that a plan names.

    Raises:
        TgdslError: If one of them is not known.
    """
    known = known_stages()
    if missing := set(terms).difference(*(stage.terms for stage in known)):
        problem = f'the noise stage "{min(missing)}" is not known'
        raise TgdslError(f"{problem}; install its package, or `tgdsl.sensors.noise.register` it")
    return tuple(stage for stage in known if set(stage.terms) & set(terms))


Drawn = Mapping[str, Any]
"""What each stage of a sensor gets as `values`, by the stage's name."""


def draws_of(stages: Sequence[AnyStage]) -> dict[str, int]:
    """Return which random number of an episode says where in its range each number is."""
    numbers = {name: number.draw for stage in stages for name, number in stage.numbers.items()}
    return {name: draw for name, draw in numbers.items() if draw is not None}


def draw(stages: Sequence[AnyStage], constants: Mapping[str, Tensor], now: Now) -> Drawn:
    """Return the values of stages; of a range, (end, channel, row), each environment draws its own at reset."""
    draws, values = draws_of(stages), {}
    for name, value in constants.items():
        if name in draws and value.ndim == 3:
            index = torch.full((1,), draws[name], dtype=torch.int32, device=value.device)
            share = materialised(random.uniform(random.words(now.streams[random.PARAMETER], index), value.dtype))
            low, high = value
            values[name] = low + share[..., None] * (high - low)
        else:
            values[name] = value[None] if name in draws else value
    return {stage.name: stage.typed(values) for stage in stages}


def disturb(
    signal: Signal, stages: Sequence[AnyStage], values: Drawn, path: str, memory: Mapping[str, Tensor], now: Now
) -> tuple[Signal, dict[str, Tensor]]:
    """Return what is read of a signal, and the new memory.

    Args:
        signal: The signal.
        stages: The stages.
        values: Their values.
        path: Start of the names of this sensor's part of the memory.
        memory: By name (env, channel, row); of a ring, (env, call, channel, row), the new one holds this call alone.
        now: When.
    """
    new: dict[str, Tensor] = {}
    for stage in stages:
        past = stage.Memory(*[memory.get(path + name) for name in stage.Memory._fields])
        signal, state = stage.forward(signal, values[stage.name], past, now)
        named = zip(stage.Memory._fields, state, strict=True)
        new |= {path + name: value for name, value in named if value is not None}
    return signal, new


class ReferenceNoise:
    """The definition of the noise: one sensor in one environment, fed call by call, in float64."""

    def __init__(
        self, knobs: Sequence[Knobs], channels: Sequence[str], key: tuple[int, int], env: int = 0, layout: Layout | None = None
    ):
        """Begin the first episode.

        Args:
            knobs: The knobs of each row.
            channels: Names of the signal's channels.
            key: The sensor's key, see `random.sensor_key`.
            env: Number of the environment.
            layout: The taxels, if there is crosstalk.
        """
        self._stages = known_stages()
        ranges = [{name: v for stage in self._stages for name, v in stage.values_of(own).items()} for own in knobs]
        self._call = ReferenceCall(ranges, draws_of(self._stages), channels, key, env, layout, episode=-1)
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self._call = replace(self._call, episode=self._call.episode + 1)
        self._memory: dict[str, dict[str, Any]] = {stage.name: {} for stage in self._stages}

    @property
    def gain(self) -> ReferenceSignal:
        """Each taxel's gain (row, channel)."""
        return GAIN.reference(np.ones((len(self._call.ranges), len(self._call.channels))), self._call, {})

    def radius(self, radius: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Return this step's radii of probes whose own are given [m]."""
        return RADIUS.reference_radius(radius, self._call)

    def read(self, signal: ReferenceSignal, dt: float, is_sample: bool = True) -> ReferenceSignal:
        """Return what is read of a signal, and go on to the next step.

        Args:
            signal: The signal, of which `gain` is a factor already.
            dt: Time since the last call [s].
            is_sample: Whether the sensor takes a sample now; else it reads the last one.
        """
        call = replace(self._call, dt=dt, is_sample=is_sample)
        for stage in self._stages:
            if stage is not GAIN:
                signal = stage.reference(signal, call, self._memory[stage.name])
        if is_sample:
            self._sample = signal
        self._call = replace(self._call, step=self._call.step + 1)
        return self._sample
