"""Hysteresis: one Maxwell branch."""

import numpy as np
from oracles import filters


def test_hysteresis_changes_the_signal():
    comparison = filters.maxwell_cycle(1)
    assert np.abs(comparison.exact - np.interp(comparison.at, *filters.PRESS)).max() > 0.3


def test_the_papers_hysteresis_depends_on_the_time_step():
    curves = [filters.maxwell_cycle(k).paper for k in (1, 2, 10)]
    assert np.abs(curves[0] - curves[1]).max() > 0.02
    assert np.abs(curves[0] - curves[2]).max() > 0.04
    assert filters.maxwell_cycle(10).paper_error < 0.01
