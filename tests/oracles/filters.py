"""Filters: a delay, one Maxwell branch, and crosstalk between taxels."""

from itertools import product
from typing import Any

import numpy as np
import torch

from oracles.comparison import Values, field
from oracles.noise import DT
from oracles.setups.signals import MM, Noise, make_layout, one
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise.stages import crosstalk_kernel

oracle = field("filters", "noise")
EXACT = 1e-12
"""Tolerance of filters in float64."""


@oracle(
    "A reading is as old as its delay: {late:ms}, calls every {dt:ms}", "y(t) = x(max(t − Δ, 0))",
    "by definition, linear between calls", "reading of a clock [s]", "time [s]", atol=1e-14, series=("row 0", "row 1"),
    defects=(19,), each=[(0.5e-3, DT), (5.3e-3, DT / 0.1), (5.3e-3, DT / 10.0)],
    also=product((0.0, 0.5e-3, 4e-3, 5.3e-3), (DT / 0.1, DT, DT / 2.0, DT / 10.0)),
)  # fmt: skip
def delay(late: float, dt: float):
    clock = dt * np.arange(200)
    ours = one(Noise({"read_delay": late, "bias": 1.0}, 2, dt=dt), clock.tolist(), dt) - 1
    return Values(np.maximum(clock - late, 0), ours.T, at=clock)


STRENGTH, TAU = 0.5, 0.05
"""β and τ [s] of the Maxwell branch."""
BRANCH = {"hysteresis": {"strength": STRENGTH, "time_constant": TAU}}
PRESS = (np.array([0.0, 0.02, 0.1, 0.13, 0.15, 0.16, 0.18, 0.2, 0.3]), np.array([0.0, 2.0, 2.0, 0.5, 0.9, 0.6, 1.0, 0.0, 0.0]))
"""Press, hold, release, wiggle, let go: times [s] and values between which the signal is linear."""


def maxwell(t: np.ndarray) -> np.ndarray:
    """Return the branch's exact response to `PRESS`: each bend of the signal adds a ramp's, β Δv τ (1 − e^(−t/τ))."""
    times, values = PRESS
    bends = np.diff(np.diff(values) / np.diff(times), prepend=0, append=0)
    since = np.maximum(t[:, None] - times, 0)
    return np.interp(t, times, values) + STRENGTH * TAU * ((1 - np.exp(-since / TAU)) @ bends)


def maxwell_of_the_paper(signal: np.ndarray, dt: float) -> np.ndarray:
    """Return the paper's update, which depends on the step while the signal is a ramp."""
    lag = np.zeros(len(signal))
    for i in range(1, len(signal)):
        lag[i] = np.exp(-dt / TAU) * lag[i - 1] + signal[i] - signal[i - 1]
    return signal + STRENGTH * lag


@oracle(
    "Maxwell branch: after a step", "y = 1 + β e^(−t/τ)",
    "linear viscoelasticity; a spring and a dashpot in series beside a spring", "reading [1]", "time [s]", atol=EXACT,
)  # fmt: skip
def maxwell_step():
    noise = Noise(BRANCH)
    rest = noise.read(0.0, DT).item()
    noise.read(1.0, 1e-15)
    t = DT * np.arange(1, 201)
    ours = one(noise, np.ones(200).tolist(), DT)[:, 0]
    return Values(1 + STRENGTH * np.exp(-t / TAU), ours if rest == 0 else np.nan, at=t)


@oracle(
    "Maxwell branch: on a ramp, Δt = {dt:g} s", "y = vt + βvτ(1 − e^(−t/τ))", "linear viscoelasticity", "reading [1]",
    "time [s]", rtol=EXACT, defects=(21,), each=[1e-6, 1e-3, 0.05, 10.0],
)  # fmt: skip
def maxwell_ramp(dt: float):
    t, speed = dt * np.arange(200), 3.0 / dt
    exact = speed * t + STRENGTH * speed * TAU * (1 - np.exp(-t / TAU))
    ours = one(Noise(BRANCH), (speed * t).tolist(), dt)[:, 0]
    return Values(exact, ours, maxwell_of_the_paper(speed * t, dt), at=t)


@oracle(
    "Maxwell branch: the same at any step, {step:g} ms", "y = x + βτ Σ Δv (1 − e^(−(t−t_b)/τ)) over the signal's bends",
    "linear viscoelasticity", "reading [1]", "time [s]", defects=(21,), each=[1, 10, (1, torch.float32)],
    also=product((1, 2, 10), (torch.float64, torch.float32)),
)  # fmt: skip
def maxwell_cycle(parts: int, dtype: torch.dtype = torch.float64):
    common = np.arange(31) * 0.01
    signal = np.interp(np.arange(30 * parts + 1) * 0.01 / parts, *PRESS)
    ours = one(Noise(BRANCH, dtype=dtype), signal.tolist(), 0.01 / parts)[::parts, 0]
    paper = maxwell_of_the_paper(signal, 0.01 / parts)[::parts]
    atol = EXACT if dtype == torch.float64 else 1e-4
    return Values(maxwell(common), ours, paper, at=common, atol=atol, words={"step": 10 / parts})


def grid(rows: int, columns: int, spacing: float) -> np.ndarray:
    """Return positions on a grid (taxel, 3) [m]."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return spacing * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def _cap() -> Layout:
    polar, around = np.meshgrid([0.2, 0.5, 0.8, 1.1], 2 * np.pi * np.arange(9) / 9)
    normal = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1).reshape(-1, 3)
    return make_layout(8 * MM * normal, normal)


def layouts() -> dict[str, Layout]:
    """Return pads of several shapes for crosstalk."""
    return {
        "grid": make_layout(grid(8, 6, 1.5 * MM)),
        "sphere cap": _cap(),
        "irregular": make_layout(np.random.default_rng(5).uniform(0, 6 * MM, (40, 3)) * [1, 1, 0.2]),
        "inactive taxels": make_layout(grid(6, 6, MM), radius=np.where(np.arange(36) % 5 == 0, 0.0, 4 * MM)),
        "two links": make_layout(grid(5, 4, MM), link_id=[0] * 12 + [1] * 8),
        "opposite flanks": make_layout(grid(2, 10, MM), normal=[[0, 0, 1]] * 10 + [[0, 0, -1]] * 10),
    }


BLUR: dict[str, Any] = {"crosstalk": {"strength": 0.4, "sigma": "1.5 mm"}}
UNEVEN: dict[str, Any] = {"crosstalk": {"strength": [0.2, 0.9], "sigma": ["1 mm", "3 mm"]}}


@oracle(
    "Crosstalk keeps the sum: {name}", "Σ_j K_ji = 1", "columns of the operator sum to 1", "sum [1]", "taxel", atol=1e-6,
    defects=(10,), each=["grid", "sphere cap", "irregular"], also=product(layouts(), (BLUR, UNEVEN)),
)  # fmt: skip
def crosstalk_sum(name: str, knobs: dict[str, Any] = BLUR):
    layout = layouts()[name]
    source = np.eye(layout.num_taxels)[:, :, None]
    noise = Noise(knobs, layout, num_envs=layout.num_taxels, dtype=torch.float32)
    spread = noise.read(source)[..., 0].double().numpy()
    return Values(1.0, spread.sum(axis=1) if (spread >= 0).all() else np.nan, at=range(layout.num_taxels))


@oracle(
    "A full blur keeps the force at edges", "Σ_j K_ji = 1",
    "columns of the operator sum to 1; the paper's convolution is padded with zeros", "sum [1]",
    at=["centre", "edge", "corner"], atol=1e-14, defects=(10,),
)  # fmt: skip
def crosstalk_edges(num: int = 15, sigma: float = 2 * MM):
    layout = make_layout(grid(num, num, MM))
    kernel = crosstalk_kernel(layout, np.full(num * num, sigma))
    middle = num // 2 * num + num // 2
    padded = np.exp(-np.sum((layout.pos - layout.pos[:, None]) ** 2, axis=-1) / (2 * sigma**2))
    padded /= padded[middle].sum()
    at = [middle, num // 2, 0]
    return 1.0, kernel.sum(axis=0)[at], padded.sum(axis=1)[at]


@oracle(
    "A blur has the variance of its Gaussian, strength {strength:g}", "Σ K x² = χ σ²", "variance of a Gaussian",
    "moments over σ, σ² [1]", at=["x", "y", "x²", "y²"], rtol=1e-6, atol=1e-12, each=[1.0], also=[0.3],
)  # fmt: skip
def crosstalk_variance(strength: float):
    # Sums over a grid equal integrals to 4π²σ²/h² e^(−2π²σ²/h²), 2e-7 for σ = h; the grid extends to 10 σ.
    layout, sigma = make_layout(grid(21, 21, MM)), 1.0 * MM
    source = np.zeros((441, 1))
    source[220] = 1
    spread = Noise({"crosstalk": {"strength": strength, "sigma": sigma}}, layout).read(source)[0, :, 0].numpy()
    apart = (layout.pos - layout.pos[220])[:, :2]
    return [0, 0, strength, strength], np.concatenate([spread @ apart / sigma, spread @ apart**2 / sigma**2])
