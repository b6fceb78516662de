"""Losses of a block to its surroundings, and the lag of a sensing element, against closed forms of one cell."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.boxes import begin, heat_module, heat_state
from oracles.setups.scenes import folder
from tgdsl.fields.materials import MATERIALS
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius

ALUMINIUM = MATERIALS["aluminium"]
SIDES = (0.02, 0.03, 0.04)
"""Of the block [m]."""
AREA = 2 * (0.02 * 0.03 + 0.03 * 0.04 + 0.04 * 0.02)
HEAT = ALUMINIUM.density * ALUMINIUM.specific_heat * 0.02 * 0.03 * 0.04
"""Its surface [m²] and heat capacity [J/K]."""
KINDS = ("temperature_grid",)
LUMP: dict[str, Any] = {"like": "aluminium", "conductivity": 2500.0}
"""Aluminium that conducts like diamond."""


def cooled(dt: float, seconds: float, dtype: torch.dtype = torch.float64, **sensor: Any) -> float:
    """Return the temperature of a block that begins at 100 °C, read to the end [°C]."""
    parameters = {"cells": [1, 1, 1], "material": LUMP, "temperature": 100.0, **sensor}
    with folder() as where:
        module = heat_module(where, {"block": SIDES}, parameters, dtype=dtype)
    state = heat_state(module, dt)
    begin(module, state)
    for _ in range(round(seconds / dt)):
        found = module(state)["heat"]
    return float(found[0].mean())


def transmitted(h: float, axes: str = "xyz") -> float:
    """Return what the block's faces across some axes conduct from what it holds to the air, 2A/(1/h + Δ/6k) each [W/K]."""
    areas = {"x": SIDES[1] * SIDES[2], "y": SIDES[0] * SIDES[2], "z": SIDES[0] * SIDES[1]}
    sides = dict(zip("xyz", SIDES, strict=True))
    return sum(2 * areas[axis] / (1 / h + sides[axis] / (6 * LUMP["conductivity"])) for axis in axes)


def newton(dtype: torch.dtype = torch.float64) -> Comparison:
    """Return how a block cools by convection; the paper's has no area."""
    times = np.array([10.0, 50.0, 100.0])
    ours = array([cooled(0.5, t, dtype, convection=50.0) for t in times])
    volume = SIDES[0] * SIDES[1] * SIDES[2]
    is_double = dtype == torch.float64
    return Comparison(
        f"Newton's law of cooling{'' if is_double else ', float32'}",
        "Incropera 5.6",
        "ΔT = ΔT₀ e^(−UAt/ρcV), 1/U = 1/h + Δ/6k",
        KINDS,
        "temperature",
        "°C",
        along("time", "s", times),
        22 + 78 * np.exp(-transmitted(50.0) * times / HEAT),
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
        "ΔT = ΔT₀ e^(−UAt/ρcV), A of the exposed faces",
        KINDS,
        "temperature",
        "°C",
        cases(["after 100 s"]),
        array(22 + 78 * np.exp(-transmitted(50.0, "x") * 100 / HEAT)),
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


def slab_roots(biot: float, count: int = 60) -> np.ndarray:
    """Return the roots of β tan β = Bi."""
    return np.array([brentq(lambda b: b * np.sin(b) - biot * np.cos(b), m * np.pi, (m + 0.5) * np.pi) for m in range(count)])


def slab_mean(biot: float, fourier: float) -> float:
    """Return the mean temperature of a slab that began at 1, from Bi = hL/k and Fo = αt/L², L half of its thickness."""
    beta = slab_roots(biot)
    return float((2 * np.sin(beta) ** 2 / (beta * (beta + np.sin(beta) * np.cos(beta))) * np.exp(-(beta**2) * fourier)).sum())


def slab(num: int, steps: int, biot: float = 10.0, fourier: float = 0.5) -> Comparison:
    """Return the temperatures of a slab that air cools on both sides: cells of any size, in any number of steps."""
    half, alpha = 0.01, 1e-6
    material = {"like": "steel", "conductivity": 1.0, "density": 1000.0, "specific_heat": 1000.0}
    sensor = {
        "cells": [1, 1, num],
        "material": material,
        "convection": biot / half,
        "exposed": ["-z", "+z"],
        "temperature": 62.0,
    }
    with folder() as where:
        module = heat_module(where, {"slab": [0.01, 0.01, 2 * half]}, sensor)
    state = heat_state(module, fourier * half**2 / alpha / steps)
    begin(module, state)
    for _ in range(steps):
        found = (module(state)["heat"][0, :, 0].numpy() - 22.0) / 40.0
    beta, place = slab_roots(biot), np.arange(num + 1) * 2 / num - 1
    share = 4 * np.sin(beta) / (2 * beta + np.sin(2 * beta)) * np.exp(-(beta**2) * fourier)
    held = np.diff((share / beta * np.sin(np.outer(place, beta))).sum(axis=1)) / np.diff(place)
    return Comparison(
        f"A slab that air cools, Bi = {biot:g}, Fo = {fourier:g}, {num} cells, {steps} steps",
        "Carslaw and Jaeger 3.11, Incropera 5.5",
        "θ = Σ 4 sin β/(2β + sin 2β) cos(βx/L) e^(−β²Fo), β tan β = Bi",
        KINDS,
        "mean, then cells",
        "1",
        cases(["mean", *(f"cell {i}" for i in range(num))]),
        np.append(slab_mean(biot, fourier), held),
        np.append(found.mean(), found),
        atol=0.01 * held.max(),
        defects=(11,),
    )


def cube(num: int, material: str = "rubber", steps: int = 60) -> Comparison:
    """Return what a cube of 24 mm has lost to air in ten minutes, of cells of any size: the product of three slabs."""
    made_of, half, seconds = MATERIALS[material], 0.012, 600.0
    sensor = {"cells": [num] * 3, "material": material, "convection": 10.0, "temperature": 62.0}
    with folder() as where:
        module = heat_module(where, {"cube": [2 * half] * 3}, sensor)
    state = heat_state(module, seconds / steps)
    begin(module, state)
    for _ in range(steps):
        left = (float(module(state)["heat"].mean()) - 22.0) / 40.0
    fourier = made_of.conductivity / (made_of.density * made_of.specific_heat) * seconds / half**2
    return Comparison(
        f"A cube of {material} that air cools, {num}³ cells",
        "Incropera 5.5 and 5.8, a product of slabs",
        "1 − θ_slab³",
        KINDS,
        "heat lost, of what there was",
        "1",
        cases(["after 600 s"]),
        array(1.0 - slab_mean(10.0 * half / made_of.conductivity, fourier) ** 3),
        array(1.0 - left),
        rtol=0.05 if num < 3 else 0.03 if num < 5 else 0.002,
        defects=(11,),
    )


def flux_through(dt: float) -> Comparison:
    """Return the steady temperatures of a slab with a flux in at one face and air at the other, held for any Δt."""
    flux, h, thick, num, k = 3000.0, 1000.0, 0.02, 20, ALUMINIUM.conductivity
    source = {"flux": f"{flux} W/m2", "face": "-z"}
    sensor = {"cells": [1, 1, num], "material": "aluminium", "convection": h, "exposed": ["+z"], "source": source}
    with folder() as where:
        module = heat_module(where, {"slab": [0.02, 0.02, thick]}, sensor)
    state = heat_state(module, dt)
    begin(module, state)
    for _ in range(round(1000.0 / dt)):
        found = module(state)["heat"][0, :, 0].numpy() - 22.0
    depth = (np.arange(num) + 0.5) * thick / num
    return Comparison(
        f"A flux through a slab, to air, Δt = {dt:g} s",
        "Incropera 3.1, resistances in series",
        "ΔT = q (1/h + (L − x)/k)",
        KINDS,
        "rise of temperature",
        "K",
        along("depth", "m", depth),
        flux * (1 / h + (thick - depth) / k),
        found,
        rtol=1e-3,
        defects=(11,),
    )


def flux_radiated(dt: float) -> Comparison:
    """Return the steady temperatures of a slab with a flux in at one face, which the other radiates."""
    flux, thick, num, k, around = 400.0, 0.01, 4, MATERIALS["rubber"].conductivity, 22.0 + zero_celsius()
    sensor = {
        "cells": [1, 1, num], "material": "rubber", "emissivity": 0.9, "exposed": ["+z"],
        "source": {"flux": f"{flux} W/m2", "face": "-z"},
    }  # fmt: skip
    depth = (np.arange(num) + 0.5) * thick / num
    exact = (flux / 0.9 / stefan_boltzmann() + around**4) ** 0.25 - around + flux * (thick - depth) / k
    with folder() as where:
        module = heat_module(where, {"slab": [0.02, 0.02, thick]}, sensor)
    state = heat_state(module, dt)
    begin(module, state, exact[None, None])
    for _ in range(round(5000.0 / dt)):
        found = module(state)["heat"][0, :, 0].numpy() - 22.0
    return Comparison(
        f"A flux through a slab that radiates, Δt = {dt:g} s",
        "Stefan and Boltzmann's law, Incropera 3.1",
        "q = εσ(T_s⁴ − T_a⁴), ΔT = T_s − T_a + q (L − x)/k",
        KINDS,
        "rise of temperature",
        "K",
        along("depth", "m", depth),
        exact,
        found,
        atol=0.01 * exact[-1],
        defects=(11,),
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
    partial(slab, 10, 1),
    partial(slab, 40, 7),
    *(partial(cube, num) for num in (1, 2, 4, 12)),
    partial(cube, 2, "skin"),
    *(partial(flux_through, dt) for dt in (1.0, 20.0)),
    partial(flux_radiated, 5.0),
    *(partial(lag, dt) for dt in (0.005, 0.07, 1.3)),
)
