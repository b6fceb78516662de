"""Heat: conduction within a link, and between what touches, against Carslaw and Jaeger, *Conduction of Heat in Solids*."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.special import erfc

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.boxes import begin, cells_of, face_contacts, heat_module, heat_state
from oracles.setups.scenes import folder
from tgdsl.fields.materials import MATERIALS
from tgdsl.sensors.temperature_grid.shares import Boxes, conductances

STEEL = MATERIALS["steel"]
ALPHA = STEEL.conductivity / (STEEL.density * STEEL.specific_heat)
"""Thermal diffusivity of steel [m²/s]."""
KINDS = ("temperature_grid",)
SIDES, COUNT = [0.02, 0.03, 0.04], [5, 4, 6]
"""Of a block [m], and its cells."""
ALLOY: dict[str, Any] = {"like": "aluminium", "conductivity": 167.0, "density": 2700.0, "specific_heat": 896.0}
HARD_RUBBER: dict[str, Any] = {"like": "rubber", "conductivity": 0.16, "density": 1190.0, "specific_heat": 2010.0}
"""Incropera, tables A.1 and A.3: aluminium 6061, hard rubber."""


def mode(numbers: Any, count: Any) -> np.ndarray:
    """Return a product of cosines at the cells' centres (x, y, z)."""
    parts = [np.cos(np.pi * m * (np.arange(n) + 0.5) / n) for m, n in zip(numbers, count, strict=True)]
    return np.einsum("i,j,k->ijk", *parts)


def rate(numbers: Any, count: Any, sides: Any, continuous: bool) -> float:
    """Return how fast a mode decays, of the cells or of the continuous solid [1/s]."""
    total = 0.0
    for m, n, side in zip(numbers, count, sides, strict=True):
        total += (np.pi * m / side) ** 2 if continuous else (2 * n / side * np.sin(0.5 * np.pi * m / n)) ** 2
    return ALPHA * total


def decayed(count: Any, sides: Any, numbers: Any, dt: float, steps: int = 1, dtype: torch.dtype = torch.float64,
            **sensor: Any) -> float:  # fmt: skip
    """Return what is left of a mode, over what there was; not-a-number if anything else is left."""
    with folder() as where:
        module = heat_module(where, {"block": sides}, {"cells": count, "material": "steel", **sensor}, dtype=dtype)
    state, above = heat_state(module, dt), 10.0 * mode(numbers, count)
    begin(module, state, above)
    for _ in range(steps):
        module(state)
    left = cells_of(module)[0, 0].double().numpy()
    factor = float((left * above).sum() / (above**2).sum())
    return factor if np.abs(left - factor * above).max() <= 2e-6 * np.abs(above).max() else np.nan


def modes_of_cells(numbers: Any, dt: float, dtype: torch.dtype = torch.float64) -> Comparison:
    """Return the decay of a mode of the cells in three steps: exact; the paper divides by 1 + αΔt k² at each."""
    own = rate(numbers, COUNT, SIDES, continuous=False)
    return Comparison(
        f"A slab's mode {tuple(numbers)} in cells, Δt = {dt:g} s{'' if dtype == torch.float64 else ', float32'}",
        "separation of variables of the cells' equations",
        "exp(−α Σ (2n/L sin πm/2n)² t)",
        KINDS,
        "what is left",
        "1",
        cases(["after 3 steps"]),
        array(np.exp(-own * 3 * dt)),
        array(decayed(COUNT, SIDES, numbers, dt, 3, dtype)),
        atol=1e-6,
        paper=array((1 + rate(numbers, COUNT, SIDES, continuous=True) * dt) ** -3),
        defects=(13,),
    )


def spectral_mode(numbers: Any = (2, 1, 3), dt: float = 0.1, steps: int = 4) -> Comparison:
    """Return the decay of a mode by the spectral scheme: the continuous solid's."""
    own = rate(numbers, COUNT, SIDES, continuous=True)
    return Comparison(
        "A slab's mode by the spectral scheme",
        "Carslaw and Jaeger 3.4; Neumann walls",
        "exp(−α Σ (mπ/L)² t)",
        KINDS,
        "what is left",
        "1",
        cases([f"after {steps} steps"]),
        array(np.exp(-own * dt * steps)),
        array(decayed(COUNT, SIDES, numbers, dt, steps, scheme="spectral")),
        atol=1e-6,
        paper=array((1 + own * dt) ** -steps),
    )


def semi_implicit(steps: int, numbers: Any = (2, 1, 0)) -> Comparison:
    """Return the decay of a mode by the paper's scheme: (1 + αΔt k²)^−n."""
    own = rate(numbers, COUNT, SIDES, continuous=True)
    return Comparison(
        f"The paper's scheme, scheme semi_implicit, {steps} steps",
        "Chung et al., appendix",
        "(1 + αΔt k²)^−n",
        KINDS,
        "what is left",
        "1",
        cases([f"after {steps} steps"]),
        array((1 + 1 / steps) ** -steps),
        array(decayed(COUNT, SIDES, numbers, 1.0 / own / steps, steps, scheme="semi_implicit")),
        rtol=1e-9,
    )


def order_in_time(numbers: Any = (2, 1, 0)) -> Comparison:
    """Return the order in time of the paper's scheme: the first."""
    steps = (10, 20, 40)
    errors = [abs(float(semi_implicit(n, numbers).ours[0]) - np.exp(-1.0)) for n in steps]
    return Comparison(
        "The paper's scheme is of first order in time, scheme semi_implicit",
        "exp(−1) − (1 + 1/n)^−n ∝ 1/n",
        "order 1",
        KINDS,
        "order of convergence",
        "1",
        cases(["10 to 20 steps", "20 to 40"]),
        np.ones(2),
        np.log2(np.divide(errors[:-1], errors[1:])),
        atol=0.05,
    )


def order_in_space(numbers: Any = (1, 2, 1)) -> Comparison:
    """Return the order in space of the exact scheme: the second."""
    time = 1.0 / rate(numbers, (1, 1, 1), SIDES, continuous=True)
    errors = [abs(decayed([n, n, n], SIDES, numbers, time) - np.exp(-1.0)) for n in (4, 8, 16)]
    return Comparison(
        "Cells approach the continuous solid at second order",
        "central differences",
        "order 2",
        KINDS,
        "order of convergence",
        "1",
        cases(["4³ to 8³", "8³ to 16³"]),
        np.full(2, 2.0),
        np.log2(np.divide(errors[:-1], errors[1:])),
        atol=0.15,
    )


def thick_solid(seconds: float = 10.0, flux: float = 5000.0, depth: float = 0.2, n: int = 200, dt: float = 0.01) -> Comparison:
    """Return how a thick solid warms under a constant flux before the far end feels it."""
    source = {"flux": f"{flux} W/m2", "face": "+z"}
    sensor = {"cells": [1, 1, n], "material": "steel", "source": source}
    with folder() as where:
        module = heat_module(where, {"block": [0.01, 0.02, depth]}, sensor)
    state, steps = heat_state(module, dt), round(seconds / dt)
    begin(module, state)
    for _ in range(steps):
        readings = module(state)
    x, diffusion = (np.arange(n) + 0.5) * depth / n, 4 * ALPHA * steps * dt
    exact = (
        2 * flux / STEEL.conductivity
        * (np.sqrt(diffusion / 4 / np.pi) * np.exp(-(x**2) / diffusion) - 0.5 * x * erfc(x / np.sqrt(diffusion)))
    )  # fmt: skip
    return Comparison(
        f"A thick solid under a constant flux, after {seconds:g} s",
        "Carslaw and Jaeger 2.9",
        "ΔT = 2q/k (√(αt/π) e^(−x²/4αt) − x/2 erfc(x/√4αt))",
        KINDS,
        "rise of temperature",
        "K",
        along("depth", "m", x),
        exact,
        readings["heat"][0, :, 0].numpy()[::-1] - 22.0,
        atol=0.01 * 2 * flux / STEEL.conductivity * np.sqrt(ALPHA * steps * dt / np.pi),
    )


def thick_solids_surface(seconds: float = 10.0, flux: float = 5000.0, depth: float = 0.2, n: int = 200) -> Comparison:
    """Return how the surface of a thick solid warms under a constant flux."""
    found = thick_solid(seconds, flux, depth, n)
    return Comparison(
        f"A thick solid's surface under a constant flux, after {seconds:g} s",
        "Carslaw and Jaeger 2.9",
        "ΔT = 2q/k √(αt/π)",
        KINDS,
        "rise of temperature",
        "K",
        cases(["surface"]),
        array(2 * flux / STEEL.conductivity * np.sqrt(ALPHA * seconds / np.pi)),
        array(found.ours[0] + flux * 0.5 * depth / n / STEEL.conductivity),
        rtol=0.01,
    )


def power_of_a_link() -> Comparison:
    """Return how much a source of 0.5 W warms all cells of a link in 5 s."""
    sensor = {"cells": [2, 2, 3], "material": "steel", "source": {"power": "500 mW"}}
    with folder() as where:
        module = heat_module(where, {"block": [0.01, 0.02, 0.03]}, sensor)
    state = heat_state(module, 0.1)
    begin(module, state)
    for _ in range(50):
        readings = module(state)
    return Comparison(
        "A power warms all of a link",
        "balance of energy",
        "ΔT = P t/ρcV",
        KINDS,
        "temperature",
        "°C",
        cases(range(12), "cell"),
        np.full(12, 22.0 + 0.5 * 5.0 / (STEEL.density * STEEL.specific_heat * 6e-6)),
        readings["heat"][0, :, 0].numpy(),
        rtol=1e-12,
    )


def diffusivity(material: dict[str, Any]) -> float:
    """Return k/ρc [m²/s]."""
    return material["conductivity"] / (material["density"] * material["specific_heat"])


def effusivity(material: dict[str, Any]) -> float:
    """Return √(kρc) [W·√s/(m²·K)]."""
    return float(np.sqrt(material["conductivity"] * material["density"] * material["specific_heat"]))


def two_bodies(steps: int = 1000, dt: float = 0.0005) -> Comparison:
    """Return how aluminium at 22 °C warms on rubber at 45 °C: its surface by 0.69 K at once, and erfc of it inside."""
    rise = 23.0 * effusivity(HARD_RUBBER) / (effusivity(ALLOY) + effusivity(HARD_RUBBER))
    sides, thick = [0.01, 0.01, 0.12], [0.01, 0.01, 0.002]
    ball = {"material": HARD_RUBBER, "temperature": 45.0, "cells": [1, 1, 80]}
    with folder() as where:
        module = heat_module(where, {"tip": sides}, {"cells": [1, 1, 120], "material": ALLOY}, {"slab": (thick, ball)})
    state = heat_state(module, dt, {("tip", "slab"): face_contacts(sides, -0.06)})
    assert state.body_pos is not None
    state.body_pos[:, module.inputs.bodies.index("slab"), 2] = -0.061
    begin(module, state)
    for _ in range(steps):
        readings = module(state)
    x = (np.arange(120) + 0.5) * 0.001
    return Comparison(
        f"Two bodies in contact, after {steps * dt:g} s",
        "Carslaw and Jaeger 2.14",
        "T_c = (e₁T₁ + e₂T₂)/(e₁ + e₂), ΔT = ΔT_c erfc(x/√4αt), e = √(kρc)",
        KINDS,
        "rise of temperature",
        "K",
        along("depth", "m", x),
        rise * erfc(x / np.sqrt(4 * diffusivity(ALLOY) * steps * dt)),
        readings["heat"][0, :, 0].numpy() - 22.0,
        atol=0.01 * rise,
        defects=(13,),
    )


def two_solids(cell: float, num: int, dt: float = 0.005, seconds: float = 0.4) -> Comparison:
    """Return what two solids of aluminium exchange through a face, one cell thick to many, within a step and over many."""
    made_of, area = MATERIALS["aluminium"], 4e-4
    sides = [0.02, 0.02, num * cell]
    slab = {"material": "aluminium", "temperature": 45.0, "cells": [1, 1, num]}
    sensor = {"cells": [1, 1, num], "material": "aluminium", "contact_area": area}
    with folder() as where:
        module = heat_module(where, {"tip": sides}, sensor, {"slab": (sides, slab)})
    state = heat_state(module, dt, {("tip", "slab"): face_contacts(sides, -0.5 * sides[2])})
    assert state.body_pos is not None
    state.body_pos[:, module.inputs.bodies.index("slab"), 2] = -sides[2]
    begin(module, state)
    found, steps = 0.0, round(seconds / dt)
    for _ in range(steps):
        found += float(module(state)["heat/heat"][0, 0, 4])
    own = made_of.conductivity * made_of.density * made_of.specific_heat
    fourier = made_of.conductivity / (made_of.density * made_of.specific_heat) * dt / cell**2
    return Comparison(
        f"Heat between two solids, αΔt/Δ² = {fourier:.2g}",
        "Carslaw and Jaeger 2.14",
        "Q = A √(kρc) (T₂ − T₁) √(t/π)",
        KINDS,
        "heat",
        "J",
        cases([f"after {seconds:g} s"]),
        array(area * np.sqrt(own * steps * dt / np.pi) * 23.0),
        array(found),
        rtol=0.01,
        defects=(13,),
    )


def spot_in_long_steps(num: int, dt: float, seconds: float = 2.0) -> Comparison:
    """Return what a cube of aluminium takes up through a spot on its face, in long steps against short ones."""
    sensor = {"cells": [num] * 3, "material": "aluminium", "contact_area": "10 mm2"}
    with folder() as where:
        module = heat_module(where, {"tip": [0.02] * 3}, sensor, {"hot": (None, {"material": "copper", "temperature": 80.0})})
    found = []
    for step in (dt, 0.002):
        module.reset()
        state = heat_state(module, step, {("tip", "hot"): [((0.001, -0.002, 0.01), (0, 0, -1), 1.0)]})
        begin(module, state)
        found.append(sum(float(module(state)["heat/heat"][0, 0, 4]) for _ in range(round(seconds / step))))
    own = MATERIALS["aluminium"]
    fourier = own.conductivity / (own.density * own.specific_heat) * dt / (0.02 / num) ** 2
    return Comparison(
        f"Heat through a spot in long steps, αΔt/Δ² = {fourier:.2g}",
        "the same cells in steps of 2 ms",
        "Q",
        KINDS,
        "heat",
        "J",
        cases([f"after {seconds:g} s"]),
        array(found[1]),
        array(found[0]),
        rtol=0.05,
        defects=(13,),
    )


def half_space(count: int) -> np.ndarray:
    """Return the Green's function of the surface layer of a half-space of unit cubes that conduct 1 [1]."""
    nodes, weights = np.polynomial.legendre.leggauss(300)
    u, w = 0.5 * (nodes + 1), 0.5 * weights
    k, dk = np.pi * u**3, 3 * np.pi * u**2 * w
    less = 2 * np.sin(k[:, None] / 2) ** 2 + 2 * np.sin(k[None, :] / 2) ** 2
    root = np.sqrt(less * (less + 2))
    value = np.outer(dk, dk) * (2 + less - root) / (2 * root) / np.pi**2
    waves = np.cos(np.outer(np.arange(count), k))
    return waves @ value @ waves.T


def greens_function(is_far: bool) -> Comparison:
    """Return the lattice's Green's function at the origin, Watson's integral, or 20 cells off, 1/2πr."""
    green = half_space(21)
    return Comparison(
        f"The Green's function of a lattice's half-space, {'20 cells off' if is_far else 'at the origin'}",
        "the potential of a point source" if is_far else "Watson 1939: 0.2527 of the whole lattice",
        "2πr g → 1" if is_far else "g(0) = 2 · 0.2527 − 1/6",
        KINDS,
        "2πr g" if is_far else "g",
        "1",
        cases(["20 cells off" if is_far else "at the origin"]),
        array(1.0 if is_far else 2 * 0.2527310098586 - 1 / 6),
        array(green[20, 0] * 2 * np.pi * 20 if is_far else green[0, 0]),
        rtol=1e-3 if is_far else 1e-6,
    )


def circular_spot(cell: float) -> Comparison:
    """Return the conductance of an isothermal disc on a half-space of cells, wherever it is: 4ka; paper: area over length.

    The half-space is a lattice known by its Green's function: what the spot's conductances leave to it is solved.
    """
    count = 2 * int(np.ceil(1 / cell)) + 7
    green, size = half_space(count), torch.tensor([float(count)], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    boxes = Boxes((0 * one, 0 * one, 0 * one), (size, size, one * 3), (one, one, one), (size, size, one * 3))
    area, middle = torch.full((1, 1, 1), np.pi / cell**2, dtype=torch.float64), 0.5 * count
    rng, found = np.random.default_rng(0), []
    places = [(0.0, 0.0), (0.5, 0.5), (0.5, 0.0), *rng.uniform(0, 0.5, size=(8, 2)).tolist()]
    for x, y in places:
        px, py, pz = (torch.full((1, 1, 1), v, dtype=torch.float64) for v in (middle + x, middle + y, 3.0))
        nx, ny, nz = (torch.full((1, 1, 1), v, dtype=torch.float64) for v in (0.0, 0.0, -1.0))
        own = conductances(area, (px, py, pz), (nx, ny, nz), one[None], boxes, (count, count, 3))[0, 0, 0].numpy()
        at = np.argwhere(own[..., 2] > 0)
        apart = np.abs(at[:, None] - at[None])
        matrix = np.diag(1 / own[..., 2][own[..., 2] > 0]) + green[apart[..., 0], apart[..., 1]]
        found.append(np.linalg.solve(matrix, np.ones(len(at))).sum() if (own[..., :2] == 0).all() else np.nan)
    return Comparison(
        f"A circular spot on cells of {cell:g} radii",
        "Carslaw and Jaeger 8.2",
        "G = 4ka",
        KINDS,
        "conductance, of unit cells that conduct 1",
        "1",
        cases([f"({x:.2f}, {y:.2f})" for x, y in places], "place in the cell"),
        np.full(len(places), 4 / cell),
        array(found),
        rtol=0.02,
        defects=(15,),
    )


def two_lumps() -> Comparison:
    """Return what two lumps in contact come to, by their heat capacities; and the first step, by what is between them."""
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
    return Comparison(
        "Two lumps in contact find their mean",
        "balance of energy; resistances in series",
        "T = Σ C T/Σ C; T₁ = 22 + 23 (1 − e^(−1.5 G t/C))/1.5",
        KINDS,
        "temperature, rise of the first step over what it must be",
        "°C, 1",
        cases(["link, in the end", "object, in the end"]),
        array([end, end]),
        array([readings["heat"].item(), readings["heat/objects"][0, 0, 0].item()])
        + (0.0 if abs((first - 22.0) / (23.0 * (1 - np.exp(-0.01 * flow * 1.5 / heat)) / 1.5) - 1) <= 1e-3 else np.nan),
        rtol=1e-9,
        defects=(13,),
    )


ORACLES: tuple[Oracle, ...] = (
    *(partial(modes_of_cells, (3, 1, 2), dt) for dt in (1e-4, 0.02, 3.0)),
    partial(modes_of_cells, (4, 3, 5), 0.02, torch.float32),
    spectral_mode,
    partial(semi_implicit, 10),
    order_in_time,
    order_in_space,
    thick_solid,
    thick_solids_surface,
    power_of_a_link,
    two_bodies,
    *(partial(greens_function, is_far) for is_far in (False, True)),
    *(partial(circular_spot, cell) for cell in (0.5, 1.0, 4.0)),
    two_lumps,
    *(partial(two_solids, cell, num) for cell, num in ((1e-3, 80), (2.5e-4, 200), (1.25e-4, 320))),
    partial(spot_in_long_steps, 8, 0.2),
)
