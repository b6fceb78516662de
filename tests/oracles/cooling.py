"""Losses of a block to its surroundings, and the lag of a sensing element, against closed forms of one cell."""

from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from oracles.comparison import Values, field
from oracles.setups.boxes import heated
from tgdsl.fields.materials import MATERIALS
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius

ALUMINIUM = MATERIALS["aluminium"]
SIDES = (0.02, 0.03, 0.04)
"""Sides of the block [m]."""
AREA = 2 * (0.02 * 0.03 + 0.03 * 0.04 + 0.04 * 0.02)
HEAT = ALUMINIUM.density * ALUMINIUM.specific_heat * 0.02 * 0.03 * 0.04
"""Its surface [m²] and heat capacity [J/K]."""
oracle = field("heat: losses and lag", "temperature_grid")
LUMP: dict[str, Any] = {"like": "aluminium", "conductivity": 2500.0}
"""Aluminium with the conductivity of diamond."""


def cooled(dt: float, seconds: float, dtype: torch.dtype = torch.float64, **sensor: Any) -> float:
    """Return the temperature of a block that starts at 100 °C, read to the end [°C]."""
    parameters = {"cells": [1, 1, 1], "material": LUMP, "temperature": 100.0, **sensor}
    *_, last = heated({"block": SIDES}, parameters, dt, round(seconds / dt), dtype=dtype)
    return float(last["heat"][0].mean())


def transmitted(h: float, axes: str = "xyz") -> float:
    """Return the conductance of the block's faces across these axes to the air, 2A/(1/h + Δ/6k) each [W/K]."""
    areas = {"x": SIDES[1] * SIDES[2], "y": SIDES[0] * SIDES[2], "z": SIDES[0] * SIDES[1]}
    sides = dict(zip("xyz", SIDES, strict=True))
    return sum(2 * areas[axis] / (1 / h + sides[axis] / (6 * LUMP["conductivity"])) for axis in axes)


@oracle(
    "Newton's law of cooling", "ΔT = ΔT₀ e^(−UAt/ρcV), 1/U = 1/h + Δ/6k", "Incropera 5.6", "temperature [°C]", "time [s]",
    defects=(11,), each=[torch.float64, torch.float32],
)  # fmt: skip
def newton(dtype: torch.dtype = torch.float64):
    times = np.array([10.0, 50.0, 100.0])
    ours = [cooled(2.5, t, dtype, convection=50.0) for t in times]
    paper = 22 + 78 * np.exp(-50.0 * times / (HEAT / (SIDES[0] * SIDES[1] * SIDES[2])))
    rtol = 1e-12 if dtype == torch.float64 else 1e-6
    return Values(22 + 78 * np.exp(-transmitted(50.0) * times / HEAT), ours, paper, at=times, rtol=rtol)


@oracle(
    "Only exposed faces lose heat", "ΔT = ΔT₀ e^(−UAt/ρcV), A of the exposed faces", "Incropera 5.6", "temperature [°C]",
    at=["after 100 s"], rtol=1e-12, defects=(11,),
)  # fmt: skip
def exposed_faces():
    return 22 + 78 * np.exp(-transmitted(50.0, "x") * 100 / HEAT), cooled(0.5, 100.0, convection=50.0, exposed=["-x", "+x"])


@oracle(
    "Radiation of a lump", "t = C/4εσAT_a³ [ln |(T+T_a)/(T−T_a)| + 2 atan(T/T_a)] from start to end", "Incropera 5.3",
    "time [s]", rtol=1e-4, defects=(11,),
)  # fmt: skip
def radiation(seconds: float = 2000.0):
    around = 22.0 + zero_celsius()

    def elapsed(hot: float) -> float:
        return float(np.log((hot + around) / (hot - around)) + 2 * np.arctan(hot / around))

    left = cooled(20.0, seconds, emissivity=0.85)
    factor = HEAT / (4 * 0.85 * stefan_boltzmann() * AREA * around**3)
    return Values(seconds, factor * (elapsed(left + zero_celsius()) - elapsed(100.0 + zero_celsius())), at=[f"{left:.1f} °C"])


@oracle(
    "Convection and radiation together", "C dT/dt = −A (h (T−T_a) + εσ (T⁴−T_a⁴))", "Incropera 5.15, integrated",
    "temperature above the surroundings [K]", at=["after {seconds:g} s"], rtol=1e-4, defects=(11,),
)  # fmt: skip
def both_losses(seconds: float = 600.0):

    def slope(_: float, hot: np.ndarray) -> np.ndarray:
        around = 22.0 + zero_celsius()
        return -AREA / HEAT * (20.0 * (hot - around) + 0.5 * stefan_boltzmann() * (hot**4 - around**4))

    solution = solve_ivp(slope, (0, seconds), [100.0 + zero_celsius()], rtol=1e-10, atol=1e-10)
    return float(solution.y[0, -1]) - zero_celsius() - 22, cooled(10.0, seconds, emissivity=0.5, convection=20.0) - 22


@oracle(
    "A step of losses is of second order", "order 2", "midpoint rule", "order of convergence [1]",
    at=["100 to 50 s", "200 to 100 s"], atol=0.2,
)  # fmt: skip
def order_of_losses():
    fine = cooled(5.0, 800.0, emissivity=0.9, convection=5.0)
    errors = [abs(cooled(dt, 800.0, emissivity=0.9, convection=5.0) - fine) for dt in (50.0, 100.0, 200.0)]
    return 2.0, np.log2(np.divide(errors[1:], errors[:-1]))


@oracle(
    "A hot block stays hot for a second", "ΔT = εσ(T⁴−T_a⁴) A t/C",
    "Stefan and Boltzmann's law; the paper's implementation as measured", "temperature lost [K]", at=["after 1 s"], rtol=2e-3,
    defects=(11,),
)  # fmt: skip
def hot_block():
    lost = 0.85 * stefan_boltzmann() * (373.15**4 - 295.15**4) * AREA / HEAT
    return lost, 100.0 - cooled(0.005, 1.0, emissivity=0.85, cells=[2, 3, 4]), 119.6


def slab_roots(biot: float, count: int = 60) -> np.ndarray:
    """Return the roots of β tan β = Bi."""
    return np.array([brentq(lambda b: b * np.sin(b) - biot * np.cos(b), m * np.pi, (m + 0.5) * np.pi) for m in range(count)])


def slab_mean(biot: float, fourier: float) -> float:
    """Return the mean temperature of a slab that started at 1, by Bi = hL/k and Fo = αt/L²; L is half its thickness."""
    beta = slab_roots(biot)
    return float((2 * np.sin(beta) ** 2 / (beta * (beta + np.sin(beta) * np.cos(beta))) * np.exp(-(beta**2) * fourier)).sum())


@oracle(
    "A slab that air cools, Bi = {biot:g}, Fo = {fourier:g}, {num} cells, {steps} steps",
    "θ = Σ 4 sin β/(2β + sin 2β) cos(βx/L) e^(−β²Fo), β tan β = Bi", "Carslaw and Jaeger 3.11, Incropera 5.5",
    "mean, then cells [1]", defects=(11,), each=[(10, 1), (40, 7)], also=[(40, 1)],
)  # fmt: skip
def slab(num: int, steps: int, biot: float = 10.0, fourier: float = 0.5):
    half, alpha = 0.01, 1e-6
    material = {"like": "steel", "conductivity": 1.0, "density": 1000.0, "specific_heat": 1000.0}
    sensor = {"cells": [1, 1, num], "convection": biot / half, "exposed": ["-z", "+z"], "temperature": 62.0}
    dt = fourier * half**2 / alpha / steps
    *_, last = heated({"slab": [0.01, 0.01, 2 * half]}, {**sensor, "material": material}, dt, steps)
    ours = (last["heat"][0, :, 0].numpy() - 22.0) / 40.0
    beta, place = slab_roots(biot), np.arange(num + 1) * 2 / num - 1
    share = 4 * np.sin(beta) / (2 * beta + np.sin(2 * beta)) * np.exp(-(beta**2) * fourier)
    cells = np.diff((share / beta * np.sin(np.outer(place, beta))).sum(axis=1)) / np.diff(place)
    labels = ["mean", *(f"cell {i}" for i in range(num))]
    return Values([slab_mean(biot, fourier), *cells], [ours.mean(), *ours], at=labels, atol=0.01 * cells.max())


@oracle(
    "A cube of {material} that air cools, {num}³ cells", "1 − θ_slab³", "Incropera 5.5 and 5.8, a product of slabs",
    "heat lost, of what there was [1]", at=["after 600 s"], defects=(11,),
    each=[(1, "rubber"), (2, "rubber"), (4, "rubber"), (12, "rubber"), (2, "skin")], also=[(3, "rubber"), (2, "abs")],
)  # fmt: skip
def cube(num: int, material: str, steps: int = 60):
    made_of, half, seconds = MATERIALS[material], 0.012, 600.0
    sensor = {"cells": [num] * 3, "material": material, "convection": 10.0, "temperature": 62.0}
    *_, last = heated({"cube": [2 * half] * 3}, sensor, seconds / steps, steps)
    left = (float(last["heat"].mean()) - 22.0) / 40.0
    fourier = made_of.conductivity / (made_of.density * made_of.specific_heat) * seconds / half**2
    exact = 1.0 - slab_mean(10.0 * half / made_of.conductivity, fourier) ** 3
    return Values(exact, 1.0 - left, rtol=0.05 if num < 3 else 0.03 if num < 5 else 0.002)


@oracle(
    "A flux through a slab, to air, Δt = {dt:g} s", "ΔT = q (1/h + (L − x)/k)", "Incropera 3.1, resistances in series",
    "rise of temperature [K]", "depth [m]", rtol=1e-3, defects=(11,), each=[5.0, 20.0],
)  # fmt: skip
def flux_through(dt: float):
    flux, h, thick, num, k = 3000.0, 1000.0, 0.02, 20, ALUMINIUM.conductivity
    source = {"flux": f"{flux} W/m2", "face": "-z"}
    sensor = {"cells": [1, 1, num], "material": "aluminium", "convection": h, "exposed": ["+z"], "source": source}
    *_, last = heated({"slab": [0.02, 0.02, thick]}, sensor, dt, round(1000.0 / dt))
    depth = (np.arange(num) + 0.5) * thick / num
    return Values(flux * (1 / h + (thick - depth) / k), last["heat"][0, :, 0].numpy() - 22.0, at=depth)


@oracle(
    "A flux through a slab that radiates, Δt = {dt:g} s", "q = εσ(T_s⁴ − T_a⁴), ΔT = T_s − T_a + q (L − x)/k",
    "Stefan and Boltzmann's law, Incropera 3.1", "rise of temperature [K]", "depth [m]", defects=(11,), each=[25.0], also=[50.0],
)  # fmt: skip
def flux_radiated(dt: float):
    flux, thick, num, k, around = 400.0, 0.01, 4, MATERIALS["rubber"].conductivity, 22.0 + zero_celsius()
    sensor = {
        "cells": [1, 1, num], "material": "rubber", "emissivity": 0.9, "exposed": ["+z"],
        "source": {"flux": f"{flux} W/m2", "face": "-z"},
    }  # fmt: skip
    depth = (np.arange(num) + 0.5) * thick / num
    exact = (flux / 0.9 / stefan_boltzmann() + around**4) ** 0.25 - around + flux * (thick - depth) / k
    *_, last = heated({"slab": [0.02, 0.02, thick]}, sensor, dt, round(5000.0 / dt), above=exact[None, None])
    return Values(exact, last["heat"][0, :, 0].numpy() - 22.0, at=depth, atol=0.01 * exact[-1])


@oracle(
    "A slow element trails a ramp, Δt = {dt:g} s", "T = r (t − τ(1 − e^(−t/τ)))", "first-order lag", "rise of the reading [K]",
    "time [s]", rtol=1e-6, atol=1e-9, each=[0.005, 0.07, 1.3],
)  # fmt: skip
def lag(dt: float, tau: float = 0.4):
    parameters = {"cells": [1, 1, 1], "material": "aluminium", "source": {"power": 3.0}, "lag": "400 ms"}
    ours = [readings["heat"].item() - 22.0 for readings in heated({"block": SIDES}, parameters, dt, 20)]
    times = dt * np.arange(1, 21)
    return Values(3.0 / HEAT * (times - tau * (1 - np.exp(-times / tau))), ours, at=times)
