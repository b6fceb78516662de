"""The Pareto front of hand-placed points with intervals, intervals of medians, and times of calls."""

import numpy as np
import pytest
import torch

from tgdsl.module.accuracy.errors import Interval
from tgdsl.report.bench import results
from tgdsl.report.bench.results import dominates, front_of, median_of, times_of


def point(time, error, half=0.1):
    return tuple(Interval(value, value - half, value + half) for value in (time, error))


def test_front_of_points_far_apart():
    """(1, 3) and (3, 1) are the front; both dominate (3, 3)."""
    assert front_of([point(1, 3), point(3, 1), point(3, 3)]) == [True, True, False]


def test_overlapping_points_are_equal():
    """Errors of 1.0 ± 0.1 and 1.15 ± 0.1 overlap, so the slower point is off the front."""
    assert front_of([point(1, 1.15), point(2, 1.0)]) == [True, False]
    assert front_of([point(1, 1.15), point(1.15, 1.0)]) == [True, True]


def test_touching_intervals_overlap():
    low, high = Interval(1.0, 0.5, 1.5), Interval(2.0, 1.5, 2.5)
    assert low.overlaps(high) and high.overlaps(low)
    assert not low.overlaps(Interval(2.0, 1.6, 2.5))


def test_a_point_does_not_dominate_itself_or_its_equal():
    assert not dominates(point(1, 1), point(1, 1))
    assert front_of([point(1, 1)] * 2) == [True, True]


def test_one_point_can_dominate_two_equal_ones():
    assert front_of([point(2, 2), point(2.1, 2.1), point(1, 1)]) == [False, False, True]


@pytest.mark.parametrize(("count", "low", "high"), [(1, 1, 1), (5, 1, 5), (6, 1, 6), (9, 2, 8), (15, 4, 12), (20, 6, 15)])
def test_intervals_of_medians_match_published_tables(count, low, high):
    """Ranks of the 95 % interval of a median, from tables of the sign test (e.g. 2 and 8 of nine)."""
    times = np.random.default_rng(0).permutation(np.arange(1.0, count + 1))
    assert median_of(times) == Interval((count + 1) / 2, low, high)


def test_calls_take_turns_after_two_untimed_ones(monkeypatch):
    now, order = 0.0, []

    def call(name: str, seconds: list[float]) -> None:
        nonlocal now
        order.append(name)
        now += seconds.pop(0)

    monkeypatch.setattr(results.time, "perf_counter", lambda: now)
    lasting = {"a": [9.0, 8.0, 1.0, 2.0, 3.0], "b": [9.0, 8.0, 4.0, 4.0, 5.0]}
    calls = {name: lambda name=name: call(name, lasting[name]) for name in lasting}
    assert times_of(calls, 3, torch.device("cpu")) == {"a": Interval(2, 1, 3), "b": Interval(4, 4, 5)}
    assert order == ["a", "b"] * 5
