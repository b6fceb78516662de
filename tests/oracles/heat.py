"""Heat: conduction within a link and between touching bodies, against Carslaw and Jaeger, *Conduction of Heat in Solids*."""

from functools import cache
from itertools import product
from typing import Any

import numpy as np
import torch
from scipy.special import erfc

from oracles.comparison import Values, field
from oracles.setups.boxes import begin, cells_of, face_contacts, heat_module, heat_state, heated
from oracles.setups.scenes import folder
from tgdsl.fields.materials import MATERIALS
from tgdsl.sensors.temperature_grid.patch_flow import conductances
from tgdsl.sensors.temperature_grid.rows import Boxes

STEEL = MATERIALS["steel"]
ALPHA = STEEL.conductivity / (STEEL.density * STEEL.specific_heat)
"""Thermal diffusivity of steel [m²/s]."""
oracle = field("heat: conduction and contact", "temperature_grid")
SIDES, COUNT = [0.02, 0.03, 0.04], [5, 4, 6]
"""Sides of a block [m], and its cells."""
ALLOY: dict[str, Any] = {"like": "aluminium", "conductivity": 167.0, "density": 2700.0, "specific_heat": 896.0}
HARD_RUBBER: dict[str, Any] = {"like": "rubber", "conductivity": 0.16, "density": 1190.0, "specific_heat": 2010.0}
"""Incropera, tables A.1 and A.3: aluminium 6061, hard rubber."""


def mode(numbers: Any, count: Any) -> np.ndarray:
    """Return a product of cosines at the cells' centres (x, y, z)."""
    parts = [np.cos(np.pi * m * (np.arange(n) + 0.5) / n) for m, n in zip(numbers, count, strict=True)]
    return np.einsum("i,j,k->ijk", *parts)


def rate(numbers: Any, count: Any, sides: Any, continuous: bool) -> float:
    """Return the decay rate of a mode, of the cells or of the continuous solid [1/s]."""
    total = 0.0
    for m, n, side in zip(numbers, count, sides, strict=True):
        total += (np.pi * m / side) ** 2 if continuous else (2 * n / side * np.sin(0.5 * np.pi * m / n)) ** 2
    return ALPHA * total


def decayed(count: Any, sides: Any, numbers: Any, dt: float, steps: int = 1, dtype: torch.dtype = torch.float64,
            **sensor: Any) -> float:  # fmt: skip
    """Return the remaining fraction of a mode; NaN if other modes appear."""
    with folder() as where:
        module = heat_module(where, {"block": sides}, {"cells": count, "material": "steel", **sensor}, dtype=dtype)
    state, above = heat_state(module, dt), 10.0 * mode(numbers, count)
    begin(module, state, above)
    for _ in range(steps):
        module(state)
    left = cells_of(module)[0, 0].double().numpy()
    factor = float((left * above).sum() / (above**2).sum())
    return factor if np.abs(left - factor * above).max() <= 2e-6 * np.abs(above).max() else np.nan


@oracle(
    "A slab's mode {numbers} in cells, Δt = {dt:g} s", "exp(−α Σ (2n/L sin πm/2n)² t)",
    "separation of variables of the cells' equations", "what is left [1]", at=["after 3 steps"], atol=1e-6, defects=(13,),
    each=[((3, 1, 2), 1e-4), ((3, 1, 2), 0.02), ((3, 1, 2), 3.0), ((4, 3, 5), 0.02, torch.float32)],
    also=product(((1, 0, 0), (0, 2, 0), (3, 1, 2), (4, 3, 5), (0, 0, 0)), (1e-4, 0.02, 3.0), (torch.float64, torch.float32)),
)  # fmt: skip
def modes_of_cells(numbers: Any, dt: float, dtype: torch.dtype = torch.float64):
    cells, solid = (rate(numbers, COUNT, SIDES, continuous=is_solid) for is_solid in (False, True))
    return np.exp(-cells * 3 * dt), decayed(COUNT, SIDES, numbers, dt, 3, dtype), (1 + solid * dt) ** -3


@oracle(
    "A slab's mode by the spectral scheme", "exp(−α Σ (mπ/L)² t)", "Carslaw and Jaeger 3.4; Neumann walls", "what is left [1]",
    at=["after {steps} steps"], atol=1e-6,
)  # fmt: skip
def spectral_mode(numbers: Any = (2, 1, 3), dt: float = 0.1, steps: int = 4):
    k = rate(numbers, COUNT, SIDES, continuous=True)
    return np.exp(-k * dt * steps), decayed(COUNT, SIDES, numbers, dt, steps, scheme="spectral"), (1 + k * dt) ** -steps


@oracle(
    "The paper's scheme, scheme semi_implicit, {steps} steps", "(1 + αΔt k²)^−n", "Chung et al., appendix", "what is left [1]",
    at=["after {steps} steps"], rtol=1e-9, each=[10], also=[20, 40],
)  # fmt: skip
def semi_implicit(steps: int, numbers: Any = (2, 1, 0)):
    k = rate(numbers, COUNT, SIDES, continuous=True)
    return (1 + 1 / steps) ** -steps, decayed(COUNT, SIDES, numbers, 1.0 / k / steps, steps, scheme="semi_implicit")


@oracle(
    "The paper's scheme is of first order in time, scheme semi_implicit", "order 1", "exp(−1) − (1 + 1/n)^−n ∝ 1/n",
    "order of convergence [1]", at=["10 to 20 steps", "20 to 40"], atol=0.05,
)  # fmt: skip
def order_in_time(numbers: Any = (2, 1, 0)):
    steps = (10, 20, 40)
    errors = [abs(float(semi_implicit(n, numbers).ours[0]) - np.exp(-1.0)) for n in steps]
    return 1.0, np.log2(np.divide(errors[:-1], errors[1:]))


@oracle(
    "Cells approach the continuous solid at second order", "order 2", "central differences", "order of convergence [1]",
    at=["4³ to 8³", "8³ to 16³"], atol=0.15,
)  # fmt: skip
def order_in_space(numbers: Any = (1, 2, 1)):
    time = 1.0 / rate(numbers, (1, 1, 1), SIDES, continuous=True)
    errors = [abs(decayed([n, n, n], SIDES, numbers, time) - np.exp(-1.0)) for n in (4, 8, 16)]
    return 2.0, np.log2(np.divide(errors[:-1], errors[1:]))


@cache
def risen(seconds: float, flux: float, depth: float, n: int, dt: float = 0.05) -> np.ndarray:
    """Return the temperature rise of a thick solid's cells, starting at its heated surface [K]."""
    sensor = {"cells": [1, 1, n], "material": "steel", "source": {"flux": f"{flux} W/m2", "face": "+z"}}
    *_, last = heated({"block": [0.01, 0.02, depth]}, sensor, dt, round(seconds / dt))
    return last["heat"][0, :, 0].numpy()[::-1] - 22.0


@oracle(
    "A thick solid under a constant flux, after {seconds:g} s", "ΔT = 2q/k (√(αt/π) e^(−x²/4αt) − x/2 erfc(x/√4αt))",
    "Carslaw and Jaeger 2.9", "rise of temperature [K]", "depth [m]", each=[10.0], also=[1.0, 4.0],
)  # fmt: skip
def thick_solid(seconds: float, flux: float = 5000.0, depth: float = 0.2, n: int = 200, dt: float = 0.05):
    x, diffusion = (np.arange(n) + 0.5) * depth / n, 4 * ALPHA * round(seconds / dt) * dt
    root, scale = np.sqrt(diffusion / 4 / np.pi), 2 * flux / STEEL.conductivity
    exact = scale * (root * np.exp(-(x**2) / diffusion) - 0.5 * x * erfc(x / np.sqrt(diffusion)))
    return Values(exact, risen(seconds, flux, depth, n, dt), at=x, atol=0.01 * scale * root)


@oracle(
    "A thick solid's surface under a constant flux, after {seconds:g} s", "ΔT = 2q/k √(αt/π)", "Carslaw and Jaeger 2.9",
    "rise of temperature [K]", at=["surface"], rtol=0.01, each=[10.0], also=[1.0, 4.0],
)  # fmt: skip
def thick_solids_surface(seconds: float, flux: float = 5000.0, depth: float = 0.2, n: int = 200):
    ours = risen(seconds, flux, depth, n)[0] + flux * 0.5 * depth / n / STEEL.conductivity
    return 2 * flux / STEEL.conductivity * np.sqrt(ALPHA * seconds / np.pi), ours


@oracle(
    "A power warms all of a link", "ΔT = P t/ρcV", "balance of energy", "temperature [°C]", "cell", at=range(12), rtol=1e-12
)
def power_of_a_link():
    sensor = {"cells": [2, 2, 3], "material": "steel", "source": {"power": "500 mW"}}
    *_, last = heated({"block": [0.01, 0.02, 0.03]}, sensor, 0.1, 50)
    return 22.0 + 0.5 * 5.0 / (STEEL.density * STEEL.specific_heat * 6e-6), last["heat"][0, :, 0]


def diffusivity(material: dict[str, Any]) -> float:
    """Return k/ρc [m²/s]."""
    return material["conductivity"] / (material["density"] * material["specific_heat"])


def effusivity(material: dict[str, Any]) -> float:
    """Return √(kρc) [W·√s/(m²·K)]."""
    return float(np.sqrt(material["conductivity"] * material["density"] * material["specific_heat"]))


@oracle(
    "Two bodies in contact, after {seconds:g} s", "T_c = (e₁T₁ + e₂T₂)/(e₁ + e₂), ΔT = ΔT_c erfc(x/√4αt), e = √(kρc)",
    "Carslaw and Jaeger 2.14", "rise of temperature [K]", "depth [m]", defects=(13,), each=[100], also=[40],
)  # fmt: skip
def two_bodies(steps: int, dt: float = 0.005):
    rise = 23.0 * effusivity(HARD_RUBBER) / (effusivity(ALLOY) + effusivity(HARD_RUBBER))
    sides, thick = [0.01, 0.01, 0.12], [0.01, 0.01, 0.002]
    slab = {"material": HARD_RUBBER, "temperature": 45.0, "cells": [1, 1, 80]}
    *_, last = heated(
        {"tip": sides}, {"cells": [1, 1, 120], "material": ALLOY}, dt, steps, {"slab": (thick, slab)},
        {("tip", "slab"): face_contacts(sides, -0.06)}, {"slab": -0.061},
    )  # fmt: skip
    x = (np.arange(120) + 0.5) * 0.001
    exact = rise * erfc(x / np.sqrt(4 * diffusivity(ALLOY) * steps * dt))
    ours = last["heat"][0, :, 0].numpy() - 22.0
    return Values(exact, ours, at=x, atol=0.01 * rise, words={"seconds": steps * dt})


@oracle(
    "Heat between two solids, αΔt/Δ² = {fourier:.2g}", "Q = A √(kρc) (T₂ − T₁) √(t/π)", "Carslaw and Jaeger 2.14", "heat [J]",
    at=["after {seconds:g} s"], rtol=0.002, defects=(13,), each=[(1e-3, 80), (2.5e-4, 200), (1.25e-4, 320)],
)  # fmt: skip
def two_solids(cell: float, num: int, dt: float = 0.005, seconds: float = 0.4):
    area, steps, sides = 4e-4, round(seconds / dt), [0.02, 0.02, num * cell]
    slab = {"material": "aluminium", "temperature": 45.0, "cells": [1, 1, num]}
    sensor = {"cells": [1, 1, num], "material": "aluminium", "contact_area": area}
    contacts = {("tip", "slab"): face_contacts(sides, -0.5 * sides[2])}
    stream = heated({"tip": sides}, sensor, dt, steps, {"slab": (sides, slab)}, contacts, {"slab": -sides[2]})
    ours = sum(float(readings["heat/heat"][0, 0, 4]) for readings in stream)
    metal = MATERIALS["aluminium"]
    exact = area * np.sqrt(metal.conductivity * metal.density * metal.specific_heat * steps * dt / np.pi) * 23.0
    return Values(exact, ours, words={"fourier": metal.conductivity / (metal.density * metal.specific_heat) * dt / cell**2})


@oracle(
    "Heat through a spot in long steps, αΔt/Δ² = {fourier:.2g}", "Q", "the same cells in steps of 25 ms", "heat [J]",
    at=["after {seconds:g} s"], rtol=0.01, defects=(13,), each=[(8, 0.2)], also=[(4, 1.0), (12, 1.0)],
)  # fmt: skip
def spot_in_long_steps(num: int, dt: float, seconds: float = 1.0):
    sensor = {"cells": [num] * 3, "material": "aluminium", "contact_area": "10 mm2"}
    hot = {"hot": (None, {"material": "copper", "temperature": 80.0})}
    contacts = {("tip", "hot"): [((0.001, -0.002, 0.01), (0, 0, -1), 1.0)]}
    streams = (heated({"tip": [0.02] * 3}, sensor, step, round(seconds / step), hot, contacts) for step in (dt, 0.025))
    ours, exact = (sum(float(readings["heat/heat"][0, 0, 4]) for readings in stream) for stream in streams)
    metal = MATERIALS["aluminium"]
    fourier = metal.conductivity / (metal.density * metal.specific_heat) * dt / (0.02 / num) ** 2
    return Values(exact, ours, words={"fourier": fourier})


def half_space(count: int) -> np.ndarray:
    """Return the Green's function of the surface layer of a half-space of unit cubes with conductivity 1 [1]."""
    nodes, weights = np.polynomial.legendre.leggauss(300)
    u, w = 0.5 * (nodes + 1), 0.5 * weights
    k, dk = np.pi * u**3, 3 * np.pi * u**2 * w
    less = 2 * np.sin(k[:, None] / 2) ** 2 + 2 * np.sin(k[None, :] / 2) ** 2
    root = np.sqrt(less * (less + 2))
    value = np.outer(dk, dk) * (2 + less - root) / (2 * root) / np.pi**2
    waves = np.cos(np.outer(np.arange(count), k))
    return waves @ value @ waves.T


@oracle(
    "The Green's function of a lattice's half-space, at the origin", "g(0) = 2 · 0.2527 − 1/6",
    "Watson 1939: 0.2527 of the whole lattice", "g [1]", at=["at the origin"], rtol=1e-6,
)  # fmt: skip
def greens_function():
    return 2 * 0.2527310098586 - 1 / 6, half_space(21)[0, 0]


@oracle(
    "The Green's function of a lattice's half-space, 20 cells off", "2πr g → 1", "the potential of a point source", "2πr g [1]",
    at=["20 cells off"], rtol=1e-3,
)  # fmt: skip
def greens_function_far_off():
    return 1.0, half_space(21)[20, 0] * 2 * np.pi * 20


@oracle(
    "A circular spot on cells of {cell:g} radii", "G = 4ka", "Carslaw and Jaeger 8.2",
    "conductance, of unit cells that conduct 1 [1]", "place in the cell", rtol=0.02, defects=(15,), each=[0.5, 1.0, 4.0],
    also=[0.25, 0.35, 0.7, 1.4, 2.0, 2.8, 8.0],
)  # fmt: skip
def circular_spot(cell: float):
    # The Green's function of the lattice is known; solve for the heat that the spot's conductances pass on to it.
    count = 2 * int(np.ceil(1 / cell)) + 7
    green, size = half_space(count), torch.tensor([float(count)], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    boxes = Boxes((0 * one, 0 * one, 0 * one), (size, size, one * 3), (one, one, one), (size, size, one * 3))
    area, middle = torch.full((1, 1, 1), np.pi / cell**2, dtype=torch.float64), 0.5 * count
    rng, ours = np.random.default_rng(0), []
    places = [(0.0, 0.0), (0.5, 0.5), (0.5, 0.0), *rng.uniform(0, 0.5, size=(8, 2)).tolist()]
    for x, y in places:
        px, py, pz = (torch.full((1, 1, 1), v, dtype=torch.float64) for v in (middle + x, middle + y, 3.0))
        nx, ny, nz = (torch.full((1, 1, 1), v, dtype=torch.float64) for v in (0.0, 0.0, -1.0))
        spot = conductances(area, (px, py, pz), (nx, ny, nz), one[None], boxes, (count, count, 3))[0, 0, 0].numpy()
        at = np.argwhere(spot[..., 2] > 0)
        apart = np.abs(at[:, None] - at[None])
        matrix = np.diag(1 / spot[..., 2][spot[..., 2] > 0]) + green[apart[..., 0], apart[..., 1]]
        ours.append(np.linalg.solve(matrix, np.ones(len(at))).sum() if (spot[..., :2] == 0).all() else np.nan)
    return Values(4 / cell, ours, at=[f"({x:.2f}, {y:.2f})" for x, y in places])


@oracle(
    "Two lumps in contact find their mean", "T = Σ C T/Σ C; T₁ = 22 + 23 (1 − e^(−1.5 G t/C))/1.5",
    "balance of energy; resistances in series", "temperature, rise of the first step over what it must be [°C, 1]",
    at=["link, in the end", "object, in the end"], rtol=1e-9, defects=(13,),
)  # fmt: skip
def two_lumps():
    copper = MATERIALS["copper"]
    ball = {"material": "copper", "temperature": 45.0}
    sensor = {"cells": [1, 1, 1], "material": "copper", "contact_area": "1 cm2", "contact_conductance": "200 W/(m2*K)"}
    with folder() as where:
        module = heat_module(where, {"tip": [0.01, 0.01, 0.01]}, sensor, {"ball": ([0.01, 0.01, 0.02], ball)})
    state = heat_state(module, 0.01, {("tip", "ball"): [((0, 0, 0.005), (0, 0, -1), 2.0)]})
    begin(module, state)
    first = module(state)["heat"].item()
    heat, width, radius = copper.density * copper.specific_heat * 1e-6, 2e-6 ** (1 / 3), np.sqrt(1e-4 / np.pi)
    inside = copper.conductivity * (2e-4 / width + 4 * radius * (1 - 0.01 / width) / (1 + 0.5 * radius / width))
    flow = 1 / (1 / (2 * copper.conductivity * 0.01) + 1 / (200 * 1e-4) + 1 / inside)
    state.dt = 100.0
    for _ in range(50):
        readings = module(state)
    end = 22 + 23 * 2 / 3
    is_first_right = abs((first - 22.0) / (23.0 * (1 - np.exp(-0.01 * flow * 1.5 / heat)) / 1.5) - 1) <= 1e-3
    return end, [readings["heat"].item(), readings["heat/objects"][0, 0, 0].item()] if is_first_right else np.nan
