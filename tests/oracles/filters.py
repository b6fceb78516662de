"""Filters: a delay, one Maxwell branch, and crosstalk between taxels."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from oracles.noise import DT, KINDS
from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.signals import MM, Noise, make_layout, one
from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise.lower import crosstalk_kernel

EXACT = 1e-12
"""Of filters in float64."""


def delay(late: float, parts: float) -> Comparison:
    """Return a clock that is read late, with calls at a part of 2 ms: exactly as old as the delay, never before the start."""
    dt = DT / parts
    clock = dt * np.arange(200)
    found = one(Noise({"read_delay": late, "bias": 1.0}, 2, dt=dt), clock.tolist(), dt) - 1
    return Comparison(
        f"A reading is as old as its delay: {1e3 * late:g} ms, calls every {1e3 * dt:g} ms",
        "by definition, linear between calls",
        "y(t) = x(max(t − Δ, 0))",
        KINDS,
        "reading of a clock",
        "s",
        along("time", "s", clock),
        np.maximum(clock - late, 0)[None].repeat(2, 0),
        found.T,
        atol=1e-14,
        series=("row 0", "row 1"),
        defects=(19,),
    )


STRENGTH, TAU = 0.5, 0.05
"""β and τ [s] of the Maxwell branch."""
BRANCH = {"hysteresis": {"strength": STRENGTH, "time_constant": TAU}}
PRESS = (np.array([0.0, 0.02, 0.1, 0.13, 0.15, 0.16, 0.18, 0.2, 0.3]), np.array([0.0, 2.0, 2.0, 0.5, 0.9, 0.6, 1.0, 0.0, 0.0]))
"""Press, hold, release, wiggle, let go: times [s] and values between which the signal is linear."""


def maxwell(t: np.ndarray) -> np.ndarray:
    """Return the branch's exact answer to `PRESS`: each bend of the signal adds a ramp's, β Δv τ (1 − e^(−t/τ))."""
    times, values = PRESS
    bends = np.diff(np.diff(values) / np.diff(times), prepend=0, append=0)
    since = np.maximum(t[:, None] - times, 0)
    return np.interp(t, times, values) + STRENGTH * TAU * ((1 - np.exp(-since / TAU)) @ bends)


def maxwell_of_the_paper(signal: np.ndarray, dt: float) -> np.ndarray:
    """Return the paper's update, which depends on the step where the signal is a ramp."""
    lag = np.zeros(len(signal))
    for i in range(1, len(signal)):
        lag[i] = np.exp(-dt / TAU) * lag[i - 1] + signal[i] - signal[i - 1]
    return signal + STRENGTH * lag


def maxwell_step() -> Comparison:
    """Return the branch after a step of the signal."""
    noise = Noise(BRANCH)
    rest = noise.read(0.0, DT).item()
    noise.read(1.0, 1e-15)
    t = DT * np.arange(1, 201)
    found = one(noise, np.ones(200).tolist(), DT)[:, 0]
    return Comparison(
        "Maxwell branch: after a step",
        "linear viscoelasticity; a spring and a dashpot in series beside a spring",
        "y = 1 + β e^(−t/τ)",
        KINDS,
        "reading",
        "1",
        along("time", "s", t),
        1 + STRENGTH * np.exp(-t / TAU),
        found if rest == 0 else found + np.nan,
        atol=EXACT,
    )


def maxwell_ramp(dt: float) -> Comparison:
    """Return the branch on a ramp, at a step; the paper's update overshoots the more the longer the step."""
    t, speed = dt * np.arange(200), 3.0 / dt
    return Comparison(
        f"Maxwell branch: on a ramp, Δt = {dt:g} s",
        "linear viscoelasticity",
        "y = vt + βvτ(1 − e^(−t/τ))",
        KINDS,
        "reading",
        "1",
        along("time", "s", t),
        speed * t + STRENGTH * speed * TAU * (1 - np.exp(-t / TAU)),
        one(Noise(BRANCH), (speed * t).tolist(), dt)[:, 0],
        rtol=EXACT,
        paper=maxwell_of_the_paper(speed * t, dt),
        defects=(21,),
    )


def maxwell_cycle(parts: int, dtype: torch.dtype = torch.float64) -> Comparison:
    """Return the branch over press, hold, release and wiggle, at 10 ms or a part of it: the same curve at any step."""
    common = np.arange(31) * 0.01
    signal = np.interp(np.arange(30 * parts + 1) * 0.01 / parts, *PRESS)
    is_double = dtype == torch.float64
    return Comparison(
        f"Maxwell branch: the same at any step, {10 / parts:g} ms{'' if is_double else ', float32'}",
        "linear viscoelasticity",
        "y = x + βτ Σ Δv (1 − e^(−(t−t_b)/τ)) over the signal's bends",
        KINDS,
        "reading",
        "1",
        along("time", "s", common),
        maxwell(common),
        one(Noise(BRANCH, dtype=dtype), signal.tolist(), 0.01 / parts)[::parts, 0].astype(np.float64),
        atol=EXACT if is_double else 1e-4,
        paper=maxwell_of_the_paper(signal, 0.01 / parts)[::parts],
        defects=(21,),
    )


def grid(rows: int, columns: int, spacing: float) -> np.ndarray:
    """Return places on a grid (taxel, 3) [m]."""
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


def crosstalk_sum(name: str, knobs: dict[str, Any] | None = None) -> Comparison:
    """Return the sum over a pad of what each taxel's signal of 1 is spread to: 1, at centre, edge and corner."""
    layout = layouts()[name]
    source = np.eye(layout.num_taxels)[:, :, None]
    noise = Noise(knobs or BLUR, layout, num_envs=layout.num_taxels, dtype=torch.float32)
    spread = noise.read(source)[..., 0].double().numpy()
    return Comparison(
        f"Crosstalk keeps the sum: {name}",
        "columns of the operator sum to 1",
        "Σ_j K_ji = 1",
        KINDS,
        "sum",
        "1",
        cases(range(layout.num_taxels), "taxel"),
        np.ones(layout.num_taxels),
        spread.sum(axis=1) if (spread >= 0).all() else np.full(layout.num_taxels, np.nan),
        atol=1e-6,
        defects=(10,),
    )


def crosstalk_edges(num: int = 15, sigma: float = 2 * MM) -> Comparison:
    """Return what a full blur keeps at centre, edge and corner: all; a kernel that is padded with zeros loses some."""
    layout = make_layout(grid(num, num, MM))
    kernel = crosstalk_kernel(layout, np.full(num * num, sigma))
    middle = num // 2 * num + num // 2
    padded = np.exp(-np.sum((layout.pos - layout.pos[:, None]) ** 2, axis=-1) / (2 * sigma**2))
    padded /= padded[middle].sum()
    at = [middle, num // 2, 0]
    return Comparison(
        "A full blur keeps the force at edges",
        "columns of the operator sum to 1; the paper's convolution is padded with zeros",
        "Σ_j K_ji = 1",
        KINDS,
        "sum",
        "1",
        cases(["centre", "edge", "corner"]),
        np.ones(3),
        kernel.sum(axis=0)[at],
        atol=1e-14,
        paper=padded.sum(axis=1)[at],
        defects=(10,),
    )


def crosstalk_variance(strength: float) -> Comparison:
    """Return first and second moments of what a taxel far from edges is spread to, over σ².

    Sums over a grid are integrals to 4π²σ²/h² e^(−2π²σ²/h²), 2e-7 for σ = h; the grid reaches 10 σ.
    """
    layout, sigma = make_layout(grid(21, 21, MM)), 1.0 * MM
    source = np.zeros((441, 1))
    source[220] = 1
    spread = Noise({"crosstalk": {"strength": strength, "sigma": sigma}}, layout).read(source)[0, :, 0].numpy()
    apart = (layout.pos - layout.pos[220])[:, :2]
    return Comparison(
        f"A blur has the variance of its Gaussian, strength {strength:g}",
        "variance of a Gaussian",
        "Σ K x² = χ σ²",
        KINDS,
        "moments over σ, σ²",
        "1",
        cases(["x", "y", "x²", "y²"]),
        array([0, 0, strength, strength]),
        np.concatenate([spread @ apart / sigma, spread @ apart**2 / sigma**2]),
        rtol=1e-6,
        atol=1e-12,
    )


ORACLES: tuple[Oracle, ...] = (
    *(partial(delay, late, parts) for late, parts in ((0.5e-3, 1.0), (5.3e-3, 0.1), (5.3e-3, 10.0))),
    maxwell_step,
    *(partial(maxwell_ramp, dt) for dt in (1e-6, 1e-3, 0.05, 10.0)),
    *(partial(maxwell_cycle, parts) for parts in (1, 10)),
    partial(maxwell_cycle, 1, torch.float32),
    *(partial(crosstalk_sum, name) for name in ("grid", "sphere cap", "irregular")),
    crosstalk_edges,
    partial(crosstalk_variance, 1.0),
)
