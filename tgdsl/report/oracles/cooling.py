"""Losses of a block to its surroundings, and the lag of a sensing element, against closed forms of one cell."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp

from tgdsl.fields.materials import MATERIALS
from tgdsl.report.oracles.results import Comparison, Oracle, along, array, cases
from tgdsl.report.oracles.setups.boxes import begin, heat_module, heat_state
from tgdsl.report.oracles.setups.scenes import folder
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius

ALUMINIUM = MATERIALS["aluminium"]
SIDES = (0.02, 0.03, 0.04)
"""Of the block [m]."""
AREA = 2 * (0.02 * 0.03 + 0.03 * 0.04 + 0.04 * 0.02)
HEAT = ALUMINIUM.density * ALUMINIUM.specific_heat * 0.02 * 0.03 * 0.04
"""Its surface [m²] and heat capacity [J/K]."""
KINDS = ("temperature_grid",)


def cooled(dt: float, seconds: float, dtype: torch.dtype = torch.float64, **sensor: Any) -> float:
    """Return the temperature of a block that begins at 100 °C, read to the end [°C]."""
    parameters = {"cells": [1, 1, 1], "material": "aluminium", "temperature": 100.0, **sensor}
    with folder() as where:
        module = heat_module(where, {"block": SIDES}, parameters, dtype=dtype)
    state = heat_state(module, dt)
    begin(module, state)
    for _ in range(round(seconds / dt)):
        found = module(state)["heat"]
    return float(found[0].mean())


def newton(dtype: torch.dtype = torch.float64) -> Comparison:
    """Return how a block cools by convection; the paper's has no area."""
    times = np.array([10.0, 50.0, 100.0])
    ours = array([cooled(0.5, t, dtype, convection=50.0) for t in times])
    volume = SIDES[0] * SIDES[1] * SIDES[2]
    is_double = dtype == torch.float64
    return Comparison(
        f"Newton's law of cooling{'' if is_double else ', float32'}",
        "Incropera 5.6",
        "ΔT = ΔT₀ e^(−hAt/ρcV)",
        KINDS,
        "temperature",
        "°C",
        along("time", "s", times),
        22 + 78 * np.exp(-50.0 * AREA * times / HEAT),
        ours,
        rtol=1e-12 if is_double else 1e-6,
        paper=22 + 78 * np.exp(-50.0 * times / (HEAT / volume)),
        defects=(11,),
    )


def exposed_faces() -> Comparison:
    """Return how a block cools through two of its faces."""
    return Comparison(
        "Only exposed faces lose heat",
        "Incropera 5.6",
        "ΔT = ΔT₀ e^(−hAt/ρcV), A of the exposed faces",
        KINDS,
        "temperature",
        "°C",
        cases(["after 100 s"]),
        array(22 + 78 * np.exp(-50.0 * 2 * 0.03 * 0.04 * 100 / HEAT)),
        array(cooled(0.5, 100.0, convection=50.0, exposed=["-x", "+x"])),
        rtol=1e-12,
        defects=(11,),
    )


def radiation(seconds: float = 2000.0) -> Comparison:
    """Return the time in which a lump that radiates cools to what it reads after a time."""
    around = 22.0 + zero_celsius()

    def elapsed(hot: float) -> float:
        return float(np.log((hot + around) / (hot - around)) + 2 * np.arctan(hot / around))

    left = cooled(1.0, seconds, emissivity=0.85)
    factor = HEAT / (4 * 0.85 * stefan_boltzmann() * AREA * around**3)
    return Comparison(
        "Radiation of a lump",
        "Incropera 5.3",
        "t = C/4εσAT_a³ [ln |(T+T_a)/(T−T_a)| + 2 atan(T/T_a)] from start to end",
        KINDS,
        "time",
        "s",
        cases([f"{left:.1f} °C"]),
        array(seconds),
        array(factor * (elapsed(left + zero_celsius()) - elapsed(100.0 + zero_celsius()))),
        rtol=1e-4,
        defects=(11,),
    )


def both_losses(seconds: float = 600.0) -> Comparison:
    """Return how a block cools by convection and radiation, against the differential equation."""

    def slope(_: float, hot: np.ndarray) -> np.ndarray:
        around = 22.0 + zero_celsius()
        return -AREA / HEAT * (20.0 * (hot - around) + 0.5 * stefan_boltzmann() * (hot**4 - around**4))

    solution = solve_ivp(slope, (0, seconds), [100.0 + zero_celsius()], rtol=1e-10, atol=1e-10)
    return Comparison(
        "Convection and radiation together",
        "Incropera 5.15, integrated",
        "C dT/dt = −A (h (T−T_a) + εσ (T⁴−T_a⁴))",
        KINDS,
        "temperature above the surroundings",
        "K",
        cases([f"after {seconds:g} s"]),
        array(float(solution.y[0, -1]) - zero_celsius() - 22),
        array(cooled(0.5, seconds, emissivity=0.5, convection=20.0) - 22),
        rtol=1e-4,
        defects=(11,),
    )


def order_of_losses() -> Comparison:
    """Return the order in time of losses: the second."""
    fine = cooled(1.0, 800.0, emissivity=0.9, convection=5.0)
    errors = [abs(cooled(dt, 800.0, emissivity=0.9, convection=5.0) - fine) for dt in (50.0, 100.0, 200.0)]
    return Comparison(
        "A step of losses is of second order",
        "midpoint rule",
        "order 2",
        KINDS,
        "order of convergence",
        "1",
        cases(["100 to 50 s", "200 to 100 s"]),
        np.full(2, 2.0),
        np.log2(np.divide(errors[1:], errors[:-1])),
        atol=0.2,
    )


def hot_block() -> Comparison:
    """Return what a block of 2 × 3 × 4 cm at 100 °C loses in a second; the paper's implementation leaves it at −19.6 °C."""
    lost = 0.85 * stefan_boltzmann() * (373.15**4 - 295.15**4) * AREA / HEAT
    return Comparison(
        "A hot block stays hot for a second",
        "Stefan and Boltzmann's law; the paper's implementation as measured",
        "ΔT = εσ(T⁴−T_a⁴) A t/C",
        KINDS,
        "temperature lost",
        "K",
        cases(["after 1 s"]),
        array(lost),
        array(100.0 - cooled(0.005, 1.0, emissivity=0.85, cells=[2, 3, 4])),
        rtol=2e-3,
        paper=array(119.6),
        defects=(11,),
    )


def lag(dt: float, tau: float = 0.4) -> Comparison:
    """Return what a slow element reads of a temperature that rises at a constant rate."""
    parameters = {"cells": [1, 1, 1], "material": "aluminium", "source": {"power": 3.0}, "lag": "400 ms"}
    with folder() as where:
        module = heat_module(where, {"block": SIDES}, parameters)
    state = heat_state(module, dt)
    begin(module, state)
    times = dt * np.arange(1, 21)
    found = [module(state)["heat"].item() - 22.0 for _ in times]
    return Comparison(
        f"A slow element trails a ramp, Δt = {dt:g} s",
        "first-order lag",
        "T = r (t − τ(1 − e^(−t/τ)))",
        KINDS,
        "rise of the reading",
        "K",
        along("time", "s", times),
        3.0 / HEAT * (times - tau * (1 - np.exp(-times / tau))),
        array(found),
        rtol=1e-6,
        atol=1e-9,
    )


ORACLES: tuple[Oracle, ...] = (
    newton,
    partial(newton, torch.float32),
    exposed_faces,
    radiation,
    both_losses,
    order_of_losses,
    hot_block,
    *(partial(lag, dt) for dt in (0.005, 0.07, 1.3)),
)
