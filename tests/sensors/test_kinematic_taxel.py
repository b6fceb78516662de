import numpy as np
import pytest
import torch

from sensors.scenes import module, state
from tgdsl.sensors.kinematic_taxel import KINEMATIC_TAXEL
from tgdsl.testing import KindConformance


class TestKinematicTaxel(KindConformance):
    kind = KINEMATIC_TAXEL


class TestKinematicTaxelAsInThePaper(KindConformance):
    kind = KINEMATIC_TAXEL
    parameters = {"model": "paper", "outputs": ["force"]}


BOX = '<geom type="box" size=".02 .02 .02"/>'
D = 0.004
S = D**1.2
ABOVE = {"pos": [0, 0, 0.03 - D]}
"""The box 4 mm deep in the probe at the origin, from above: its face looks down, so the normal is −z."""


def read(tmp_path, probe=(0.0, 0.0, 0.0), sensor=None, **item):
    touch = module(tmp_path, [probe], BOX, kind="kinematic_taxel", **(sensor or {}))
    return touch(state(touch, **{**ABOVE, **item}))["s"][0, 0].numpy()


def test_pressing_pushes_the_sensor_away(tmp_path):
    np.testing.assert_allclose(read(tmp_path), [0, 0, -500 * S, 0, 0, 0], atol=1e-12)


def test_an_approaching_object_pushes_harder_and_a_leaving_one_less(tmp_path):
    np.testing.assert_allclose(read(tmp_path, linvel=[0, 0, -3])[2], -500 * S - 3 * S, rtol=1e-12)
    np.testing.assert_allclose(read(tmp_path, linvel=[0, 0, 3])[2], -500 * S + 3 * S, rtol=1e-12)


def test_friction_on_the_sensor_points_along_the_objects_motion(tmp_path):
    np.testing.assert_allclose(read(tmp_path, linvel=[0.1, -0.2, 0])[:3], [0.2, -0.4, -500 * S], rtol=1e-12)


def test_the_papers_model_has_the_papers_sign(tmp_path):
    readings = read(tmp_path, sensor={"model": "paper"}, linvel=[0.1, 0, 0], angvel=[0, 0, 3])
    np.testing.assert_allclose(readings[:3], [-0.2, 0, -500 * S], rtol=1e-12)
    np.testing.assert_allclose(readings[5], -2 * 3, rtol=1e-12)


def test_spin_twists_the_sensor_along_with_the_object(tmp_path):
    """(ω · m) m does not depend on the sign of m: the torque has the sense of the object's spin."""
    np.testing.assert_allclose(read(tmp_path, angvel=[0, 0, 3])[3:], [0, 0, 6], atol=1e-12)


def test_spin_about_a_tangent_is_motion_of_the_surface_and_no_spin(tmp_path):
    """A box that rolls about y moves over the probe with ω × r: r from its centre to the probe, 26 mm below."""
    readings = read(tmp_path, angvel=[0, 2, 0])
    np.testing.assert_allclose(readings[:3], [2 * 2 * -0.026, 0, -500 * S], atol=1e-12)
    np.testing.assert_allclose(readings[3:], 0, atol=1e-12)


def test_torque_is_about_the_links_origin(tmp_path):
    probe = (0.01, -0.005, 0.0)
    readings = read(tmp_path, probe=probe, linvel=[0.1, 0, 0])
    np.testing.assert_allclose(readings[3:], np.cross(probe, readings[:3]), atol=1e-15)


def test_a_moving_frame_feels_only_relative_motion(tmp_path):
    """Link and object turning as one rigid body: no relative velocity anywhere, whatever the place of the probe."""
    touch = module(tmp_path, [(0.01, 0.004, 0.0)], BOX, kind="kinematic_taxel")
    spin, drift = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2])
    still, moving = state(touch, **ABOVE), state(touch, **ABOVE)
    assert moving.body_pos is not None and moving.body_linvel is not None and moving.body_angvel is not None
    for i in range(2):
        moving.body_angvel[0, i] = torch.tensor(spin)
        moving.body_linvel[0, i] = torch.tensor(drift + np.cross(spin, moving.body_pos[0, i].numpy()))
    torch.testing.assert_close(touch(moving)["s"], touch(still)["s"], rtol=1e-12, atol=1e-14)


def test_a_pad_sums_to_the_law_of_its_taxels(tmp_path):
    """A box flat on 6 × 6 probes: every one in reach feels k d^α, and the sum is that of the covered ones, not the load."""
    line = np.linspace(-0.025, 0.025, 6)
    probes = [(x, y, 0) for x in line for y in line]
    touch = module(tmp_path, probes, BOX, kind="kinematic_taxel", outputs=["force"])
    forces = touch(state(touch, **ABOVE))["s"][0].numpy()
    gap = np.maximum(np.abs(np.array(probes)[:, :2]) - 0.02, 0)
    depth = np.maximum(0.01 - np.linalg.norm(np.column_stack([gap, np.full(36, 0.006)]), axis=1), 0)
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 500 * depth**1.2, rtol=1e-12)


@pytest.mark.parametrize("outputs", [["force"], ["torque"], ["torque", "force"]])
def test_outputs_are_what_is_asked_for_in_one_order(tmp_path, outputs):
    whole = read(tmp_path, probe=(0.01, 0, 0), linvel=[0.1, 0, 0])
    part = read(tmp_path, probe=(0.01, 0, 0), sensor={"outputs": outputs}, linvel=[0.1, 0, 0])
    expected = {1: {"force": whole[:3], "torque": whole[3:]}.get(outputs[0]), 2: whole}[len(outputs)]
    np.testing.assert_array_equal(part, expected)


def test_what_is_not_needed_is_not_wanted(tmp_path):
    """Without damping no velocities are read; without torque no spin."""
    still = {"normal_damping": 0, "shear_damping": 0, "spin_damping": 0}
    touch = module(tmp_path, [(0, 0, 0)], BOX, kind="kinematic_taxel", **still)
    assert touch.inputs.fields == ("body_pos", "body_quat")
    force = module(tmp_path, [(0, 0, 0)], BOX, kind="kinematic_taxel", outputs=["force"])
    assert "spin_damping" not in force.plan.sensors[0].constants
