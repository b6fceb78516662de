"""Losses and the lag of a sensing element: closed forms of one cell, and a block that the paper's implementation freezes."""

from functools import partial

import pytest
import torch
from held import assert_holds

from tgdsl.report.oracles import cooling
from tgdsl.report.oracles.cooling import SIDES
from tgdsl.report.oracles.setups.boxes import heat_module, heat_state

COMPARED = (
    cooling.newton, partial(cooling.newton, torch.float32), cooling.exposed_faces, cooling.radiation, cooling.both_losses,
    cooling.order_of_losses, cooling.hot_block,
)  # fmt: skip


@pytest.mark.parametrize("compare", COMPARED)
def test_losses_of_a_block(compare):
    """Newton's law, radiation, both against the differential equation, exposed faces alone, second order in time."""
    assert_holds(compare())


def test_a_hot_block_stays_hot_for_a_second():
    """Of 2 × 3 × 4 cm at 100 °C: physics takes 51 mK of it in a second; the paper's implementation leaves it at −19.6 °C."""
    assert cooling.hot_block().exact[0] == pytest.approx(0.0506, rel=0.01)
    assert cooling.hot_block().paper_error > 100


@pytest.mark.parametrize("dt", [0.005, 0.07, 1.3])
def test_a_slow_element_trails_a_ramp(dt):
    """Of a temperature r t it reads r (t − τ (1 − e^(−t/τ)))."""
    assert_holds(cooling.lag(dt))


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
