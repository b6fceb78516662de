"""Conduction within a link: modes with insulated walls, and a source at a face of a thick solid."""

import numpy as np
import pytest
import torch
from oracles.setups.boxes import begin, cells_of, heat_module, heat_state

import tgdsl


def test_only_the_spectral_scheme_overshoots_a_jump(tmp_path):
    """Half a link at 100 K above the other half: exact equations of cells stay in that range, cut-off modes do not."""
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


@pytest.mark.parametrize("objects", [{}, {"ball": ([0.01, 0.01, 0.01], {"material": "steel", "temperature": 40.0})}])
def test_a_saved_and_loaded_module_reads_the_same(tmp_path, objects):
    """Without objects no body's pose is read; with them the state has no field for their heat."""
    module = heat_module(
        tmp_path, {"tip": [0.01, 0.01, 0.01]}, {"cells": [2, 2, 2], "material": "steel", "convection": 10.0}, objects
    )
    tgdsl.save(module, tmp_path / "heat.safetensors")
    loaded, state = tgdsl.load(tmp_path / "heat.safetensors", dtype=torch.float64), module.example_state(3)
    for _ in range(2):
        torch.testing.assert_close(loaded(state), module(state), rtol=0, atol=0)
