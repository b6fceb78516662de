"""Environments that diverge or get values that are not finite: named, restarted on request, without effect on the others."""

import warnings

import numpy as np
import pytest
import torch
from warp_cases import SCENE, module, warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulators.faults import BAD_CONTROL, BAD_VALUES, EnvFaults
from tgdsl.runtime.simulators.state_values import NewValues

BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
CONTROLS = np.random.default_rng(3).normal(size=(6, 2))
PRESSED = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"')
SAID = r"^environments had faults and were restarted: {}; shown once, `fault_counts` counts all faults$"


@pytest.fixture(autouse=True)
def _in_a_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the current folder


def assert_same(sim, env, other, env_there, fields) -> None:
    """Assert that two environments are bit-identical."""
    for name in ("qpos", "qvel", "ctrl"):
        assert torch.equal(getattr(sim, name)[env], getattr(other, name)[env_there]), name
    state, expected = sim.state(), other.state()
    for name in fields:
        if name != "dt":
            assert torch.equal(getattr(state, name)[env], getattr(expected, name)[env_there]), name


@pytest.mark.slow
@pytest.mark.parametrize(("simulator", "substeps"), [(BatchSimulation, 1), (BatchSimulation, 4), (warp, 4)])
def test_a_diverged_environment_restarts_and_the_others_go_on(tmp_path, simulator, substeps):
    touch, keys = module(tmp_path), {"keyframe": "home", "substeps": substeps}
    sim, twin = simulator(touch, 4, on_fault="reset", **keys), simulator(touch, 4, **keys)
    for i, control in enumerate(CONTROLS):
        if i == 2:
            sim.qvel[1, 0], sim.qpos[3, 7] = torch.nan, torch.inf
        if i == 2:
            with pytest.warns(UserWarning, match=SAID.format("2 diverged")):
                sim.step(control)
        else:
            sim.step(control)
        twin.step(control)
        if i == 2:
            twin.reset([1, 3])
        assert sim.faults.tolist() == [False, i == 2, False, i == 2]
        for env in range(4):
            assert_same(sim, env, twin, env, touch.inputs.fields)
    assert sim.fault_counts.tolist() == [0, 1, 0, 1]
    sim.qvel[1] = torch.nan
    sim.step()  # no second warning
    assert sim.fault_counts.tolist() == [0, 2, 0, 1] and sim.faults.tolist() == [False, True, False, False]


@BOTH
def test_controls_that_are_not_finite_restart_their_environment(tmp_path, simulator):
    touch = module(tmp_path)
    sim, twin = (simulator(touch, 3, keyframe="home", **keys) for keys in ({"on_fault": "reset"}, {}))
    good = np.random.default_rng(0).normal(size=(3, 2))
    for each in (sim, twin):
        each.step(good)
    with pytest.warns(UserWarning, match=SAID.format("2 had controls that are not finite")):
        sim.step(np.where([[True], [False], [False]], [[np.nan, 0.1]], np.where([[0], [0], [1]], np.inf, good)))
    twin.step(good)
    twin.reset([0, 2])
    assert sim.faults.tolist() == [True, False, True]
    assert torch.isfinite(sim.ctrl).all()
    for env in range(3):
        assert_same(sim, env, twin, env, touch.inputs.fields)
    sim.step(np.array([np.nan, 0.0]))  # for all environments
    assert sim.fault_counts.tolist() == [2, 1, 2]
    for env in range(3):
        assert_same(sim, env, simulator(touch, 1, keyframe="home"), 0, touch.inputs.fields)


@BOTH
def test_a_module_forgets_a_faulty_environment(tmp_path, simulator):
    noise = {"read_delay": "4 ms"}
    touch = module(tmp_path, PRESSED, links=("table",), noise=noise)
    other = module(tmp_path, PRESSED, links=("table",), noise=noise)
    sim, twin = simulator(touch, 3, on_fault="reset"), simulator(other, 3)
    for i in range(6):
        if i == 3:
            sim.qvel[1, 0] = torch.nan
            with pytest.warns(UserWarning, match=SAID.format("1 diverged")):
                sim.step()
        else:
            sim.step()
        twin.step()
        if i == 3:
            twin.reset([1])
        assert torch.equal(touch(sim.state())["touch"], other(twin.state())["touch"])
    assert touch(sim.state())["touch"].any()


SLIDER = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="table"><geom type="box" size=".05 .05 .01"/></body>
    <body name="cube" pos="0 0 1">
      <joint name="slide" type="slide" axis="1 0 0" damping="50"/>
      <geom type="box" size=".02 .02 .02" mass=".25"/>
    </body>
  </worldbody>
</mujoco>
"""


@BOTH
def test_a_divergence_in_one_of_many_physics_steps_counts(tmp_path, simulator):
    """Damping brings the speed below the limit before the control step ends; MuJoCo on the CPU restarts on its own."""
    touch = module(tmp_path, SLIDER, links=("table",))
    plain, sim = warp(touch, 2), simulator(touch, 2, substeps=5, on_fault="reset")
    plain.qvel[1] = sim.qvel[1] = 3e10
    speeds = []
    for _ in range(5):
        plain._physics(1)
        speeds.append(float(plain.qvel[1]))
    np.testing.assert_allclose(speeds, 3e10 / (1 + 0.002 * 50 / 0.25) ** np.arange(1, 6), rtol=1e-5)
    assert speeds[0] > 1e10 > speeds[-1]
    with pytest.warns(UserWarning, match=SAID.format("1 diverged")):
        sim.step()
    assert sim.fault_counts.tolist() == [0, 1] and sim.qvel.flatten().tolist() == [0, 0]


@BOTH
def test_a_fault_in_substates_starts_one_episode(tmp_path, simulator):
    """Another one at each later physics step would redraw gains, and delays would never fill."""
    touch = module(tmp_path, noise={"gain": [0.5, 2.0], "read_delay": "4 ms"})
    sim = simulator(touch, 3, keyframe="home", substeps=4, on_fault="reset")
    control = torch.zeros(3, 2, dtype=torch.float64)
    for state in sim.substates(control):
        touch(state)
    control[1] = torch.nan
    states = sim.substates(control)
    with pytest.warns(UserWarning, match="were restarted"):
        touch(next(states))
    for state in states:
        touch(state)
    assert touch.memory.clock.get_buffer("episode").tolist() == [0, 1, 0]
    assert touch.memory.clock.get_buffer("reset_step").tolist() == [0, 4, 0]


@BOTH
def test_substates_restart_an_environment_at_its_fault(tmp_path, simulator):
    touch = module(tmp_path)
    sim = simulator(touch, 3, keyframe="home", substeps=5, on_fault="reset")
    fresh = simulator(touch, 1, keyframe="home")
    start, states = fresh.state(), sim.substates()
    next(states)
    sim.qvel[2, 0] = torch.nan
    with pytest.warns(UserWarning, match=SAID.format("1 diverged")):
        state = next(states)
    assert torch.equal(state.body_pos[2], start.body_pos[0]) and torch.isfinite(state.body_linvel).all()
    for _ in range(3):
        next(states)
        fresh.step()
        assert_same(sim, 2, fresh, 0, touch.inputs.fields)
    assert next(states, None) is None
    assert sim.faults.tolist() == [False, False, True]  # for the whole control step


def test_step_and_read_reads_the_new_episode(tmp_path):
    noise = {"read_delay": "4 ms"}
    modules = [module(tmp_path, PRESSED, noise=noise) for _ in range(2)]
    sim, twin = (warp(touch, 3, keyframe="home", substeps=2, on_fault="reset") for touch in modules)
    for i in range(5):
        if i == 2:
            sim.qvel[1, 0] = twin.qvel[1, 0] = torch.nan
        with warnings.catch_warnings():
            warnings.simplefilter("error" if i != 2 else "ignore")
            reading = sim.step_and_read(CONTROLS[i])["touch"]
            twin.step(CONTROLS[i])
        assert torch.equal(reading, modules[1](twin.state())["touch"]) and torch.isfinite(reading).all()
    assert sim.fault_counts.tolist() == [0, 1, 0]


@BOTH
def test_faults_wait_for_a_reset_by_default(tmp_path, simulator):
    touch = module(tmp_path)
    sim = simulator(touch, 3, keyframe="home")
    assert not sim.faults.any()
    sim.qvel[1, 0] = torch.nan
    for _ in range(2):  # until it is reset
        with pytest.raises(SimulationError, match=r"^environments 1 diverged.*; reset them to go on$"):
            sim.step()
        assert sim.faults.tolist() == [False, True, False]
    assert sim.fault_counts.tolist() == [0, 1, 0]
    sim.reset(sim.faults)
    assert not sim.faults.any()
    sim.step()
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 2$"):
        sim.step(np.array([[0, 0], [0, 0], [0, np.nan]]))
    assert not sim.faults.any()  # the control was refused before any step


@BOTH
def test_a_saved_state_ends_faults(tmp_path, simulator):
    sim = simulator(module(tmp_path), 3, keyframe="home")
    saved = sim.state_dict()
    sim.qvel[1, 0] = torch.nan
    with pytest.raises(SimulationError, match="environments 1 diverged"):
        sim.step()
    sim.load_state_dict(saved)
    assert not sim.faults.any()
    sim.step()


@BOTH
def test_clipped_controls_are_warned_of_once(tmp_path, simulator):
    """A control in degrees; motors without a range accept any value."""
    scene = SCENE.replace("</actuator>", '<position name="turn" joint="two" ctrlrange="-1.5 1.5"/></actuator>')
    scene = scene.replace('ctrl=".1 -.1"', 'ctrl=".1 -.1 0"')
    sim = simulator(module(tmp_path, scene), 3)
    control = np.zeros((3, 3))
    control[:, 2], control[:, 0] = 3.0, 100.0
    sim.step(control)
    control[1, 2] = 90.0
    message = r'^control of actuator "turn" is 90 in environment 1, and MuJoCo clips it to \[-1\.5, 1\.5\]'
    with pytest.warns(UserWarning, match=message) as caught:
        sim.step(control)
    assert caught[0].filename == __file__
    sim.step(torch.from_numpy(control))  # warnings are errors


@BOTH
def test_reset_of_faulty_environments_accepts_values(tmp_path, simulator):
    touch = module(tmp_path)
    sim = simulator(touch, 3, keyframe="home", on_fault="reset")
    sim.qvel[1, 0] = torch.nan
    with pytest.warns(UserWarning, match="1 diverged"):
        sim.step()
    sim.reset(sim.faults, qvel=np.zeros((3, 8)))
    assert sim.qvel[1].tolist() == [0.0] * 8 and sim.qvel[0].any() and not sim.faults.any()


def test_overflowing_pools_raise_for_any_on_fault(tmp_path):
    sim = warp(module(tmp_path), 2, njmax=5, on_fault="reset")
    with pytest.raises(SimulationError, match=r"^MuJoCo Warp: njmax=5 is too small in environments 0, 1"):
        sim.step()
    assert not sim.faults.any() and not sim.fault_counts.any()


@pytest.mark.parametrize("on_fault", ["raise", "note", "reset"])
def test_an_overflowing_search_is_a_fault_of_its_environment(tmp_path, on_fault):
    """Users cannot enlarge this buffer, and one environment in thousands must not stop the others."""
    sim = warp(module(tmp_path), 3, keyframe="home", on_fault=on_fault)
    sim.arrays["overflow"][1] = 1 << 8
    text = "the search for the deepest point of two convex shapes ran out of room"
    if on_fault == "raise":
        with pytest.raises(SimulationError, match=rf"^{text} in environments 1: contacts may be wrong; reset them to go on$"):
            sim.step()
    else:
        with pytest.warns(UserWarning, match=f"in 1 {text}; shown once"):
            sim.step()
    assert sim.faults.tolist() == [False, True, False] and sim.fault_counts.tolist() == [0, 1, 0]
    if on_fault != "reset":
        sim.reset(sim.faults)
    sim.step()
    assert not sim.faults.any() and sim.fault_counts.tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (BAD_CONTROL, "control is not finite in environments 1; reset them to go on"),
        (
            BAD_VALUES,
            "values given for the state of environments 1 are not finite, or hold a quaternion of length 0, and were left out; "
            "reset them to go on",
        ),
    ],
)
def test_faults_noted_on_the_gpu_are_named_later(tmp_path, kind, text):
    sim = warp(module(tmp_path), 3, keyframe="home")
    sim._faults.note(kind, torch.tensor([False, True, False]))
    with pytest.raises(SimulationError) as caught:
        sim.step()
    assert str(caught.value) == text


def test_values_that_the_gpu_finds_invalid_are_left_out(tmp_path):
    """The device decides without the host: valid rows are set, invalid ones are noted."""
    sim = warp(module(tmp_path), 4, keyframe="home")
    qpos = torch.from_numpy(np.tile(sim.model.qpos0, (4, 1)))
    qpos[0, 3:7], qpos[1, 0], qpos[3, 0] = 0.0, torch.nan, torch.nan
    table, mask, before = sim._table, torch.tensor([True, True, True, False]), sim.qpos.clone()
    values, unfinite, unturned = table._normalised("qpos", qpos)
    sim._put(mask, NewValues({"qpos": values.float()}, unfinite | unturned))
    assert torch.equal(sim.qpos[[0, 1, 3]], before[[0, 1, 3]])
    np.testing.assert_allclose(sim.qpos[2], sim.model.qpos0, atol=1e-7)
    assert sim.faults.tolist() == [True, True, False, False]


def test_an_unknown_on_fault_is_refused():
    with pytest.raises(SimulationError, match=r'^on_fault is "rest"; did you mean "reset"\?$'):
        EnvFaults(2, torch.device("cpu"), "rest")


def test_simulate_passes_on_fault_on(tmp_path):
    sim = tgdsl.simulate(module(tmp_path), 2, on_fault="reset")
    sim.qvel[0] = torch.nan
    with pytest.warns(UserWarning, match="1 diverged"):
        sim.step()
