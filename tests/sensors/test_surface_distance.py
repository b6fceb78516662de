import numpy as np
import torch
from oracles.setups.scenes import module, state

from tgdsl.sensors.surface_distance import SURFACE_DISTANCE
from tgdsl.testing import KindConformance


class TestSurfaceDistance(KindConformance):
    kind = SURFACE_DISTANCE
    rest = 0.05
    gates = ()
    test_compiled_equals_eager = None  # part of another compiled graph


class TestSurfaceDistanceWithVectors(KindConformance):
    kind = SURFACE_DISTANCE
    parameters = {"nearest": True, "max_range": "30 mm"}
    gates = ()
    rest = (0.03,) * 3 + (0.0,) * 9


BOX = '<geom type="box" size=".02 .02 .02"/>'


def test_distance_before_in_and_after_contact(tmp_path):
    touch = module(tmp_path, [(0, 0, 0.02)], BOX, gate=None, kind="surface_distance")
    assert touch.inputs.fields == ("body_pos", "body_quat")


def test_the_vector_leads_to_the_surface(tmp_path):
    touch = module(tmp_path, [(0, 0, 0.02)], BOX, gate=None, kind="surface_distance", nearest=True)
    assert touch.outputs[0].channels == ("distance_item", "nearest_item_x", "nearest_item_y", "nearest_item_z")


def test_the_vector_is_in_the_links_frame(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], '<geom type="sphere" size=".02"/>', gate=None, kind="surface_distance", nearest=True)
    scene = state(touch, pos=[0.03, 0, 0])
    quarter = np.sqrt(0.5)
    scene.body_quat[0, touch.inputs.bodies.index("pad")] = torch.tensor([quarter, 0, 0, quarter], dtype=torch.float64)
    np.testing.assert_allclose(touch(scene)["s"][0, 0].numpy(), [0.01, 0, -0.01, 0], atol=1e-15)


def test_the_radius_only_switches_probes_off(tmp_path):
    for radius, expected in ((0.001, 0.01), (0.02, 0.01), (0.0, 0.05)):
        touch = module(tmp_path, [(0.03, 0, 0)], BOX, gate=None, kind="surface_distance", radius=radius)
        np.testing.assert_allclose(touch(state(touch))["s"].item(), expected, atol=1e-15)
