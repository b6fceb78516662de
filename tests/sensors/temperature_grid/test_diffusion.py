"""Conduction within a link: modes with insulated walls, a source at a face of a thick solid."""

import numpy as np
import pytest
import torch
from heat_scenes import begin, cells_of, heat_module, heat_state
from scipy.special import erfc

import tgdsl
from tgdsl.fields.materials import MATERIALS

STEEL = MATERIALS["steel"]
ALPHA = STEEL.conductivity / (STEEL.density * STEEL.specific_heat)


def mode(numbers, count):
    """Return a product of cosines at the cells' centres."""
    parts = [np.cos(np.pi * m * (np.arange(n) + 0.5) / n) for m, n in zip(numbers, count, strict=True)]
    return np.einsum("i,j,k->ijk", *parts)


def rate(numbers, count, sides, continuous):
    """Return how fast a mode decays, of the cells or of the continuous solid [1/s]."""
    total = 0.0
    for m, n, side in zip(numbers, count, sides, strict=True):
        total += (np.pi * m / side) ** 2 if continuous else (2 * n / side * np.sin(0.5 * np.pi * m / n)) ** 2
    return ALPHA * total


def decayed(tmp_path, count, sides, numbers, dt, steps=1, dtype=torch.float64, **sensor):
    """Return what is left of a mode, over what there was."""
    module = heat_module(tmp_path, {"block": sides}, {"cells": count, "material": "steel", **sensor}, dtype=dtype)
    state, above = heat_state(module, dt), 10.0 * mode(numbers, count)
    begin(module, state, above)
    for _ in range(steps):
        module(state)
    left = cells_of(module)[0, 0].double().numpy()
    factor = float((left * above).sum() / (above**2).sum())
    np.testing.assert_allclose(left, factor * above, atol=2e-6 * np.abs(above).max())
    return factor


@pytest.mark.parametrize("numbers", [(1, 0, 0), (0, 2, 0), (3, 1, 2), (4, 3, 5), (0, 0, 0)])
@pytest.mark.parametrize("dt", [1e-4, 0.02, 3.0])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_modes_of_the_cells_decay_exactly(tmp_path, numbers, dt, dtype):
    count, sides = [5, 4, 6], [0.02, 0.03, 0.04]
    expected = np.exp(-rate(numbers, count, sides, continuous=False) * 3 * dt)
    assert decayed(tmp_path, count, sides, numbers, dt, steps=3, dtype=dtype) == pytest.approx(expected, abs=1e-6)


def test_spectral_modes_are_those_of_the_continuous_solid(tmp_path):
    count, sides, numbers = [5, 4, 6], [0.02, 0.03, 0.04], (2, 1, 3)
    expected = np.exp(-rate(numbers, count, sides, continuous=True) * 0.4)
    assert decayed(tmp_path, count, sides, numbers, 0.1, steps=4, scheme="spectral") == pytest.approx(expected, abs=1e-6)


def test_modes_of_the_continuous_solid_are_approached_at_second_order(tmp_path):
    sides, numbers, errors = [0.02, 0.03, 0.04], (1, 2, 1), []
    time = 1.0 / rate(numbers, (1, 1, 1), sides, continuous=True)
    for n in (4, 8, 16):
        errors.append(abs(decayed(tmp_path, [n, n, n], sides, numbers, time) - np.exp(-1.0)))
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.15)


def test_semi_implicit_is_of_first_order_in_time(tmp_path):
    """Each mode is divided by 1 + αΔt k² at every step, k of the continuous solid."""
    count, sides, numbers, errors = [5, 4, 6], [0.02, 0.03, 0.04], (2, 1, 0), []
    own = rate(numbers, count, sides, continuous=True)
    for steps in (10, 20, 40):
        found = decayed(tmp_path, count, sides, numbers, 1.0 / own / steps, steps, scheme="semi_implicit")
        assert found == pytest.approx((1 + 1 / steps) ** -steps, rel=1e-9)
        errors.append(abs(found - np.exp(-1.0)))
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.05)


def test_only_spectral_oversteps_a_jump(tmp_path):
    """Half a link at 100 K above the other half: the cells' own equations never leave that range, cut-off modes do."""
    above = np.zeros((1, 1, 16))
    above[..., 8:] = 100.0
    beyond = {}
    for scheme in ("exact", "spectral", "semi_implicit"):
        module = heat_module(
            tmp_path, {"block": [0.01, 0.01, 0.04]}, {"cells": [1, 1, 16], "material": "steel", "scheme": scheme}
        )
        worst = 0.0
        for dt in np.geomspace(1e-4, 10.0, 11):
            begin(module, heat_state(module, dt), above)
            module(heat_state(module, dt))
            cells = cells_of(module)
            worst = max(worst, float((-cells).max()), float((cells - 100.0).max()))
            assert float(cells.sum()) == pytest.approx(800.0, rel=1e-12)
            module.reset()
        beyond[scheme] = worst
    assert beyond["exact"] < 1e-10
    assert 1.0 < beyond["spectral"] < 5.0


def test_a_thick_solid_warms_under_a_constant_flux(tmp_path):
    """Carslaw and Jaeger, 2.9: ΔT = 2q/k [√(αt/π) e^(−x²/4αt) − x/2 erfc(x/√4αt)], before the far end feels it."""
    flux, depth, n, dt = 5000.0, 0.2, 200, 0.01
    source = {"flux": f"{flux} W/m2", "face": "+z"}
    module = heat_module(tmp_path, {"block": [0.01, 0.02, depth]}, {"cells": [1, 1, n], "material": "steel", "source": source})
    state = heat_state(module, dt)
    begin(module, state)
    x = (np.arange(n) + 0.5) * depth / n
    for step in range(1, 1001):
        readings = module(state)
        if step in (100, 400, 1000):
            time = step * dt
            diffusion = 4 * ALPHA * time
            expected = 2 * flux / STEEL.conductivity * (
                np.sqrt(diffusion / 4 / np.pi) * np.exp(-(x**2) / diffusion) - 0.5 * x * erfc(x / np.sqrt(diffusion))
            )  # fmt: skip
            found = readings["heat"][0, :, 0].numpy()[::-1] - 22.0
            np.testing.assert_allclose(
                found, expected, atol=0.01 * 2 * flux / STEEL.conductivity * np.sqrt(ALPHA * time / np.pi)
            )
            surface = found[0] + flux * 0.5 * depth / n / STEEL.conductivity
            assert surface == pytest.approx(2 * flux / STEEL.conductivity * np.sqrt(ALPHA * time / np.pi), rel=0.01)


def test_a_power_warms_all_of_a_link(tmp_path):
    module = heat_module(
        tmp_path, {"block": [0.01, 0.02, 0.03]}, {"cells": [2, 2, 3], "material": "steel", "source": {"power": "500 mW"}}
    )
    state = heat_state(module, 0.1)
    begin(module, state)
    for _ in range(50):
        readings = module(state)
    expected = 22.0 + 0.5 * 5.0 / (STEEL.density * STEEL.specific_heat * 6e-6)
    torch.testing.assert_close(readings["heat"], torch.full((1, 12, 1), expected, dtype=torch.float64), rtol=1e-12, atol=0)


@pytest.mark.parametrize("objects", [{}, {"ball": ([0.01, 0.01, 0.01], {"material": "steel", "temperature": 40.0})}])
def test_a_module_that_is_saved_and_loaded_reads_the_same(tmp_path, objects):
    """Without objects no body's pose is read; with them no field of the state says anything of their heat."""
    module = heat_module(
        tmp_path, {"tip": [0.01, 0.01, 0.01]}, {"cells": [2, 2, 2], "material": "steel", "convection": 10.0}, objects
    )
    tgdsl.save(module, tmp_path / "heat.safetensors")
    loaded, state = tgdsl.load(tmp_path / "heat.safetensors", dtype=torch.float64), module.example_state(3)
    for _ in range(2):
        torch.testing.assert_close(loaded(state), module(state), rtol=0, atol=0)
