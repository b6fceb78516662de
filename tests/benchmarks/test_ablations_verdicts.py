"""`benchmarks/ablations_verdicts.py`: made-up curves whose change over the last third is known."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import linregress, t

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from ablations_verdicts import is_worse, trend

SAMPLES = np.linspace(1e5, 6e6, 60)
END = SAMPLES[-1]


@pytest.mark.parametrize(("slope", "is_flat"), [(0.0, True), (0.14, True), (0.16, False), (-0.14, True), (-0.16, False)])
def test_a_straight_line_changes_by_a_third_of_its_rise(slope, is_flat):
    """Of a range of 1 it may rise by 5 % over the last third, 15 % in all, and fall by as much."""
    found = trend(SAMPLES, 0.3 + slope * SAMPLES / END)
    assert found == pytest.approx((slope / 3, slope / 3, slope / 3), abs=1e-9)
    assert found.is_flat(1.0) is is_flat


@pytest.mark.parametrize(("slope", "rises", "falls"), [(0.0, True, True), (0.16, True, False), (-0.16, False, True)])
def test_a_curve_holds_unless_it_gets_worse(slope, rises, falls):
    found = trend(SAMPLES, 0.3 + slope * SAMPLES / END)
    assert (found.holds(1.0, False), found.holds(1.0, True)) == (rises, falls)


@pytest.mark.parametrize(("rise", "is_flat"), [(0.1, True), (0.2, True), (1.0, False)])
def test_a_curve_that_levels_off_is_flat_once_it_has(rise, is_flat):
    """1 − exp(−n/τ): over the last third it rises by exp(−2N/3τ) − exp(−N/τ), 0.035 for τ = N/5, 0.15 for τ = N."""
    score = 1.0 - np.exp(-SAMPLES / (rise * END))
    exact = math.exp(-2 / (3 * rise)) - math.exp(-1 / rise)
    found = trend(SAMPLES, score)
    assert found.change == pytest.approx(exact, rel=0.12, abs=5e-4)
    assert found.is_flat(1.0) is is_flat


def test_what_came_before_does_not_matter():
    early = SAMPLES < 0.66 * END
    assert trend(SAMPLES, np.where(early, 0.0, 0.7)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_the_interval_is_that_of_least_squares():
    score = 0.5 + 0.1 * np.sin(1e3 * SAMPLES / END)
    kept = SAMPLES > 0.67 * END
    line = linregress(SAMPLES[kept] / END, score[kept])
    half = t.ppf(0.975, kept.sum() - 2) * line.stderr
    assert trend(SAMPLES, score) == pytest.approx(tuple(np.array([line.slope, line.slope - half, line.slope + half]) / 3))


def test_a_curve_too_noisy_to_tell_is_not_flat():
    noise = np.where(np.arange(60) % 2, 1.0, -1.0)
    calm, wild = (trend(SAMPLES, 0.5 + size * noise) for size in (0.02, 0.2))
    assert wild.high > 0.05 and wild.low < -0.05
    assert calm.is_flat(1.0) and not wild.is_flat(1.0)
    assert not wild.holds(1.0, False) and not wild.holds(1.0, True)


def test_of_few_points_nothing_is_said():
    score = np.full(60, np.nan)
    assert trend(SAMPLES, score) is None and trend(SAMPLES[:0], score[:0]) is None
    score[[42, 45, 50, 55]] = 1.0
    assert trend(SAMPLES, score) is None
    score[59] = 1.0
    assert trend(SAMPLES, score) is not None


def test_of_a_curve_whose_end_or_beginning_is_not_known_nothing_is_said():
    """It has levelled off as far as is known, and rises by half where it is not: scores of a last leg of parts of episodes."""
    share = SAMPLES / END
    score = 0.3 + np.clip((share - 0.76) * 2.0, 0.0, 0.5)
    for unknown in (share > 0.76, share < 0.9):
        assert trend(SAMPLES, np.where(unknown, np.nan, score)) is None
    assert not trend(SAMPLES, score).is_flat(1.0)


@pytest.mark.parametrize(
    ("one", "other", "is_less_better", "expected"),
    [
        ((0.1, 0.2), (0.3, 0.4), False, True),
        ((0.1, 0.3), (0.3, 0.4), False, False),
        ((0.3, 0.4), (0.1, 0.2), False, False),
        ((0.1, 0.2), (0.3, 0.4), True, False),
        ((0.3, 0.4), (0.1, 0.2), True, True),
        ((-math.inf, math.inf), (0.3, 0.4), False, False),
    ],
)
def test_worse_is_what_lies_apart(one, other, is_less_better, expected):
    assert is_worse(one, other, is_less_better) is expected
