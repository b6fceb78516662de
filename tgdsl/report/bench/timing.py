"""Times of calls made in turn, so that a machine that drifts disturbs all alike; the front of time and error.

Shapes: `call` calls of one kind.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import binom

from tgdsl.module.accuracy.errors import Interval

WARM_UP = 2  # calls of each before the first one that is timed


def median_of(times: Float[np.ndarray, " call"]) -> Interval:
    """Return the median and its 95 % interval: the order statistics that a binomial distribution of 1/2 gives.

    Of fewer than six calls no two order statistics are 95 % certain: the interval is then from the least to the largest.
    """
    ordered = np.sort(times)
    below = max(int(binom.ppf(0.025, len(ordered), 0.5)) - 1, 0)
    return Interval(float(np.median(ordered)), float(ordered[below]), float(ordered[len(ordered) - 1 - below]))


def times_of(calls: Mapping[str, Callable[[], Any]], repeats: int, device: torch.device) -> dict[str, Interval]:
    """Return the median time of each call [s].

    Args:
        calls: What is timed, by name.
        repeats: Timed calls of each.
        device: Where it computes.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    with torch.no_grad():
        for i in range(repeats + WARM_UP):
            for name, call in calls.items():
                _wait(device)
                start = time.perf_counter()
                call()
                _wait(device)
                if i >= WARM_UP:
                    times[name].append(time.perf_counter() - start)
    return {name: median_of(np.array(seconds)) for name, seconds in times.items()}


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def dominates(one: Sequence[Interval], other: Sequence[Interval]) -> bool:
    """Return whether a point is better in something, and worse in nothing; overlapping intervals are equal."""
    apart = [(a, b) for a, b in zip(one, other, strict=True) if not a.overlaps(b)]
    return bool(apart) and all(a.value < b.value for a, b in apart)


def front_of(points: Sequence[Sequence[Interval]]) -> list[bool]:
    """Return which points no other point dominates."""
    return [not any(dominates(other, point) for other in points if other is not point) for point in points]
