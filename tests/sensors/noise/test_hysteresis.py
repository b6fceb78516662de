"""Hysteresis: one Maxwell branch."""

import numpy as np
import pytest
import torch
from held import assert_holds
from oracles import filters


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 0.05, 10.0])
def test_hysteresis_on_a_ramp(dt):
    assert_holds(filters.maxwell_ramp(dt))


def test_hysteresis_after_a_step():
    assert_holds(filters.maxwell_step())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("parts", [1, 2, 10])
def test_hysteresis_is_the_same_at_any_step(parts, dtype):
    found = filters.maxwell_cycle(parts, dtype)
    assert_holds(found)
    assert np.abs(found.exact - np.interp(found.over.numbers, *filters.PRESS)).max() > 0.3


def test_the_papers_hysteresis_is_not():
    curves = [filters.maxwell_cycle(k).paper for k in (1, 2, 10)]
    assert np.abs(curves[0] - curves[1]).max() > 0.02
    assert np.abs(curves[0] - curves[2]).max() > 0.04
    assert filters.maxwell_cycle(10).paper_error < 0.01
