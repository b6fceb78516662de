"""Errors of readings relative to their magnitude, with intervals.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Readings = Float[np.ndarray, "step env row channel"]
RESAMPLES, TAILS = 400, (2.5, 97.5)  # bootstrap samples, and the percentiles that an interval reaches from and to


class Interval(NamedTuple):
    """A number, and the 95 % interval around it."""

    value: float
    low: float
    high: float

    def overlaps(self, other: Interval) -> bool:
        """Whether two intervals have a point in common: the numbers then count as equal."""
        return self.low <= other.high and other.low <= self.high


class Magnitude(NamedTuple):
    """Magnitude of a reading, to which its errors are relative."""

    rest: Float[np.ndarray, " channel"]  # median of each channel
    # largest difference of a channel from its median, or of one of the same quantity (`force` of `force_x`); 1 where nothing
    # ever changes
    scale: Float[np.ndarray, " channel"]
    active: Bool[np.ndarray, "step env row channel"]  # where the exact reading is not at its median

    def of(self, envs: slice, channels: Sequence[int]) -> Magnitude:
        """Return the magnitude of some channels in some environments."""
        return Magnitude(self.rest[channels], self.scale[channels], self.active[:, envs][..., channels])


class Errors(NamedTuple):
    """Errors of a reading."""

    rms: Interval  # root of the sum of squared errors over the number of active readings
    largest: Interval  # the largest
    p99: float  # 99th percentile over the number of active readings; errors of inactive readings count too
    is_finite: bool  # whether all readings are finite numbers


def halves(num_envs: int) -> tuple[slice, slice]:
    """Return the environments that choose between variants and the environments that verify the choice.

    Objects vary by `env % number`: each half of consecutive environments has all of them, every second environment has not.
    """
    half = (num_envs + 1) // 2
    return slice(0, half), slice(half, num_envs)


def magnitude_of(expected: Readings, quantities: Sequence[str]) -> Magnitude:
    """Return the magnitude to which a reading's errors are relative; `quantities` names each channel's quantity."""
    rest = np.median(expected.reshape(-1, expected.shape[-1]), axis=0)
    away = np.abs(expected - rest)
    largest = away.max(axis=(0, 1, 2), initial=0.0)
    names = np.array(quantities)
    scale = np.array([largest[names == name].max() for name in quantities])
    return Magnitude(rest, np.where(scale > 0, scale, 1.0), away > 0)


def errors_of(found: Readings, expected: Readings, magnitude: Magnitude, is_relative: bool = True, seed: int = 0) -> Errors:
    """Return the errors of readings, each relative to its channel's magnitude.

    Intervals are a bootstrap over environments, whose states are correlated in time but independent of each other.
    """
    is_finite = bool(np.isfinite(found).all())
    error = np.abs(found - expected) / (magnitude.scale if is_relative else 1.0)
    error = np.where(np.isfinite(error), error, np.inf)
    squares, worst = (error**2).sum(axis=(0, 2, 3)), error.max(axis=(0, 2, 3), initial=0.0)
    counts = magnitude.active.sum(axis=(0, 2, 3))
    sampled = np.random.default_rng(seed).integers(error.shape[1], size=(RESAMPLES, error.shape[1]))
    rms = np.sqrt(squares[sampled].sum(axis=1) / np.maximum(counts[sampled].sum(axis=1), 1))
    flat, num_worse = error.reshape(-1), int(counts.sum()) // 100
    place = len(flat) - 1 - num_worse
    p99 = float(np.partition(flat, place)[place]) if place >= 0 else 0.0
    return Errors(
        rms=_interval(float(np.sqrt(squares.sum() / max(counts.sum(), 1))), rms),
        largest=_interval(float(worst.max(initial=0.0)), worst[sampled].max(axis=1)),
        p99=p99,
        is_finite=is_finite,
    )


def _interval(value: float, samples: Float[np.ndarray, " sample"]) -> Interval:
    low, high = np.percentile(samples, TAILS, method="nearest")
    return Interval(value, min(float(low), value), max(float(high), value))
