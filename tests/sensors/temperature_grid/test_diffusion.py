"""Conduction within a link: modes with insulated walls, a source at a face of a thick solid."""

import numpy as np
import pytest
import torch
from held import assert_holds
from oracles import heat
from oracles.setups.boxes import begin, cells_of, heat_module, heat_state

import tgdsl


@pytest.mark.parametrize("numbers", [(1, 0, 0), (0, 2, 0), (3, 1, 2), (4, 3, 5), (0, 0, 0)])
@pytest.mark.parametrize("dt", [1e-4, 0.02, 3.0])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_modes_of_the_cells_decay_exactly(numbers, dt, dtype):
    assert_holds(heat.modes_of_cells(numbers, dt, dtype))


def test_spectral_modes_are_those_of_the_continuous_solid():
    assert_holds(heat.spectral_mode())


def test_modes_of_the_continuous_solid_are_approached_at_second_order():
    assert_holds(heat.order_in_space())


@pytest.mark.parametrize("steps", [10, 20, 40])
def test_semi_implicit_divides_modes(steps):
    """Each mode is divided by 1 + αΔt k² at every step, k of the continuous solid."""
    assert_holds(heat.semi_implicit(steps))


def test_semi_implicit_is_of_first_order_in_time():
    assert_holds(heat.order_in_time())


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


@pytest.mark.parametrize("seconds", [1.0, 4.0])
def test_a_thick_solid_warms_under_a_constant_flux(seconds):
    assert_holds(heat.thick_solid(seconds))
    assert_holds(heat.thick_solids_surface(seconds))


def test_a_power_warms_all_of_a_link():
    assert_holds(heat.power_of_a_link())


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
