"""Force taxels on MuJoCo's contacts: weight, static shear, sliding, impact and moment of cubes on a pad."""

import numpy as np
import pytest
from cube_on_pad import FOOTPRINT, LINE, TAXELS, in_link, pad, settled, wrench
from scipy.spatial.transform import Rotation

import tgdsl

G = 9.81
ROUNDING = 1e-12
"""Sums of float64 forces of about 1 N."""
AT_REST = 1e-5
"""How near to its end a cube that settles has come [N]."""


@pytest.mark.parametrize("mass", [0.025, 0.25])
def test_a_resting_cube_weighs_what_it_weighs(tmp_path, mass):
    """The paper's simulator reads 24 N for either cube."""
    touch = pad(tmp_path, mass=mass)
    state = settled(touch)
    readings = touch(state)
    force = readings["s"][0].sum(dim=0).numpy()
    np.testing.assert_allclose(force, wrench(touch, state)[0], atol=ROUNDING)
    np.testing.assert_allclose(force, [0, 0, -mass * G], atol=AT_REST)
    np.testing.assert_allclose(readings["s/missed"], 0, atol=ROUNDING)
    assert (readings["s"][0, :, 2] < 0).sum() >= 4


@pytest.mark.parametrize("angle", [10.0, 25.0])
def test_static_shear_without_sliding(tmp_path, angle):
    """Gravity along the pad is held by friction: the taxels carry m g sin θ down the slope, though nothing moves."""
    turn = Rotation.from_euler("y", angle, degrees=True)
    x, _, z = turn.apply([0, 0, 0.03])
    touch = pad(tmp_path, mount=f"euler='0 {angle} 0'", place=f"pos='{x} 0 {z}' euler='0 {angle} 0'")
    state = settled(touch)
    readings = touch(state)
    creep = (settled(touch, 1501).body_pos - state.body_pos).abs().max() / 0.002
    assert creep < 0.002  # [m/s], of the solver's soft friction
    theta = np.radians(angle)
    force = readings["s"][0].sum(dim=0).numpy()
    np.testing.assert_allclose(force, wrench(touch, state)[0], atol=ROUNDING)
    np.testing.assert_allclose(force, 0.25 * G * np.array([np.sin(theta), 0, -np.cos(theta)]), atol=2e-3)


@pytest.mark.parametrize("motion", [(0.0, 1.0), (-1.0, 0.0)])
def test_a_sliding_cube_drags_the_sensor_along_with_it(tmp_path, motion):
    """μ N along the cube's motion, which gravity along the pad keeps up; no taxel's force leaves the cone of μ."""
    x, y = motion
    touch = pad(
        tmp_path, friction=0.4, gravity=f"{0.4 * G * x} {0.4 * G * y} {-G}",
        qvel=f"{0.05 * x} {0.05 * y} 0 0 0 0", place=f"pos='{-0.008 * x} {-0.008 * y} .0299'",
    )  # fmt: skip
    sim = tgdsl.simulate(touch, 1, substeps=100, keyframe="start")
    sim.step()
    state = sim.state()
    readings = touch(state)["s"][0].numpy()
    force = readings.sum(axis=0)
    np.testing.assert_allclose(force, wrench(touch, state)[0], atol=ROUNDING)
    assert force[2] < -0.5 * 0.25 * G  # a cube on its way chatters
    np.testing.assert_allclose(force[:2], 0.4 * -force[2] * np.array(motion), atol=1e-3)
    assert sim.batch.qvel[0, :2] @ motion > 0.02
    carried = readings[readings[:, 2] < -1e-6]
    assert len(carried) >= 4
    assert (np.hypot(carried[:, 0], carried[:, 1]) <= 0.4 * -carried[:, 2] * (1 + 1e-4)).all()


def test_an_impact_adds_up_to_the_change_of_momentum(tmp_path):
    """A cube that falls at 1 m/s and is slowed down: Σ f Δt over single steps is m Δv + m g T."""
    step = 5e-4
    touch = pad(tmp_path, place="pos='0 0 .0305'", qvel="0 0 -1 0 0 0", timestep=step)
    sim = tgdsl.simulate(touch, 1, keyframe="start")
    impulse, forces = 0.0, []
    before = sim.batch.qvel[0, 2]
    for _ in range(200):
        sim.step()
        forces.append(float(touch(sim.state())["s"][0, :, 2].sum()))
        impulse += forces[-1] * step
    change = 0.25 * (sim.batch.qvel[0, 2] - before)
    assert change > 0.24
    assert min(forces) < -10 * 0.25 * G
    np.testing.assert_allclose(-impulse, change + 0.25 * G * 200 * step, rtol=1e-2)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.006, -0.003, 0.0), (0.004, 0.002, 30.0)])
def test_the_moment_is_the_solvers(tmp_path, place):
    """A cube anywhere inside the pad: Σ x_j × f_j is the moment of its contacts, and the centre of pressure is below its centre."""
    x, y, angle = place
    touch = pad(tmp_path, place=f"pos='{x} {y} .03' euler='0 0 {angle}'", moment_iterations=12)
    state = settled(touch)
    readings = touch(state)
    force, pos = readings["s"][0].numpy(), np.array(TAXELS)
    _, moment = wrench(touch, state)
    scale = 0.25 * G * 0.01
    np.testing.assert_allclose(np.cross(pos, force).sum(axis=0), moment, atol=1e-4 * scale)
    np.testing.assert_allclose(readings["s/residual"][0, 0].numpy(), moment - np.cross(pos, force).sum(axis=0), atol=ROUNDING)
    centre = (force[:, 2, None] * pos[:, :2]).sum(axis=0) / force[:, 2].sum()
    np.testing.assert_allclose(centre, [x, y], atol=5e-6)
    plain = pad(tmp_path, place=f"pos='{x} {y} .03' euler='0 0 {angle}'", moment_iterations=0)(state)["s"][0].numpy()
    off = np.linalg.norm((plain[:, 2, None] * pos[:, :2]).sum(axis=0) / plain[:, 2].sum() - centre)
    assert off > 1e-4 or place == (0, 0, 0)  # by depth and distance alone it would be elsewhere


def test_a_single_row_cannot_hold_a_cube_upright(tmp_path):
    """One row of taxels under one edge: the couple about the row is the residual, the force is whole where it is in reach."""
    row = [(x, -0.015, 0.01) for x in LINE]
    touch = pad(tmp_path, taxels=row, moment_iterations=12)
    state = settled(touch)
    readings = touch(state)
    force = readings["s"][0].numpy()
    at = in_link(touch, state, state.contact_pos[0, 0].numpy() - state.body_pos[0, touch.inputs.bodies.index("pad")].numpy())
    load = in_link(touch, state, state.contact_force[0, 0].numpy())
    apart = np.linalg.norm(at[:, None] - np.array(row), axis=2).min(axis=1)
    near, far = apart < FOOTPRINT / 2, apart > FOOTPRINT
    assert (near | far).all()
    assert near.any()
    assert far.any()
    np.testing.assert_allclose(force.sum(axis=0), load[near].sum(axis=0), atol=ROUNDING)
    np.testing.assert_allclose(readings["s/missed"][0, 0], load[far].sum(axis=0), atol=ROUNDING)
    couple = (np.cross(at[near], load[near])).sum(axis=0) - np.cross(np.array(row), force).sum(axis=0)
    np.testing.assert_allclose(readings["s/residual"][0, 0], couple, atol=ROUNDING)
    assert abs(couple[0]) > 1e-3 * abs(load[near][:, 2].sum())
    assert abs(couple[1]) < 1e-6
