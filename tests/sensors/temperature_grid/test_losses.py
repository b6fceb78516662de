"""Losses and the lag of a sensing element: closed forms of one cell, and a block that the paper's implementation freezes."""

import numpy as np
import pytest
import torch
from heat_scenes import begin, heat_module, heat_state
from scipy.integrate import solve_ivp

from tgdsl.fields.materials import MATERIALS
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius

ALUMINIUM = MATERIALS["aluminium"]
SIDES = (0.02, 0.03, 0.04)
AREA = 2 * (0.02 * 0.03 + 0.03 * 0.04 + 0.04 * 0.02)
HEAT = ALUMINIUM.density * ALUMINIUM.specific_heat * 0.02 * 0.03 * 0.04


def cooled(tmp_path, dt, seconds, dtype=torch.float64, **sensor):
    """Return the temperature of a block that begins at 100 °C, read to the end [°C]."""
    parameters = {"cells": [1, 1, 1], "material": "aluminium", "temperature": 100.0, **sensor}
    module = heat_module(tmp_path, {"block": SIDES}, parameters, dtype=dtype)
    state = heat_state(module, dt)
    begin(module, state)
    for _ in range(round(seconds / dt)):
        found = module(state)["heat"]
    return float(found[0].mean())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_newton_cooling(tmp_path, dtype):
    expected = 22 + 78 * np.exp(-50.0 * AREA * 100 / HEAT)
    assert cooled(tmp_path, 0.5, 100.0, dtype, convection=50.0) == pytest.approx(
        expected, rel=1e-6 if dtype == torch.float32 else 1e-12
    )


def test_radiation_of_a_lump(tmp_path):
    """T = C/(4εσA T_a³) [ln |(T + T_a)/(T − T_a)| + 2 atan(T/T_a)] from start to end (Incropera, 5.3)."""
    around = 22.0 + zero_celsius()

    def elapsed(hot):
        return np.log((hot + around) / (hot - around)) + 2 * np.arctan(hot / around)

    left = cooled(tmp_path, 1.0, 2000.0, emissivity=0.85)
    factor = HEAT / (4 * 0.85 * stefan_boltzmann() * AREA * around**3)
    time = factor * (elapsed(left + zero_celsius()) - elapsed(100.0 + zero_celsius()))
    assert time == pytest.approx(2000.0, rel=1e-4)


def test_both_together_equal_the_differential_equation(tmp_path):
    def slope(_, hot):
        around = 22.0 + zero_celsius()
        return -AREA / HEAT * (20.0 * (hot - around) + 0.5 * stefan_boltzmann() * (hot**4 - around**4))

    solution = solve_ivp(slope, (0, 600), [100.0 + zero_celsius()], rtol=1e-10, atol=1e-10)
    found = cooled(tmp_path, 0.5, 600.0, emissivity=0.5, convection=20.0)
    assert found - 22 == pytest.approx(float(solution.y[0, -1]) - zero_celsius() - 22, rel=1e-4)


def test_a_step_of_losses_is_of_second_order(tmp_path):
    fine = cooled(tmp_path, 1.0, 800.0, emissivity=0.9, convection=5.0)
    errors = [abs(cooled(tmp_path, dt, 800.0, emissivity=0.9, convection=5.0) - fine) for dt in (50.0, 100.0, 200.0)]
    np.testing.assert_allclose(np.log2(np.divide(errors[1:], errors[:-1])), 2.0, atol=0.2)


def test_a_hot_block_stays_hot_for_a_second(tmp_path):
    """Of 2 × 3 × 4 cm at 100 °C: physics takes 41 mK of it in a second; the paper's implementation leaves it at −19.6 °C."""
    rate = 0.85 * stefan_boltzmann() * (373.15**4 - 295.15**4) * AREA / HEAT
    found = cooled(tmp_path, 0.005, 1.0, emissivity=0.85, cells=[2, 3, 4])
    assert 100.0 - found == pytest.approx(rate, rel=2e-3)


def test_only_exposed_faces_lose_heat(tmp_path):
    expected = 22 + 78 * np.exp(-50.0 * 2 * 0.03 * 0.04 * 100 / HEAT)
    assert cooled(tmp_path, 0.5, 100.0, convection=50.0, exposed=["-x", "+x"]) == pytest.approx(expected, rel=1e-12)


def test_a_slow_element_trails_a_ramp(tmp_path):
    """Of a temperature r t it reads r (t − τ (1 − e^(−t/τ)))."""
    parameters = {"cells": [1, 1, 1], "material": "aluminium", "source": {"power": 3.0}, "lag": "400 ms"}
    module = heat_module(tmp_path, {"block": SIDES}, parameters)
    for dt in (0.005, 0.07, 1.3):
        state, time = heat_state(module, dt), 0.0
        module.reset()
        begin(module, state)
        for _ in range(20):
            found, time = module(state)["heat"].item(), time + dt
            expected = 3.0 / HEAT * (time - 0.4 * (1 - np.exp(-time / 0.4)))
            assert found - 22.0 == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_after_a_reset_a_slow_element_reads_the_truth(tmp_path):
    """Of the environments that were reset alone."""
    parameters = {"cells": [1, 2, 1], "material": "aluminium", "temperature": 60.0, "convection": 900.0, "lag": "2 s"}
    module = heat_module(tmp_path, {"block": SIDES}, parameters, dtype=torch.float32)
    state = heat_state(module, 0.5, num_envs=3)
    for _ in range(5):
        before = module(state)["heat"].clone()
    assert (before < 59.0).all()
    module.reset([1])
    after = module(state)["heat"]
    assert (after[1] == 60.0).all()
    assert (after[[0, 2]] < before[[0, 2]]).all()
