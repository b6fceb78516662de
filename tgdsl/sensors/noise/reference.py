"""Random numbers of the noise in NumPy, and the inputs of a stage's float64 definition, for one environment.

It shares only constants with the batched form: hashes are of unsigned words, normal numbers are by cosine and sine.

Shapes: `row` taxels (or bodies) of the reading, `channel` its channels, `word` random words.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt64

from tgdsl.fields.models import Range
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.spec import ALL, Amplitude, range_of

Signal = Float[np.ndarray, "row channel"]
Words = UInt64[np.ndarray, "*word"]
WORD = 0xFFFFFFFF


def mix(word: Words) -> Words:
    """Return the hash of 32-bit words."""
    for shift, factor in zip(random.SHIFTS, (*random.FACTORS, 1), strict=True):
        word = (word ^ (word >> np.uint64(shift))) * np.uint64(factor) & np.uint64(WORD)
    return word


def words(key: tuple[int, int], env: int, counter: int, purpose: int, index: Words) -> Words:
    """Return words of a stream, by sensor, environment, step or episode, and purpose."""
    low, high = (np.array([part & WORD], dtype=np.uint64) for part in (counter, counter >> 32))
    halves = []
    for half, key_half in enumerate(key):
        word = mix(mix(np.array([(env ^ key_half) & WORD], dtype=np.uint64)) ^ low)
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


@dataclass
class ReferenceCall:
    """A call of one environment."""

    ranges: Sequence[Mapping[str, Range | Amplitude]]  # the stages' numbers of each row
    draws: Mapping[str, int]  # which random number of an episode says where in its range a number is
    channels: Sequence[str]  # names of the signal's channels
    key: tuple[int, int]  # the sensor's key, see `random.sensor_key`
    env: int = 0  # number of the environment
    layout: Layout | None = None  # the taxels, if there is crosstalk
    step: int = 0  # number of the call
    episode: int = 0  # how often the environment was reset
    dt: float = 0.0  # time since the last call [s]
    is_sample: bool = True  # whether the sensor takes a sample

    def words(self, purpose: int, columns: int = 1) -> UInt64[np.ndarray, "row column"]:
        """Return random words, numbered column by column."""
        index = np.arange(len(self.ranges) * columns, dtype=np.uint64).reshape(columns, -1).T
        counter = self.step if purpose in random.PER_STEP else self.episode
        return words(self.key, self.env, counter, purpose, index)

    def uniform(self, purpose: int, columns: int = 1) -> Float[np.ndarray, "row column"]:
        """Return numbers between 0 and 1."""
        return uniform(self.words(purpose, columns))

    def share(self, name: str) -> float:
        """Return where in its range a number is in this episode: 0 … 1."""
        index = np.array([self.draws[name]], dtype=np.uint64)
        return float(uniform(words(self.key, self.env, self.episode, random.PARAMETER, index))[0])

    def number(self, name: str) -> Signal:
        """Return a number's values in this episode."""
        low, high = np.array([[range_of(row[name], c) for row in self.ranges] for c in self.channels]).T
        return low + self.share(name) * (high - low)

    def range_of_row(self, row: int, name: str) -> Range:
        """Return the range of a number that is the same for all channels."""
        return range_of(self.ranges[row][name], ALL)
