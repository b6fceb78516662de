"""What a bench finds, its rows for a table or a file, times of calls, and the front of time and error.

Shapes: `call` calls of one kind.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import binom

from tgdsl.module.accuracy.errors import Errors, Interval
from tgdsl.tuning.trials import Cost

WARM_UP = 2  # calls of each before the first one that is timed


@dataclass(frozen=True)
class Measured:
    """A variant, measured."""

    label: str  # what to call it
    precision: str  # of what is computed and returned
    is_own: bool  # whether it is what the compiler takes now
    chosen: Errors  # errors on the environments that the front is drawn from, relative to the reading's magnitude
    verified: Errors  # the same on the others
    times: Mapping[int, Interval]  # median time of a call [s], by the number of environments
    cost: Cost  # what it takes, counted
    # whether no other is better in time or error, and worse in neither; where intervals overlap two are equal
    is_on_front: bool = False

    @property
    def time(self) -> Interval:
        """Median time of a call with the most environments [s]."""
        return self.times[max(self.times)]


@dataclass(frozen=True)
class Subject:
    """A sensor, or the physics, in all variants."""

    name: str  # its name
    kind: str  # its kind
    reference: str  # what errors are measured against
    check: str  # how far that is from the kind's float64 definition; empty: not compared
    magnitudes: Mapping[str, str]  # what each quantity's errors are relative to, with its unit
    points: tuple[Measured, ...]  # the variants
    left_out: tuple[tuple[str, str], ...]  # variants that cannot be had, and why
    chosen: tuple[str, ...] = ()  # what `accuracy` chose and why, line by line; empty: there is none

    @property
    def own(self) -> Measured:
        """What the compiler takes now."""
        return next(point for point in self.points if point.is_own)


@dataclass(frozen=True)
class Report:
    """A bench."""

    document: str  # the document
    machine: str  # where times were measured
    states: str  # where the states are from
    subjects: tuple[Subject, ...]  # sensors, and physics


def with_front(points: Sequence[Measured]) -> tuple[Measured, ...]:
    """Return the points, marked where no other is better in time or RMS error and worse in neither."""
    is_on_front = front_of([(point.time, point.chosen.rms) for point in points])
    return tuple(replace(point, is_on_front=is_on) for point, is_on in zip(points, is_on_front, strict=True))


def rows_of(report: Report) -> Iterator[dict[str, Any]]:
    """Yield a row for each variant: what stands in the files."""
    for subject in report.subjects:
        own = subject.own
        for point in subject.points:
            row: dict[str, Any] = {"subject": subject.name, "kind": subject.kind}
            row |= {"variant": point.label, "precision": point.precision, "is_own": point.is_own}
            row |= {"is_on_front": point.is_on_front}
            for half, errors in (("", point.chosen), ("verified_", point.verified)):
                row |= _spread(f"{half}rms", errors.rms) | _spread(f"{half}largest", errors.largest)
                row |= {f"{half}p99": errors.p99, f"{half}is_finite": errors.is_finite}
            for num_envs, interval in point.times.items():
                row |= _spread(f"seconds_{num_envs}_envs", interval)
            row |= {"times_own": point.time.value / own.time.value, "operations": point.cost.operations}
            row |= {f"{name}_bytes": getattr(point.cost, name) for name in ("constants", "state", "output")}
            yield row


def _spread(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def median_of(times: Float[np.ndarray, " call"]) -> Interval:
    """Return the median and its 95 % interval: the order statistics that a binomial distribution of 1/2 gives.

    Of fewer than six calls no two order statistics are 95 % certain: the interval is then from the least to the largest.
    """
    ordered = np.sort(times)
    below = max(int(binom.ppf(0.025, len(ordered), 0.5)) - 1, 0)
    return Interval(float(np.median(ordered)), float(ordered[below]), float(ordered[len(ordered) - 1 - below]))


def times_of(calls: Mapping[str, Callable[[], Any]], repeats: int, device: torch.device) -> dict[str, Interval]:
    """Return the median time of each call [s]; calls are made in turn, so that a machine that drifts disturbs all alike."""
    times: dict[str, list[float]] = {name: [] for name in calls}

    def wait() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    with torch.no_grad():
        for i in range(repeats + WARM_UP):
            for name, call in calls.items():
                wait()
                start = time.perf_counter()
                call()
                wait()
                if i >= WARM_UP:
                    times[name].append(time.perf_counter() - start)
    return {name: median_of(np.array(seconds)) for name, seconds in times.items()}


def dominates(one: Sequence[Interval], other: Sequence[Interval]) -> bool:
    """Return whether a point is better in something, and worse in nothing; overlapping intervals are equal."""
    apart = [(a, b) for a, b in zip(one, other, strict=True) if not a.overlaps(b)]
    return bool(apart) and all(a.value < b.value for a, b in apart)


def front_of(points: Sequence[Sequence[Interval]]) -> list[bool]:
    """Return which points no other point dominates."""
    return [not any(dominates(other, point) for other in points if other is not point) for point in points]
