"""Closed forms, equilibrium and independent solutions of the elastomer's kernels."""

import numpy as np
import pytest
from oracles import half_space, markers

from tgdsl.sensors.elastomer.elastic import Layer, profiles
from tgdsl.sensors.elastomer.operators import Gaussian


def test_shear_falls_off_as_one_over_r():
    comparison = half_space.far_field()
    assert comparison.paper_error > 0.5 * comparison.magnitude


def test_an_incompressible_layer_rises_next_to_a_load():
    assert profiles(np.linspace(0.0, 0.03, 3001), Layer(2e-3, 0.0, half_space.G, 0.5), 1e-3).normal.min() < 0


def test_offsets_on_a_curved_fingertip_are_exact_where_one_plane_is_not():
    """Neighbours on a cylinder of 8 mm, up to 70° off the middle, in the marker's tangent plane: R sin(Δ)."""
    comparison = markers.curved_offsets()
    assert (comparison.paper / comparison.exact).min() < 0.55
    part = markers.sheet(8, 2 * np.deg2rad(80) * 8e-3, curve=8e-3)
    u = Gaussian(8000.0, 2000.0, 1.0, 1e-3, False).spread(part.pos, part.normal, part.pos)
    assert np.abs(np.einsum("kaji,jk->ji", u, part.normal)).max() < 1e-18


def test_the_printed_kernel_is_divided_by_its_peak():
    assert markers.peak_of_the_kernel().ours[0] == pytest.approx(208.55, rel=1e-4)
