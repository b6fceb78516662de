"""Force taxels on MuJoCo's contacts: weight, static shear, sliding, impact and moment of cubes on a pad."""

import numpy as np
import pytest
from oracles import forces
from oracles.setups.scenes import FOOTPRINT, LINE, TAXELS, in_link, pad, settled, wrench
from scipy.spatial.transform import Rotation

ROUNDING = 1e-12
"""Sums of float64 forces of about 1 N."""


@pytest.mark.parametrize("mass", [0.025, 0.25])
def test_a_resting_cube_reads_its_weight(tmp_path, mass):
    touch = pad(tmp_path, mass=mass)
    readings = touch(settled(touch))
    np.testing.assert_allclose(readings["s"][0].sum(dim=0)[:2], [0, 0], atol=forces.AT_REST)
    np.testing.assert_allclose(readings["s/missed"], 0, atol=ROUNDING)
    assert (readings["s"][0, :, 2] < 0).sum() >= 4


def test_the_papers_law_gives_two_cubes_the_same_weight():
    comparison = forces.weight((0.025, 0.25))
    assert comparison.paper[0] == pytest.approx(comparison.paper[1], rel=0.05)
    assert comparison.paper_error > 2


@pytest.mark.parametrize("angle", [10.0, 25.0])
def test_static_shear_without_sliding(angle):
    """Friction holds the cube on a slope: the taxels carry m g sin θ down the slope, though nothing moves."""
    comparison = forces.static_shear(angle)
    assert abs(comparison.paper[0]) < 0.2 * comparison.exact[0]


@pytest.mark.parametrize("angle", [10.0, 25.0])
def test_static_shear_equals_the_solvers(tmp_path, angle):
    turn = Rotation.from_euler("y", angle, degrees=True)
    x, _, z = turn.apply([0, 0, 0.03])
    touch = pad(tmp_path, mount=f"euler='0 {angle} 0'", place=f"pos='{x} 0 {z}' euler='0 {angle} 0'")
    state = settled(touch)
    np.testing.assert_allclose(forces.total(touch, state), wrench(touch, state)[0], atol=ROUNDING)


@pytest.mark.parametrize("motion", [(0.0, 1.0), (-1.0, 0.0)])
def test_a_sliding_cube_drags_the_sensor_along_with_it(motion):
    """μ N along the cube's motion, which gravity along the pad sustains; no taxel's force leaves the cone of μ."""
    comparison = forces.sliding(motion)
    assert comparison.paper @ motion < 0


@pytest.mark.parametrize("place", forces.PLACES)
def test_the_moment_equals_the_solvers(tmp_path, place):
    """A cube anywhere on the pad: Σ x_j × f_j is the moment of its contacts, and the centre of pressure is below its centre."""
    x, y, angle = place
    touch = pad(tmp_path, place=f"pos='{x} {y} .03' euler='0 0 {angle}'", moment_iterations=12)
    state = settled(touch)
    readings, pos = touch(state), np.array(TAXELS)
    force, (_, moment) = readings["s"][0].numpy(), wrench(touch, state)
    np.testing.assert_allclose(readings["s/residual"][0, 0].numpy(), moment - np.cross(pos, force).sum(axis=0), atol=ROUNDING)
    plain = pad(tmp_path, place=f"pos='{x} {y} .03' euler='0 0 {angle}'", moment_iterations=0)(state)["s"][0].numpy()
    centre = (force[:, 2, None] * pos[:, :2]).sum(axis=0) / force[:, 2].sum()
    offset = np.linalg.norm((plain[:, 2, None] * pos[:, :2]).sum(axis=0) / plain[:, 2].sum() - centre)
    assert offset > 1e-4 or place == (0, 0, 0)  # by depth and distance alone it would be elsewhere


def test_velocities_refer_to_the_frames_origin():
    comparison = forces.velocity_at_the_origin()
    assert comparison.paper_error > 0.1


def test_a_single_row_cannot_hold_a_cube_upright(tmp_path):
    """One row of taxels under one edge: the couple about the row is the residual; the force within reach is complete."""
    row = [(x, -0.015, 0.01) for x in LINE]
    touch = pad(tmp_path, taxels=row, moment_iterations=12)
    state = settled(touch)
    readings = touch(state)
    force = readings["s"][0].numpy()
    at = in_link(touch, state, state.contact_pos[0, 0].numpy() - state.body_pos[0, touch.inputs.bodies.index("pad")].numpy())
    load = in_link(touch, state, state.contact_force[0, 0].numpy())
    distance = np.linalg.norm(at[:, None] - np.array(row), axis=2).min(axis=1)
    near, far = distance < FOOTPRINT / 2, distance > FOOTPRINT
    assert (near | far).all()
    assert near.any()
    assert far.any()
    np.testing.assert_allclose(force.sum(axis=0), load[near].sum(axis=0), atol=ROUNDING)
    np.testing.assert_allclose(readings["s/missed"][0, 0], load[far].sum(axis=0), atol=ROUNDING)
    couple = (np.cross(at[near], load[near])).sum(axis=0) - np.cross(np.array(row), force).sum(axis=0)
    np.testing.assert_allclose(readings["s/residual"][0, 0], couple, atol=ROUNDING)
    assert abs(couple[0]) > 1e-3 * abs(load[near][:, 2].sum())
    assert abs(couple[1]) < 1e-6
