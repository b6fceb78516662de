"""Errors of readings, against numbers by hand."""

import numpy as np
import pytest

from tgdsl.module.accuracy.errors import errors_of, magnitude_of

QUANTITIES = ("force", "force", "heat")


def readings():
    """Return two steps of four environments with five rows, at rest except one row of (3, −4) N and one of 10 K."""
    exact = np.zeros((2, 4, 5, 3))
    exact[..., 2] = 20.0
    exact[1, :, 0, 0], exact[1, :, 0, 1], exact[1, :, 2, 2] = 3.0, -4.0, 30.0
    return exact


def test_magnitudes_are_per_quantity_and_relative_to_the_median():
    magnitude = magnitude_of(readings(), QUANTITIES)
    np.testing.assert_array_equal(magnitude.rest, [0.0, 0.0, 20.0])
    np.testing.assert_array_equal(magnitude.scale, [4.0, 4.0, 10.0])
    assert magnitude.active.sum() == 4 * 3


def test_a_constant_reading_has_magnitude_one():
    assert magnitude_of(np.full((1, 2, 1, 1), 7.0), ("x",)).scale.tolist() == [1.0]


def test_errors_are_relative_and_rms_is_over_active_readings():
    exact, approximate = readings(), readings()
    approximate[1, :, 0, 0] += 0.4  # a tenth of 4 N, in each environment
    approximate[0, 0, 4, 2] -= 5.0  # half of 10 K, in an inactive reading
    errors = errors_of(approximate, exact, magnitude_of(exact, QUANTITIES))
    assert errors.largest.value == 0.5
    assert errors.rms.value == pytest.approx(np.sqrt((4 * 0.01 + 0.25) / 12), rel=1e-12)
    absolute = errors_of(approximate, exact, magnitude_of(exact, QUANTITIES), is_relative=False)
    assert absolute.largest.value == 5.0


def test_p99_is_exceeded_by_one_percent_of_active_readings():
    """Ten of 1000 active readings may exceed it: it is the eleventh largest error."""
    rng = np.random.default_rng(0)
    exact = np.concatenate([np.zeros((1, 10, 110, 1)), np.ones((1, 10, 100, 1))], axis=2)
    error = rng.permutation(np.arange(1, 1001)).reshape(1, 10, 100, 1) * 1e-3
    approximate = exact.copy()
    approximate[:, :, 110:] += error
    assert errors_of(approximate, exact, magnitude_of(exact, ("x",))).p99 == pytest.approx(0.990, rel=1e-12)


def test_intervals_contain_the_value_and_are_reproducible():
    rng = np.random.default_rng(1)
    exact, noise = rng.normal(size=(3, 16, 8, 1)), 0.01 * rng.normal(size=(3, 16, 8, 1))
    magnitude = magnitude_of(exact, ("x",))
    one, two = (errors_of(exact + noise, exact, magnitude, seed=3) for _ in range(2))
    assert one == two
    assert one.rms.low < one.rms.value < one.rms.high
    assert one.largest.low < one.largest.value == one.largest.high
    # Expected width for the RMS of N = 384 errors σ: ± 1.96 σ/√(2 N).
    assert one.rms.high - one.rms.low == pytest.approx(2 * 1.96 * 0.01 / np.sqrt(2 * 384) / magnitude.scale[0], rel=0.4)


def test_errors_that_are_not_finite_are_flagged():
    exact, approximate = readings(), readings()
    approximate[0, 1, 0, 0] = np.nan
    errors = errors_of(approximate, exact, magnitude_of(exact, QUANTITIES))
    assert not errors.is_finite and errors.largest.value == np.inf
