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
    precision: str  # precision of the computation and of the readings
    is_own: bool  # whether it is the compiler's present choice
    chosen: Errors  # errors on the environments that the front is drawn from, relative to the reading's magnitude
    verified: Errors  # errors on the other environments
    times: Mapping[int, Interval]  # median time of a call [s], by the number of environments
    cost: Cost  # its counted cost
    # whether no other point is better in time or error and worse in neither; overlapping intervals count as equal
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
    reference: str  # reference of the errors
    check: str  # its difference from the kind's float64 definition; empty: not compared
    magnitudes: Mapping[str, str]  # magnitude to which each quantity's errors are relative, with its unit
    points: tuple[Measured, ...]  # the variants
    left_out: tuple[tuple[str, str], ...]  # unavailable variants, and why
    chosen: tuple[str, ...] = ()  # the choice of `accuracy` and its reasons, line by line; empty without `accuracy`

    @property
    def own(self) -> Measured:
        """The compiler's present choice."""
        return next(point for point in self.points if point.is_own)


@dataclass(frozen=True)
class Report:
    """A bench."""

    document: str  # the document
    machine: str  # where times were measured
    states: str  # where the states are from
    subjects: tuple[Subject, ...]  # sensors, and physics


def with_front(points: Sequence[Measured]) -> tuple[Measured, ...]:
    """Return the points; the front is marked: no other point is better in time or RMS error and worse in neither."""
    is_on_front = front_of([(point.time, point.chosen.rms) for point in points])
    return tuple(replace(point, is_on_front=is_on) for point, is_on in zip(points, is_on_front, strict=True))


def rows_of(report: Report) -> Iterator[dict[str, Any]]:
    """Yield a row of the files for each variant."""
    for subject in report.subjects:
        current = subject.own
        for point in subject.points:
            row: dict[str, Any] = {"subject": subject.name, "kind": subject.kind}
            row |= {"variant": point.label, "precision": point.precision, "is_own": point.is_own}
            row |= {"is_on_front": point.is_on_front}
            for half, errors in (("", point.chosen), ("verified_", point.verified)):
                row |= _spread(f"{half}rms", errors.rms) | _spread(f"{half}largest", errors.largest)
                row |= {f"{half}p99": errors.p99, f"{half}is_finite": errors.is_finite}
            for num_envs, interval in point.times.items():
                row |= _spread(f"seconds_{num_envs}_envs", interval)
            row |= {"times_own": point.time.value / current.time.value, "operations": point.cost.operations}
            row |= {f"{name}_bytes": getattr(point.cost, name) for name in ("constants", "state", "output")}
            yield row


def _spread(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def median_of(times: Float[np.ndarray, " call"]) -> Interval:
    """Return the median and its 95 % interval: the order statistics from a binomial distribution with p = 1/2.

    With fewer than six calls no interval is 95 % certain: it is then from the smallest to the largest.
    """
    ordered = np.sort(times)
    below = max(int(binom.ppf(0.025, len(ordered), 0.5)) - 1, 0)
    return Interval(float(np.median(ordered)), float(ordered[below]), float(ordered[len(ordered) - 1 - below]))


def times_of(calls: Mapping[str, Callable[[], Any]], repeats: int, device: torch.device) -> dict[str, Interval]:
    """Return the median time of each call [s]; the calls take turns, so that a machine's drift affects all equally."""
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
    """Return whether a point is better in one coordinate and worse in none; overlapping intervals are equal."""
    apart = [(a, b) for a, b in zip(one, other, strict=True) if not a.overlaps(b)]
    return bool(apart) and all(a.value < b.value for a, b in apart)


def front_of(points: Sequence[Sequence[Interval]]) -> list[bool]:
    """Return whether each point is dominated by no other."""
    return [not any(dominates(other, point) for other in points if other is not point) for point in points]
