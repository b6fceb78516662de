"""Hysteresis: one Maxwell branch."""

import numpy as np
import pytest
import torch
from noise_cases import Noise, one
from noise_stages import DT, EXACT

STRENGTH, TAU = 0.5, 0.05
BRANCH = {"hysteresis": {"strength": STRENGTH, "time_constant": TAU}}
PRESS = (np.array([0.0, 0.02, 0.1, 0.13, 0.15, 0.16, 0.18, 0.2, 0.3]), np.array([0.0, 2.0, 2.0, 0.5, 0.9, 0.6, 1.0, 0.0, 0.0]))
"""Press, hold, release, wiggle, let go: times [s] and values between which the signal is linear."""


def branch(t: np.ndarray) -> np.ndarray:
    """The exact answer: each bend of the signal adds a ramp's, β Δv τ (1 − e^(−t/τ))."""
    times, values = PRESS
    bends = np.diff(np.diff(values) / np.diff(times), prepend=0, append=0)
    since = np.maximum(t[:, None] - times, 0)
    return np.interp(t, times, values) + STRENGTH * TAU * ((1 - np.exp(-since / TAU)) @ bends)


def paper(signal: np.ndarray, dt: float) -> np.ndarray:
    """The paper's update."""
    lag = np.zeros(len(signal))
    for i in range(1, len(signal)):
        lag[i] = np.exp(-dt / TAU) * lag[i - 1] + signal[i] - signal[i - 1]
    return signal + STRENGTH * lag


def test_hysteresis_after_a_step():
    noise = Noise(BRANCH)
    assert noise.read(0.0, DT).item() == 0
    noise.read(1.0, 1e-15)
    found = one(noise, np.ones(200), DT)[:, 0]
    np.testing.assert_allclose(found, 1 + STRENGTH * np.exp(-DT * np.arange(1, 201) / TAU), rtol=0, atol=EXACT)


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 0.05, 10.0])
def test_hysteresis_on_a_ramp(dt):
    t, speed = dt * np.arange(200), 3.0 / dt
    expected = speed * t + STRENGTH * speed * TAU * (1 - np.exp(-t / TAU))
    np.testing.assert_allclose(one(Noise(BRANCH), speed * t, dt)[:, 0], expected, rtol=EXACT)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, EXACT), (torch.float32, 1e-4)])
def test_hysteresis_is_the_same_at_any_step(dtype, tolerance):
    common = np.arange(31) * 0.01
    expected = branch(common)
    assert np.abs(expected - np.interp(common, *PRESS)).max() > 0.3
    for parts in (1, 2, 10):
        signal = np.interp(np.arange(30 * parts + 1) * 0.01 / parts, *PRESS)
        found = one(Noise(BRANCH, dtype=dtype), signal, 0.01 / parts)[::parts, 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_the_papers_hysteresis_is_not():
    curves = [paper(np.interp(np.arange(30 * k + 1) * 0.01 / k, *PRESS), 0.01 / k)[::k] for k in (1, 2, 10)]
    assert np.abs(curves[0] - curves[1]).max() > 0.02
    assert np.abs(curves[0] - curves[2]).max() > 0.04
    assert np.abs(curves[2] - branch(np.arange(31) * 0.01)).max() < 0.01
