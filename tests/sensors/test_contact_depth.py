import numpy as np
import pytest
import torch
from hard_places import HALF, HARD, R
from scenes import module, state
from scipy.spatial.transform import Rotation

from tgdsl.sensors.contact_depth import CONTACT_DEPTH
from tgdsl.testing import FAR_TOLERANCE, KindConformance, moved


class TestContactDepth(KindConformance):
    kind = CONTACT_DEPTH


@pytest.mark.parametrize("geom", HARD)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-15), (torch.float32, 3e-9)])
def test_depth_on_faces_edges_corners_and_centres(tmp_path, geom, dtype, tolerance):
    """3e-9 m is float32's rounding of a few centimetres."""
    points, depths = zip(*HARD[geom], strict=True)
    touch = module(tmp_path, points, geom, kind="contact_depth", radius=R, dtype=dtype)
    found = touch(state(touch))["s"][0, :, 0].double().numpy()
    np.testing.assert_allclose(found, depths, atol=tolerance, rtol=0)


@pytest.mark.parametrize("geom", HARD)
def test_depth_1_km_from_the_origin(tmp_path, geom):
    points, depths = zip(*HARD[geom], strict=True)
    for dtype, tolerance in ((torch.float64, FAR_TOLERANCE), (torch.float32, 1e-6)):
        touch = module(tmp_path, points, geom, kind="contact_depth", radius=R, dtype=dtype)
        far = moved(state(touch), np.array([600.0, -800.0, 50.0]), Rotation.from_rotvec([0.4, 1.0, -2.0]))
        found = touch(far)["s"][0, :, 0].double().numpy()
        np.testing.assert_allclose(found, depths, atol=tolerance * max(depths), rtol=0)


def test_a_probe_reaches_its_radius_and_no_further(tmp_path):
    """A 4 cm cube and a radius of 10 mm: the right depth at every clearance, near or far compared with the cube."""
    clearances = np.array([-5.0, 0.0, 1.0, 2.5, 4.0, 5.0, 7.5, 9.0, 9.9, 10.0, 10.1]) * 1e-3
    touch = module(
        tmp_path, [(0, 0, HALF + c) for c in clearances], '<geom type="box" size=".02 .02 .02"/>', kind="contact_depth"
    )
    found = touch(state(touch))["s"][0, :, 0].numpy()
    np.testing.assert_allclose(found, np.maximum(R - clearances, 0), atol=1e-15)


def test_the_deepest_geom_of_a_compound_wins(tmp_path):
    geoms = '<geom type="sphere" size=".01"/><geom type="sphere" size=".01" pos=".03 0 0"/>'
    touch = module(tmp_path, [(0.012, 0, 0), (0.015, 0, 0), (0.02, 0, 0)], geoms, kind="contact_depth")
    found = touch(state(touch))["s"][0, :, 0].numpy()
    np.testing.assert_allclose(found, [0.008, 0.005, 0.01], atol=1e-15)


def test_a_filler_reads_zero_even_deep_inside(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], '<geom type="box" size=".02 .02 .02"/>', kind="contact_depth", radius=0.0)
    assert touch(state(touch))["s"].item() == 0.0


def test_the_gate_is_the_simulators_contact(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], '<geom type="sphere" size=".02"/>', kind="contact_depth", gate="contact_pair")
    scene = state(touch)
    assert touch(scene)["s"].item() == pytest.approx(R + HALF)
    scene.contact_found = torch.zeros(1, 1)
    assert touch(scene)["s"].item() == 0.0
