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
    """On a range of 1 a flat curve rises or falls at most 5 % over the last third, 15 % in all."""
    result = trend(SAMPLES, 0.3 + slope * SAMPLES / END)
    assert result == pytest.approx((slope / 3, slope / 3, slope / 3), abs=1e-9)
    assert result.is_flat(1.0) is is_flat


@pytest.mark.parametrize(("slope", "rises", "falls"), [(0.0, True, True), (0.16, True, False), (-0.16, False, True)])
def test_a_curve_holds_unless_it_gets_worse(slope, rises, falls):
    result = trend(SAMPLES, 0.3 + slope * SAMPLES / END)
    assert (result.holds(1.0, False), result.holds(1.0, True)) == (rises, falls)


@pytest.mark.parametrize(("rise", "is_flat"), [(0.1, True), (0.2, True), (1.0, False)])
def test_a_saturating_curve_is_flat_once_it_levels_off(rise, is_flat):
    """1 − exp(−n/τ): over the last third it rises by exp(−2N/3τ) − exp(−N/τ), 0.035 for τ = N/5, 0.15 for τ = N."""
    score = 1.0 - np.exp(-SAMPLES / (rise * END))
    exact = math.exp(-2 / (3 * rise)) - math.exp(-1 / rise)
    result = trend(SAMPLES, score)
    assert result.change == pytest.approx(exact, rel=0.12, abs=5e-4)
    assert result.is_flat(1.0) is is_flat


def test_earlier_samples_do_not_matter():
    early = SAMPLES < 0.66 * END
    assert trend(SAMPLES, np.where(early, 0.0, 0.7)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_the_interval_matches_least_squares():
    score = 0.5 + 0.1 * np.sin(1e3 * SAMPLES / END)
    is_late = SAMPLES > 0.67 * END
    line = linregress(SAMPLES[is_late] / END, score[is_late])
    half = t.ppf(0.975, is_late.sum() - 2) * line.stderr
    assert trend(SAMPLES, score) == pytest.approx(tuple(np.array([line.slope, line.slope - half, line.slope + half]) / 3))


def test_a_curve_too_noisy_to_tell_is_not_flat():
    noise = np.where(np.arange(60) % 2, 1.0, -1.0)
    calm, wild = (trend(SAMPLES, 0.5 + size * noise) for size in (0.02, 0.2))
    assert wild.high > 0.05 and wild.low < -0.05
    assert calm.is_flat(1.0) and not wild.is_flat(1.0)
    assert not wild.holds(1.0, False) and not wild.holds(1.0, True)


def test_few_points_have_no_trend():
    score = np.full(60, np.nan)
    assert trend(SAMPLES, score) is None and trend(SAMPLES[:0], score[:0]) is None
    score[[42, 45, 50, 55]] = 1.0
    assert trend(SAMPLES, score) is None
    score[59] = 1.0
    assert trend(SAMPLES, score) is not None


def test_a_curve_with_unknown_ends_has_no_trend():
    """The known part is flat, and the unknown part rises by half."""
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
def test_worse_intervals_lie_apart(one, other, is_less_better, expected):
    assert is_worse(one, other, is_less_better) is expected
