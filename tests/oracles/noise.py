"""Noise: statistics of a million samples of each stage.

Statistics are given in standard errors, or as √N times the largest distance of distributions (Kolmogorov and Smirnov).
"""

from functools import partial
from typing import Any

import numpy as np
import torch

from oracles.comparison import Values, field
from oracles.setups.signals import KOLMOGOROV, MM, Noise, normal_distance, standard_errors, uniform_distance
from tgdsl.sensors.noise.pipeline import draw
from tgdsl.sensors.noise.stages import Radius

NUM, SIDE = 10**6, 1000
"""Samples: of 1000 environments with 1000 rows."""
DT = 2e-3
"""Seconds between calls."""
ERRORS = 5.0
"""Allowed deviation of a statistic in standard errors."""
oracle = field("noise", "noise")
statistics = partial(oracle, quantity="standard errors [1]", atol=ERRORS)


def million(knobs: dict[str, Any], **more: Any) -> Noise:
    """Return noise of a million rows."""
    return Noise(knobs, SIDE, num_envs=SIDE, **{"dtype": torch.float32, **more})


def reading(noise: Noise, signal: Any = 0.0) -> np.ndarray:
    """Return a reading of all rows of the first channel, (env, row)."""
    return noise.read(signal, DT)[..., 0].double().numpy()


def variance_error(sample: np.ndarray, expected: float, kurtosis: float = 3.0) -> float:
    """Return the error of the variance of a sample of mean 0, in standard errors."""
    return standard_errors((sample**2).mean(), expected, expected * np.sqrt((kurtosis - 1) / sample.size))


def _errors(**errors: float) -> Values:
    return Values(0.0, [*errors.values()], at=[name.replace("_", " ") for name in errors])


def _distance(value: float) -> float:
    """Return √N times a distance of distributions, scaled to standard errors."""
    return value / KOLMOGOROV * ERRORS


@statistics("White noise is normal", "N(0, σ²)", "normal distribution")
def white_noise(sigma: float = 5e-3):
    sample = reading(million({"white_noise": sigma}), 1.0) - 1
    return _errors(
        mean=standard_errors(sample.mean(), 0, sigma / np.sqrt(NUM)),
        variance=variance_error(sample, sigma**2),
        distribution=_distance(normal_distance(sample, sigma)),
    )


@oracle(
    "Drift is a random walk", "var = σ² n", "variance of a sum of independent steps", "variance over σ² [1]", "readings [1]",
    rtol=ERRORS * np.sqrt(2 / NUM),
)  # fmt: skip
def drift(sigma: float = 1e-3):
    noise = million({"drift": sigma})
    variance = [(reading(noise) ** 2).mean() / sigma**2 for _ in range(16)]
    counts = (1, 2, 4, 8, 16)
    return Values(counts, [variance[n - 1] for n in counts], at=counts)


@statistics("Drift is normal, step by step", "N(0, σ² n)", "normal distribution")
def drift_distribution(sigma: float = 1e-3):
    noise, walk, errors = million({"drift": sigma}), np.zeros((SIDE, SIDE)), {}
    for n in range(1, 17):
        before, walk = walk, reading(noise)
        if n in (1, 2, 4, 8, 16):
            errors[f"mean of {n}"] = standard_errors(walk.mean(), 0, sigma * np.sqrt(n / NUM))
    step = _distance(normal_distance(walk - before, sigma))
    return _errors(**errors, walk=_distance(normal_distance(walk, 4 * sigma)), step=step)


@statistics(
    "The quantiser's error is uniform", "var = q²/12, |ε| ≤ q/2", "Bennett 1948",
    at=["mean", "variance", "within half a step, on the grid"],
)  # fmt: skip
def quantiser(step: float = 0.01):
    t = np.linspace(0, 1, NUM).reshape(SIDE, SIDE, 1)
    signal = 3 * np.sin(7 * t) + t
    sample = reading(million({"quantization": step}, dtype=torch.float64), signal)
    error = sample - signal[..., 0]
    on_grid = np.abs(sample / step - np.round(sample / step)).max() <= 1e-9
    within = np.abs(error).max() <= step / 2 * (1 + 1e-12)
    mean = standard_errors(error.mean(), 0, step / np.sqrt(12 * NUM))
    return 0.0, [mean, variance_error(error, step**2 / 12, kurtosis=1.8), 0.0 if within and on_grid else np.inf]


@statistics("Dead taxels are binomial, stuck uniformly", "p ± √(p(1−p)/N)", "binomial and uniform distributions")
def dead_share(share: float = 0.05, low: float = -1.0, high: float = 3.0):
    first = reading(million({"dead_probability": share, "dead_range": [low, high]}), 100.0)
    is_dead = first != 100
    spread = SIDE * share * (1 - share)
    return _errors(
        share=standard_errors(is_dead.mean(), share, np.sqrt(share * (1 - share) / NUM)),
        variance_by_environment=standard_errors(is_dead.sum(axis=1).var(), spread, spread * np.sqrt(2 / SIDE)),
        distribution=_distance(uniform_distance(first[is_dead], low, high)),
    )


@statistics("Gains are uniform", "U(a, b)", "uniform distribution", defects=(16,))
def gains(low: float = 0.85, high: float = 1.15):
    noise = million({"gain": [low, high]}, dtype=torch.float64)
    first = reading(noise, 1.0)
    noise.reset(np.arange(SIDE) < 500)
    second = reading(noise, 1.0)
    return _errors(
        first=_distance(uniform_distance(first, low, high)),
        after_a_reset=_distance(uniform_distance(second, low, high)),
        held_by_the_others=0.0 if (second[500:] == first[500:]).all() else np.inf,
    )


@statistics("Radii are uniform at each step", "U(−w, w)", "uniform distribution", at=["first", "second"], defects=(9,))
def radii(width: float = 0.3 * MM):
    noise, like, errors = million({"radius_noise": width}), torch.zeros(SIDE, SIDE), []
    for _ in range(2):
        now = noise.now()
        (disturbed,) = draw(noise.stages, noise.constants, now)
        assert isinstance(disturbed, Radius)
        shift = disturbed.shift(now, like).double().numpy()
        errors.append(_distance(uniform_distance(shift, -width, width)) if np.abs(shift).max() <= width else np.inf)
        noise.read(0.0)
    return 0.0, errors


@statistics(
    "Ages of readings with jitter are uniform, calls every {dt:ms}", "U(Δ, Δ + J)", "uniform distribution",
    each=[DT / 0.1, DT / 1.0], also=[DT / 2.0, DT / 10.0],
)  # fmt: skip
def ages(dt: float, num_envs: int = 5000):
    low, high, sample = 10e-3, 18e-3, []
    noise = Noise({"read_delay": low, "jitter": high - low}, 2, num_envs=num_envs, dt=dt)
    first = int(np.ceil(high / dt))
    for call in range(first + 200):
        reading = noise.read(call * dt, dt)
        if call >= first:
            sample.append(call * dt - reading[:, 0, 0].numpy())
    age = np.stack(sample)
    within = age.min() > low - 1e-12 and age.max() < high + 1e-12
    return _errors(distribution=_distance(uniform_distance(age, low, high)), within=0.0 if within else np.inf)
