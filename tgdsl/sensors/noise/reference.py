"""The definition of the noise: the equations of `stages`, for one environment, in plain float64 NumPy.

The batched form shares nothing with it but constants and the names of quantities: hashes are of unsigned words, normal numbers
are by cosine and sine, the delay interpolates in a list of all times and signals since the reset, and crosstalk is a sum over
pairs of taxels.

Shapes: `row` taxels (or bodies) of the reading, `channel` its channels, `word` random words.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt64

from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.lower import quantity
from tgdsl.sensors.noise.spec import ALL, ZERO, Knobs, Range
from tgdsl.sensors.noise.stages import PARAMETERS

Signal = Float[np.ndarray, "row channel"]
Words = UInt64[np.ndarray, "*word"]
WORD = 0xFFFFFFFF


def mix(word: Words) -> Words:
    """Return the hash of 32-bit words."""
    for shift, factor in zip(random.SHIFTS, (*random.FACTORS, 1), strict=True):
        word = (word ^ (word >> np.uint64(shift))) * np.uint64(factor) & np.uint64(WORD)
    return word


def words(key: tuple[int, int], env: int, counter: int, purpose: int, index: Words) -> Words:
    """Return words of a stream, by a sensor's key, the environment's number, that of the step or episode, and their purpose."""
    low, high = (np.array([part & WORD], dtype=np.uint64) for part in (counter, counter >> 32))
    halves = []
    for half, own in enumerate(key):
        word = mix(mix(np.array([(env ^ own) & WORD], dtype=np.uint64)) ^ low)
        halves.append(mix(word ^ mix(high) ^ np.uint64(random.PURPOSES[2 * purpose + half])))
    return mix(index ^ halves[0]) ^ halves[1]


def uniform(word: Words) -> Float[np.ndarray, "*word"]:
    """Return numbers between 0 and 1: the middles of 2²³ equal parts."""
    return ((word >> np.uint64(32 - random.UNIFORM_BITS)) + 0.5) / 2.0**random.UNIFORM_BITS


def normal_pair(word: Words) -> tuple[Float[np.ndarray, "*word"], Float[np.ndarray, "*word"]]:
    """Return two independent normal numbers for each word (Box and Muller 1958)."""
    share = ((word >> np.uint64(32 - random.RADIUS_BITS)) + 0.5) / 2.0**random.RADIUS_BITS
    part = ((word >> np.uint64(2)) % np.uint64(2**random.ANGLE_BITS) + 0.5) / 2.0**random.ANGLE_BITS - 0.5
    small = part * math.pi / 2
    angle = np.where(word & np.uint64(2), math.pi - small, small)
    angle = np.where(word & np.uint64(1), math.pi / 2 - angle, angle)
    radius = np.sqrt(-2 * np.log(share))
    return radius * np.cos(angle), radius * np.sin(angle)


class ReferenceNoise:
    """The imperfections of one sensor in one environment, fed call by call."""

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
        self._knobs, self._channels, self._layout = knobs, channels, layout
        self._key, self._env, self._shape = key, env, (len(knobs), len(channels))
        self.step, self.episode = 0, -1
        self.reset()

    def reset(self) -> None:
        """Begin a new episode: draw what holds throughout, and forget the past."""
        self.episode += 1
        self._drawn: dict[str, np.ndarray] = {}
        low, high = self._knob("gain_low"), self._knob("gain_high")
        self.gain: Signal = low + self._uniform(random.GAIN)[:, :1] * (high - low)
        share = self._uniform(random.DEAD, 2)
        self.is_dead = share[:, :1] < self._knob("dead_probability")
        low, high = self._knob("dead_low"), self._knob("dead_high")
        self.stuck: Signal = low + share[:, 1:] * (high - low)
        self.crosstalk = self._crosstalk()
        self._times: list[float] = []
        self._signals: list[np.ndarray] = []
        self._last, self._lag, self._walk = np.zeros((3, *self._shape))

    def radius(self, radius: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Return this step's radii of probes whose own are given [m]."""
        disturbed = radius[:, None] + self._knob("radius_noise") * (2 * self._uniform(random.RADIUS) - 1)
        return np.maximum(0, disturbed[:, 0])

    def read(self, signal: Signal, dt: float, is_sample: bool = True) -> Signal:
        """Return what is read of a signal, and go on to the next step.

        Args:
            signal: The signal, of which `gain` is a factor already.
            dt: Time since the last call [s].
            is_sample: Whether the sensor takes a sample now; else it reads the last one.
        """
        x = self.crosstalk @ self._with_hysteresis(signal, dt)
        self._times.append(self._times[-1] + dt if self._times else 0.0)
        self._signals.append(x)
        if is_sample:
            y, q = self._delayed() + self._knob("bias") + self._random_offset(), self._knob("quantization")
            y = np.where(q > 0, q * np.round(y / np.where(q > 0, q, 1.0)), y)
            self._held = np.where(self.is_dead, self.stuck, y)
        self.step += 1
        return self._held

    def _with_hysteresis(self, x: Signal, dt: float) -> Signal:
        if self._times:
            r = dt / self._knob("hysteresis_time")
            self._lag = np.exp(-r) * self._lag - np.expm1(-r) / r * (x - self._last)
        self._last = x
        return x + self._knob("hysteresis_strength") * self._lag

    def _crosstalk(self) -> Float[np.ndarray, "row row"]:
        """Return W (to, from)."""
        strength, mixture, mixed = (
            self._knob("crosstalk_strength")[:, 0],
            self._share("crosstalk_mixture"),
            np.eye(self._shape[0]),
        )
        for i in np.flatnonzero(strength).tolist():
            low, high = (self._given(i, sigma) for sigma in _range(self._knobs[i], "crosstalk_sigma", ALL))
            mixed[:, i] = (1 - strength[i]) * mixed[:, i] + strength[i] * (low + mixture * (high - low))
        return mixed

    def _given(self, i: int, sigma: float) -> Float[np.ndarray, " row"]:
        """Return what share of taxel i's signal each taxel gets."""
        layout = self._layout
        assert layout is not None
        kernel = np.zeros(layout.num_taxels)
        for j in range(layout.num_taxels):
            are_active = layout.radius[i] > 0 and layout.radius[j] > 0
            if i == j or (are_active and layout.link_id[i] == layout.link_id[j] and layout.normal[i] @ layout.normal[j] > 0):
                kernel[j] = math.exp(-sum((layout.pos[i] - layout.pos[j]) ** 2) / (2 * sigma**2))
        return kernel / kernel.sum()

    def _delayed(self) -> Signal:
        """Return the signal as it was: between two calls it is linear, before the first one it is constant."""
        late = self._knob("read_delay") + self._uniform(random.JITTER)[0, 0] * self._knob("jitter")
        past, result = np.array(self._signals), np.empty(self._shape)
        for place in np.ndindex(self._shape):
            result[place] = np.interp(self._times[-1] - late[place], self._times, past[:, *place])
        return result

    def _random_offset(self) -> Signal:
        noise, step = normal_pair(self._words(random.READING, self._shape[1]))
        self._walk = self._walk + self._knob("drift") * step
        return self._knob("white_noise") * noise + self._walk

    def _words(self, purpose: int, columns: int = 1) -> UInt64[np.ndarray, "row column"]:
        """Return random words, numbered column by column."""
        index = np.arange(self._shape[0] * columns, dtype=np.uint64).reshape(columns, -1).T
        counter = self.step if purpose in random.PER_STEP else self.episode
        return words(self._key, self._env, counter, purpose, index)

    def _uniform(self, purpose: int, columns: int = 1) -> Float[np.ndarray, "row column"]:
        return uniform(self._words(purpose, columns))

    def _share(self, name: str) -> float:
        """Return where in its range a knob is in this episode: 0 … 1."""
        index = np.array([PARAMETERS.index(name)], dtype=np.uint64)
        return float(uniform(words(self._key, self._env, self.episode, random.PARAMETER, index))[0])

    def _knob(self, name: str) -> Signal:
        """Return a knob's values in this episode."""
        if name not in self._drawn:
            low, high = np.array([[_range(own, name, c) for own in self._knobs] for c in self._channels]).T
            self._drawn[name] = low + self._share(name) * (high - low)
        return self._drawn[name]


def _range(knobs: Knobs, name: str, channel: str) -> Range:
    """Return the range of a number that `PARAMETERS` names; that of a stage that is off is neutral."""
    match name.split("_"):
        case ["gain" | "dead", "low" | "high" as end]:
            result = getattr(knobs, "gain" if name.startswith("gain") else "dead_range")[("low", "high").index(end)]
        case ["hysteresis" | "crosstalk" as stage, part]:
            own = getattr(knobs, stage)
            field = "time_constant" if part == "time" else part
            result = getattr(own, field) if own else ZERO if part == "strength" else (1.0, 1.0)
        case _:
            result = getattr(knobs, name)
    if isinstance(result, tuple):
        return result
    return result.get(quantity(channel), result.get(ALL, ZERO))
