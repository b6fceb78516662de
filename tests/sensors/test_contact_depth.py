import numpy as np
import pytest
import torch
from oracles import geometry
from oracles.hard.probes import HALF, R
from oracles.setups.scenes import module, state

from tgdsl.sensors.contact_depth import CONTACT_DEPTH
from tgdsl.testing import KindConformance


class TestContactDepth(KindConformance):
    test_compiled_equals_eager = None  # kinematic taxels include its graph
    kind = CONTACT_DEPTH


def test_a_probe_reaches_its_radius_and_no_further():
    """A 4 cm cube and a radius of 10 mm: the depth is right at every clearance, near or far compared with the cube."""
    comparison = geometry.reach()
    assert comparison.paper_error == pytest.approx(5e-3)


def test_the_deepest_geom_of_a_compound_wins(tmp_path):
    geoms = '<geom type="sphere" size=".01"/><geom type="sphere" size=".01" pos=".03 0 0"/>'
    touch = module(tmp_path, [(0.012, 0, 0), (0.015, 0, 0), (0.02, 0, 0)], geoms, kind="contact_depth")
    depth = touch(state(touch))["s"][0, :, 0].numpy()
    np.testing.assert_allclose(depth, [0.008, 0.005, 0.01], atol=1e-15)


def test_a_filler_reads_zero_even_deep_inside(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], '<geom type="box" size=".02 .02 .02"/>', kind="contact_depth", radius=0.0)
    assert touch(state(touch))["s"].item() == 0.0


def test_the_gate_is_the_simulators_contact(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], '<geom type="sphere" size=".02"/>', kind="contact_depth", gate="contact_pair")
    scene = state(touch)
    assert touch(scene)["s"].item() == pytest.approx(R + HALF)
    scene.contact_found = torch.zeros(1, 1)
    assert touch(scene)["s"].item() == 0.0
