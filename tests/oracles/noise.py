"""Noise: statistics of a million samples of each stage.

Statistics are given in standard errors, or as √N times the largest distance of distributions (Kolmogorov and Smirnov).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.signals import (
    KOLMOGOROV,
    MM,
    Noise,
    normal_distance,
    standard_errors,
    uniform_distance,
)
from tgdsl.sensors.noise import stages

NUM, SIDE = 10**6, 1000
"""Samples: of 1000 environments with 1000 rows."""
DT = 2e-3
"""Seconds between calls."""
KINDS = ("noise",)
ERRORS = 5.0
"""Standard errors that a statistic may be off."""


def million(knobs: dict[str, Any], **more: Any) -> Noise:
    """Return noise of a million rows."""
    return Noise(knobs, SIDE, num_envs=SIDE, **{"dtype": torch.float32, **more})


def reading(noise: Noise, signal: Any = 0.0) -> np.ndarray:
    """Return a reading of all rows of the first channel, (env, row)."""
    return noise.read(signal, DT)[..., 0].double().numpy()


def variance_error(sample: np.ndarray, expected: float, kurtosis: float = 3.0) -> float:
    """Return how many standard errors the variance of a sample of mean 0 is off."""
    return standard_errors((sample**2).mean(), expected, expected * np.sqrt((kurtosis - 1) / sample.size))


def _statistics(name: str, source: str, equation: str, found: dict[str, float], **more: Any) -> Comparison:
    """Return statistics of which each may be off by some standard errors; a distance of distributions is scaled to them."""
    return Comparison(
        name, source, equation, KINDS, "standard errors", "1", cases(list(found)), np.zeros(len(found)),
        array(list(found.values())), atol=ERRORS, **more,
    )  # fmt: skip


def _distance(value: float) -> float:
    """Return √N times a distance of distributions, in what counts as standard errors."""
    return value / KOLMOGOROV * ERRORS


def white_noise(sigma: float = 5e-3) -> Comparison:
    """Return mean, variance and distribution of white noise."""
    found = reading(million({"white_noise": sigma}), 1.0) - 1
    return _statistics(
        "White noise is normal",
        "normal distribution",
        "N(0, σ²)",
        {
            "mean": standard_errors(found.mean(), 0, sigma / np.sqrt(NUM)),
            "variance": variance_error(found, sigma**2),
            "distribution": _distance(normal_distance(found, sigma)),
        },
    )


def drift(sigma: float = 1e-3) -> Comparison:
    """Return the variance of drift over the number of readings: σ² n."""
    noise, counts, found = million({"drift": sigma}), (1, 2, 4, 8, 16), []
    for n in range(1, 17):
        walk = reading(noise)
        if n in counts:
            found.append((walk**2).mean() / sigma**2)
    return Comparison(
        "Drift is a random walk",
        "variance of a sum of independent steps",
        "var = σ² n",
        KINDS,
        "variance over σ²",
        "1",
        along("readings", "1", counts),
        array(counts),
        array(found),
        rtol=ERRORS * np.sqrt(2 / NUM),
    )


def drift_distribution(sigma: float = 1e-3) -> Comparison:
    """Return means and distribution of drift after 1 to 16 readings, and of its last steps."""
    noise, walk, found = million({"drift": sigma}), np.zeros((SIDE, SIDE)), {}
    for n in range(1, 17):
        before, walk = walk, reading(noise)
        if n in (1, 2, 4, 8, 16):
            found[f"mean of {n}"] = standard_errors(walk.mean(), 0, sigma * np.sqrt(n / NUM))
    found["walk"] = _distance(normal_distance(walk, 4 * sigma))
    found["step"] = _distance(normal_distance(walk - before, sigma))
    return _statistics("Drift is normal, step by step", "normal distribution", "N(0, σ² n)", found)


def quantiser(step: float = 0.01) -> Comparison:
    """Return the quantiser's error of a smooth signal: uniform within half a step, of variance q²/12."""
    t = np.linspace(0, 1, NUM).reshape(SIDE, SIDE, 1)
    signal = 3 * np.sin(7 * t) + t
    found = reading(million({"quantization": step}, dtype=torch.float64), signal)
    error = found - signal[..., 0]
    on_grid = np.abs(found / step - np.round(found / step)).max() <= 1e-9
    within = np.abs(error).max() <= step / 2 * (1 + 1e-12)
    return _statistics(
        "The quantiser's error is uniform",
        "Bennett 1948",
        "var = q²/12, |ε| ≤ q/2",
        {
            "mean": standard_errors(error.mean(), 0, step / np.sqrt(12 * NUM)),
            "variance": variance_error(error, step**2 / 12, kurtosis=1.8),
            "within half a step, on the grid": 0.0 if within and on_grid else np.inf,
        },
    )


def dead_share(share: float = 0.05, low: float = -1.0, high: float = 3.0) -> Comparison:
    """Return how many taxels are dead, in all and by environment, and how what they are stuck at is spread."""
    noise = million({"dead_probability": share, "dead_range": [low, high]})
    first = reading(noise, 100.0)
    is_dead = first != 100
    spread = SIDE * share * (1 - share)
    return _statistics(
        "Dead taxels are binomial, stuck uniformly",
        "binomial and uniform distributions",
        "p ± √(p(1−p)/N)",
        {
            "share": standard_errors(is_dead.mean(), share, np.sqrt(share * (1 - share) / NUM)),
            "variance by environment": standard_errors(is_dead.sum(axis=1).var(), spread, spread * np.sqrt(2 / SIDE)),
            "distribution": _distance(uniform_distance(first[is_dead], low, high)),
        },
    )


def gains(low: float = 0.85, high: float = 1.15) -> Comparison:
    """Return how gains are spread, first and after a reset."""
    noise = million({"gain": [low, high]}, dtype=torch.float64)
    first = reading(noise, 1.0)
    noise.reset(np.arange(SIDE) < 500)
    second = reading(noise, 1.0)
    return _statistics(
        "Gains are uniform",
        "uniform distribution",
        "U(a, b)",
        {
            "first": _distance(uniform_distance(first, low, high)),
            "after a reset": _distance(uniform_distance(second, low, high)),
            "held by the others": 0.0 if (second[500:] == first[500:]).all() else np.inf,
        },
        defects=(16,),
    )


def radii(width: float = 0.3 * MM) -> Comparison:
    """Return how radii are spread at two steps."""
    noise, like, found = million({"radius_noise": width}), torch.zeros(SIDE, SIDE), {}
    for name in ("first", "second"):
        now = noise.now()
        values = stages.knob_values(noise.constants, now)["radius_noise"]
        shift = stages.radius_shift(values, now, like).double().numpy()
        found[name] = _distance(uniform_distance(shift, -width, width)) if np.abs(shift).max() <= width else np.inf
        noise.read(0.0)
    return _statistics("Radii are uniform at each step", "uniform distribution", "U(−w, w)", found, defects=(9,))


def ages(parts: float, num_envs: int = 5000) -> Comparison:
    """Return how old readings with jitter are: uniform, whatever the step."""
    dt, low, high = DT / parts, 10e-3, 18e-3
    noise, sample = Noise({"read_delay": low, "jitter": high - low}, 2, num_envs=num_envs, dt=dt), []
    first = int(np.ceil(high / dt))
    for call in range(first + 200):
        found = noise.read(call * dt, dt)
        if call >= first:
            sample.append(call * dt - found[:, 0, 0].numpy())
    every = np.stack(sample)
    within = every.min() > low - 1e-12 and every.max() < high + 1e-12
    return _statistics(
        f"Ages of readings with jitter are uniform, calls every {1e3 * dt:g} ms",
        "uniform distribution",
        "U(Δ, Δ + J)",
        {"distribution": _distance(uniform_distance(every, low, high)), "within": 0.0 if within else np.inf},
    )


ORACLES: tuple[Oracle, ...] = (
    white_noise,
    drift,
    drift_distribution,
    quantiser,
    dead_share,
    gains,
    radii,
    *(partial(ages, parts) for parts in (0.1, 1.0)),
)
