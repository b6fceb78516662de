"""The batched noise alone, fed any signal call by call; layouts for crosstalk; distances of distributions.

Shapes: `env` environments, `row` taxels, `channel` channels.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.special import ndtr
from torch import Tensor

from tgdsl.layout.layout import Layout, Link
from tgdsl.sensors.noise import Knobs, random
from tgdsl.sensors.noise.pipeline import disturb, draw, draws_of, known_stages, lower_noise, stages_of
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.stage import Now
from tgdsl.sensors.noise.stages import Gain, Radius

MM = 1e-3
"""A millimetre [m]."""


def make_layout(pos: np.ndarray, normal: Any = (0, 0, 1), link_id: Any = 0, radius: Any = 4 * MM) -> Layout:
    """Return taxels at these positions (taxel, 3); single values apply to all."""
    count = len(pos)
    link_id = np.broadcast_to(np.asarray(link_id, dtype=np.int64), count)
    return Layout(
        links=tuple(Link(f"l{i}", f"l{i}") for i in range(link_id.max() + 1)),
        groups={},
        link_id=link_id,
        pos=np.asarray(pos, dtype=float),
        normal=np.broadcast_to(np.asarray(normal, dtype=float), (count, 3)),
        tangent=np.broadcast_to(np.array([1.0, 0, 0]), (count, 3)),
        radius=np.broadcast_to(np.asarray(radius, dtype=float), count),
        area=np.ones(count),
        cell=np.full((count, 2), -1),
    )


def line(count: int) -> Layout:
    """Return taxels 1 mm apart."""
    return make_layout(np.arange(count)[:, None] * np.array([MM, 0, 0]))


class ReferenceNoise:
    """The definition of the noise: one sensor in one environment, fed call by call, in float64."""

    def __init__(
        self, knobs: Sequence[Knobs], channels: Sequence[str], key: tuple[int, int], env: int = 0, layout: Layout | None = None
    ):
        """Start the first episode.

        Args:
            knobs: The knobs of each row.
            channels: Names of the signal's channels.
            key: The sensor's key, see `random.sensor_key`.
            env: Number of the environment.
            layout: The taxels, if there is crosstalk.
        """
        self._stages = known_stages()
        ranges = [{name: v for stage in self._stages for name, v in stage.ranges(row).items()} for row in knobs]
        self._call = ReferenceCall(ranges, draws_of(self._stages), channels, key, env, layout, episode=-1)
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._call = replace(self._call, episode=self._call.episode + 1)
        self._memory: dict[str, dict[str, Any]] = {stage.name: {} for stage in self._stages}

    @property
    def gain(self) -> np.ndarray:
        """Return each taxel's gain (row, channel)."""
        return Gain.reference(np.ones((len(self._call.ranges), len(self._call.channels))), self._call, {})

    def radius(self, radius: np.ndarray) -> np.ndarray:
        """Return this step's disturbed radii [m]."""
        return Radius.reference_radius(radius, self._call)

    def read(self, signal: np.ndarray, dt: float, is_sample: bool = True) -> np.ndarray:
        """Return the disturbed signal and advance to the next step.

        Args:
            signal: The signal, already multiplied by `gain`.
            dt: Time since the last call [s].
            is_sample: Whether the sensor takes a sample now, or reads the last one.
        """
        call = replace(self._call, dt=dt, is_sample=is_sample)
        for stage in self._stages:
            if stage is not Gain:
                signal = stage.reference(signal, call, self._memory[stage.name])
        if is_sample:
            self._sample = signal
        self._call = replace(self._call, step=self._call.step + 1)
        return self._sample


class Noise:
    """The batched noise of one sensor, as a module runs it; its state starts as NaN to expose any use of it."""

    def __init__(
        self, knobs: Mapping[str, Any] | Sequence[Mapping[str, Any]], layout: Layout | int = 1,
        channels: Sequence[str] = ("depth",), *, num_envs: int = 1, dt: float | int = 0.0, seed: int = 0, name: str = "touch",
        first_env: int = 0, dtype: torch.dtype = torch.float64,
    ):  # fmt: skip
        """Take the knobs of all rows, or of each; a ring must hold the shortest step, `dt` [s]."""
        self.layout = line(layout) if isinstance(layout, int) else layout
        count = self.layout.num_taxels
        sets = [Knobs.model_validate(row) for row in ([knobs] if isinstance(knobs, Mapping) else knobs)]
        which = np.zeros(count, dtype=np.int64) if len(sets) == 1 else np.arange(count)
        self.channels, self.num_envs, self.dtype = tuple(channels), num_envs, dtype
        self._rows, self.key = [sets[i] for i in which], random.sensor_key(seed, name)
        self.lowered = lower_noise(sets, which, channels, self.layout)
        self.stages = stages_of(self.lowered.terms)
        self.constants = {key: torch.tensor(value, dtype=dtype) for key, value in self.lowered.constants.items()}
        self.memory = {key: torch.full((num_envs, len(channels), count), math.nan, dtype=dtype) for key in self.lowered.memory}
        if "ring" in self.memory:
            length = max(math.ceil(self.lowered.memory["ring"] / dt - 1e-6), 1)
            self.memory["ring"] = torch.full((num_envs, length, len(channels), count), math.nan, dtype=dtype)
        self.env = torch.arange(num_envs) + first_env
        self.ages = torch.zeros(num_envs, length if "ring" in self.memory else 1, dtype=dtype)
        self.step = 0
        self.age, self.episode = torch.zeros((2, num_envs), dtype=torch.int64)

    def references(self) -> list[ReferenceNoise]:
        """Return the definition, for each environment."""
        return [ReferenceNoise(self._rows, self.channels, self.key, int(env), self.layout) for env in self.env]

    def now(self, dt: float | int = 0.0, is_sample: Tensor | None = None) -> Now:
        """Return the context of the next call."""
        step, drawn = torch.full((self.num_envs,), self.step), {}
        if self.lowered.streams:
            (drawn,) = random.streams(torch.tensor([self.key], dtype=torch.int32), self.env, step, self.episode)
        return Now(torch.tensor(dt, dtype=self.dtype), step[:, None], self.age[:, None], self.ages + dt, is_sample, None, drawn)

    def read(self, signal: Any, dt: float | int = 0.0, is_sample: Tensor | None = None) -> Tensor:
        """Return the reading of a signal, which is broadcast to (env, row, channel)."""
        shape = (self.num_envs, self.layout.num_taxels, len(self.channels))
        signal = torch.as_tensor(signal, dtype=self.dtype).expand(shape).transpose(1, 2)
        now = self.now(dt, is_sample)
        signal, new = disturb(signal, draw(self.stages, self.constants, now), "", self.memory, now)
        for key, value in new.items():
            buffer = self.memory[key]
            place = buffer[:, self.step % buffer.shape[1]] if key == "ring" else buffer
            place.copy_(value)
        self.ages = torch.cat([torch.zeros_like(self.ages[:, :1]), self.ages[:, :-1] + dt], dim=1)
        self.step += 1
        self.age += 1
        return signal.transpose(1, 2)

    def reset(self, env_ids: Any = slice(None)) -> None:
        """Start a new episode in some environments."""
        self.episode[env_ids] += 1
        self.age[env_ids] = 0


def one(noise: Noise, signal: Sequence[Any], dt: float | int) -> np.ndarray:
    """Return readings (call, row) of one environment and channel for a signal over time, equal in all rows."""
    return np.stack([noise.read(value, dt)[0, :, 0].numpy() for value in signal])


def uniform_distance(sample: np.ndarray, low: float | int, high: float | int) -> float:
    """Return √N times the largest distance of the sample's distribution from the uniform one (Kolmogorov and Smirnov)."""
    return _distance((np.sort(sample, axis=None) - low) / (high - low))


def normal_distance(sample: np.ndarray, deviation: float | int) -> float:
    """Return √N times the largest distance of the sample's distribution from a normal one of mean 0."""
    return _distance(ndtr(np.sort(sample, axis=None) / deviation))


def _distance(quantiles: np.ndarray) -> float:
    count = len(quantiles)
    steps = np.arange(count + 1) / count
    return math.sqrt(count) * float(max((steps[1:] - quantiles).max(), (quantiles - steps[:-1]).max()))


KOLMOGOROV = 2.7
"""Limit of √N times that distance: exceeded with probability 2 exp(−2 · 2.7²) = 1e-6, like 5 standard errors."""


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return √N times the correlation of two samples: normal with variance 1 if they are independent."""
    a, b = a.ravel() - a.mean(), b.ravel() - b.mean()
    return math.sqrt(a.size) * float((a @ b) / math.sqrt((a @ a) * (b @ b)))


def standard_errors(estimate: float | int, expected: float | int, error: float | int) -> float:
    """Return the deviation from the expected value in standard errors."""
    return abs(estimate - expected) / error
