"""A control step taken physics step by physics step, against the same control step at once."""

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.state import SHAPES
from tgdsl.runtime.batch.simulation import BatchSimulation

SCENE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="slider" pos="0 0 .02">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="slider" type="box" size=".03 .03 .01" mass=".2"/>
    </body>
    <body name="item" pos="0 0 .0495"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="3"/></actuator>
  <keyframe><key name="home" qpos=".001 0 0 .0495 1 0 0 0" qvel=".1 0 0 0 0 0 .3"/></keyframe>
</mujoco>
"""
NOISE = {"white_noise": 5e-3, "hysteresis": {"strength": 0.5, "time_constant": 0.05}, "read_delay": "3 ms"}
CONTROLS = np.random.default_rng(0).normal(size=(6, 3, 1))


def simulation(folder, substeps=5, **sensor):
    (folder / "scene.xml").write_text(SCENE)
    points = [{"pos": [x, y, 0.01], "normal": [0, 0, 1]} for x in (-0.01, 0.01) for y in (-0.01, 0.01)]
    layout = {"resolutions": {"r": {"slider": {"method": "points", "points": points, "radius": "4 mm"}}}}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": layout},
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": {"kind": "kinematic_taxel", "links": "slider", "feels": ["item"], "noise": NOISE, **sensor}},
    }
    touch = tgdsl.compile(document)
    return touch, BatchSimulation(touch, 3, substeps=substeps, keyframe="home", threads=1)


def snapshot(sim):
    names = ("qpos", "qvel", "ctrl", "time", "xpos", "xquat", "cvel", "sensordata", "qacc_warmstart")
    return {name: np.array(getattr(sim.batch, name)) for name in names}


def assert_same_state(state, expected, names):
    for name in names:
        a, b = getattr(state, name), getattr(expected, name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, name


def test_five_substates_equal_one_control_step(tmp_path):
    """The simulator ends bit-identical, and so does the last state, except for `dt`."""
    _, at_once = simulation(tmp_path)
    touch, one_by_one = simulation(tmp_path)
    for control in CONTROLS:
        at_once.step(control)
        states = list(one_by_one.substates(control))
        assert len(states) == 5
        whole, parts = snapshot(at_once), snapshot(one_by_one)
        for name in whole:
            np.testing.assert_array_equal(parts[name], whole[name], err_msg=name)
        assert_same_state(one_by_one.state(), at_once.state(), touch.inputs.fields)
        assert_same_state(states[-1], at_once.state(), [name for name in touch.inputs.fields if name != "dt"])


def test_substates_equal_states_of_single_steps(tmp_path):
    """Each equals the state of a simulation whose control step is one physics step, including `dt`."""
    _, fine = simulation(tmp_path, substeps=1)
    touch, coarse = simulation(tmp_path)
    for control in CONTROLS:
        for state in coarse.substates(control):
            fine.step(control)
            assert_same_state(state, fine.state(), touch.inputs.fields)
    assert all(name in SHAPES or name == "dt" for name in touch.inputs.fields)


def test_substates_have_the_dt_of_a_physics_step(tmp_path):
    _, sim = simulation(tmp_path)
    assert sim.state().dt == pytest.approx(0.010)
    assert [state.dt for state in sim.substates()] == pytest.approx([0.002] * 5)
    assert sim.state().dt == pytest.approx(0.010)


def test_states_do_not_change_when_the_simulation_goes_on(tmp_path):
    _, sim = simulation(tmp_path)
    states, copies = [], []
    for state in sim.substates(CONTROLS[0]):
        states.append(state)
        copies.append(state.body_pos.clone())
    assert all(torch.equal(state.body_pos, copy) for state, copy in zip(states, copies, strict=True))
    assert not torch.equal(copies[0], copies[4])


def test_stopping_early_takes_fewer_physics_steps(tmp_path):
    _, sim = simulation(tmp_path)
    for i, _ in enumerate(sim.substates(CONTROLS[0])):
        if i == 1:
            break
    np.testing.assert_allclose(sim.batch.time, 2 * 0.002)
    sim.step()
    np.testing.assert_allclose(sim.batch.time, 7 * 0.002)
    np.testing.assert_array_equal(sim.batch.ctrl, CONTROLS[0])


def test_without_controls_the_last_ones_stay(tmp_path):
    _, sim = simulation(tmp_path)
    sim.step(CONTROLS[1])
    assert len(list(sim.substates())) == 5
    np.testing.assert_array_equal(sim.batch.ctrl, CONTROLS[1])


@pytest.mark.parametrize(
    ("control", "message"),
    [
        (np.zeros((2, 1)), r"^control has shape \(2, 1\), expected \(3, 1\) or \(1,\)$"),
        (np.array([[0.0], [np.nan], [0.0]]), r"^control is not finite in environments 1$"),
    ],
)
def test_invalid_controls_take_no_step(tmp_path, control, message):
    _, sim = simulation(tmp_path)
    before = snapshot(sim)
    with pytest.raises(SimulationError, match=message):
        next(iter(sim.substates(control)))
    after = snapshot(sim)
    assert all(np.array_equal(after[name], before[name]) for name in before)


def test_a_divergence_is_reported_where_it_happens(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the current folder
    _, sim = simulation(tmp_path)
    states = sim.substates()
    next(states)
    sim.batch.qvel[2, 0] = np.nan
    with pytest.raises(SimulationError, match=r"^environments 2 diverged, and MuJoCo has restarted them; reset them to go on$"):
        next(states)
    assert next(states, None) is None
    sim.reset([2])
    assert len(list(sim.substates())) == 5


def test_reading_every_substate_equals_reading_a_finer_simulation(tmp_path):
    """Including noise, delay and hysteresis: readings depend on the time since the last one."""
    coarse_touch, coarse = simulation(tmp_path)
    fine_touch, fine = simulation(tmp_path, substeps=1)
    for control in CONTROLS[:3]:
        for state in coarse.substates(control):
            fine.step(control)
            assert torch.equal(coarse_touch(state)["s"], fine_touch(fine.state())["s"])
