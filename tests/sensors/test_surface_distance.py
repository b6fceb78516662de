import numpy as np
import torch
from scenes import module, state

from tgdsl.sensors.surface_distance import SURFACE_DISTANCE
from tgdsl.testing import KindConformance


class TestSurfaceDistance(KindConformance):
    kind = SURFACE_DISTANCE
    rest = 0.05
    gates = ()
    test_compiled_equals_eager = None  # its graph is part of one that is compiled beside it


class TestSurfaceDistanceWithVectors(KindConformance):
    kind = SURFACE_DISTANCE
    parameters = {"nearest": True, "max_range": "30 mm"}
    gates = ()
    rest = (0.03,) * 3 + (0.0,) * 9


BOX = '<geom type="box" size=".02 .02 .02"/>'


def test_distance_before_in_and_after_contact(tmp_path):
    heights = np.array([0.2, 0.07, 0.0699, 0.05, 0.0201, 0.02, 0.019, 0.005])
    touch = module(tmp_path, [(0, 0, z) for z in heights], BOX, gate=None, kind="surface_distance")
    found = touch(state(touch))["s"][0, :, 0].numpy()
    np.testing.assert_allclose(found, np.minimum(heights - 0.02, 0.05), atol=1e-15)
    assert touch.inputs.fields == ("body_pos", "body_quat")


def test_the_vector_leads_to_the_surface(tmp_path):
    probes = np.array([(0.023, 0.024, 0.0), (0.0, 0.0, 0.015), (0.2, 0, 0)])
    touch = module(tmp_path, probes, BOX, gate=None, kind="surface_distance", nearest=True)
    assert touch.outputs[0].channels == ("distance_item", "nearest_item_x", "nearest_item_y", "nearest_item_z")
    found = touch(state(touch))["s"][0].numpy()
    np.testing.assert_allclose(found[0], [0.005, -0.003, -0.004, 0], atol=1e-15)
    np.testing.assert_allclose(found[1], [-0.005, 0, 0, 0.005], atol=1e-15)
    np.testing.assert_allclose(found[2], [0.05, 0, 0, 0], atol=1e-15)


def test_the_vector_is_in_the_links_frame(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], '<geom type="sphere" size=".02"/>', gate=None, kind="surface_distance", nearest=True)
    scene = state(touch, pos=[0.03, 0, 0])
    quarter = np.sqrt(0.5)
    scene.body_quat[0, touch.inputs.bodies.index("pad")] = torch.tensor([quarter, 0, 0, quarter], dtype=torch.float64)
    np.testing.assert_allclose(touch(scene)["s"][0, 0].numpy(), [0.01, 0, -0.01, 0], atol=1e-15)


def test_the_radius_has_no_effect_but_to_switch_a_probe_off(tmp_path):
    for radius, expected in ((0.001, 0.01), (0.02, 0.01), (0.0, 0.05)):
        touch = module(tmp_path, [(0.03, 0, 0)], BOX, gate=None, kind="surface_distance", radius=radius)
        np.testing.assert_allclose(touch(state(touch))["s"].item(), expected, atol=1e-15)
