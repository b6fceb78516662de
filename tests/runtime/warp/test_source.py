"""MuJoCo Warp as a source like any other: through `tgdsl.simulate`, substep by substep, in rollouts and pictures."""

import functools

import numpy as np
import pytest
import torch
from warp_cases import SCENE, module, warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.rollout import rollout
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.view.overview import overview
from tgdsl.view.picture import picture
from tgdsl.view.table import table

NOISE = {"white_noise": 5e-3, "hysteresis": {"strength": 0.5, "time_constant": 0.05}, "read_delay": "3 ms"}
PRESSED = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"')
CONTROL = np.array([0.3, -0.2])


# through `tgdsl.simulate`


def test_the_device_chooses_the_gpu_simulator(tmp_path, monkeypatch):
    touch, arguments = module(tmp_path), {}

    def record_arguments(self, touch, num_envs, **keys):
        arguments.update(keys, num_envs=num_envs)

    monkeypatch.setattr(WarpSimulation, "__init__", functools.wraps(WarpSimulation.__init__)(record_arguments))
    sim = tgdsl.simulate(touch, 7, device="cuda:1", substeps=5, keyframe="home", nconmax=20, njmax=90)
    assert isinstance(sim, WarpSimulation)
    keys = {"substeps": 5, "keyframe": "home", "nconmax": 20, "njmax": 90}
    assert arguments == {"num_envs": 7, "device": "cuda:1", **keys}
    assert isinstance(tgdsl.simulate(touch, 1, device="cpu"), BatchSimulation)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"device": "cpu", "nconmax": 8}, r'^"simulation", which simulates on "cpu", has no option nconmax; it knows substeps'),
        ({"njmax": 8}, r'^"simulation", which simulates on "cpu", has no option njmax'),
        ({"device": "cuda", "threads": 2}, r'^"warp", which simulates on "cuda", has no option threads; it knows substeps'),
        ({"device": "tpu"}, r'^there is no device "tpu" to run physics on; expected "cuda" or "cpu"$'),
    ],
)
def test_options_of_another_device_are_refused(tmp_path, keys, message):
    with pytest.raises(SimulationError, match=message):
        tgdsl.simulate(module(tmp_path), 1, **keys)


# substep by substep


def test_substates_equal_states_of_single_steps(tmp_path):
    coarse_touch, fine_touch = (module(tmp_path, PRESSED, noise=NOISE) for _ in range(2))
    coarse, fine = warp(coarse_touch, 2, substeps=3, keyframe="home"), warp(fine_touch, 2, keyframe="home")
    at_once = warp(module(tmp_path, PRESSED, noise=NOISE), 2, substeps=3, keyframe="home")
    for _ in range(3):
        states = list(coarse.substates(CONTROL))
        assert [state.dt for state in states] == pytest.approx([0.002] * 3)
        for state in states:
            fine.step(CONTROL)
            expected = fine.state()
            for name in coarse_touch.inputs.fields:
                assert torch.equal(torch.as_tensor(getattr(state, name)), torch.as_tensor(getattr(expected, name))), name
            assert torch.equal(coarse_touch(state)["touch"], fine_touch(expected)["touch"])
        at_once.step(CONTROL)
        for name in ("qpos", "qvel", "time", "ctrl"):
            assert torch.equal(at_once.arrays[name], coarse.arrays[name]), name
    assert coarse.state().dt == pytest.approx(0.006)


def test_stopping_early_takes_fewer_physics_steps(tmp_path):
    sim = warp(module(tmp_path), 2, substeps=4, keyframe="home")
    states = sim.substates(CONTROL)
    first = next(states)
    copy = first.body_pos.clone()
    next(states)
    assert torch.equal(first.body_pos, copy) and not torch.equal(copy, sim.state().body_pos)
    torch.testing.assert_close(sim.arrays["time"], torch.full((2,), 0.004))
    with pytest.raises(SimulationError, match=r"^control has shape \(3,\)"):
        next(sim.substates(np.zeros(3)))


# stepping and reading in one


@pytest.mark.parametrize("fields", [{"noise": NOISE}, {"history": 3}, {"noise": "noisy", "rate": "250 Hz"}])
def test_step_and_read_equals_step_then_read(tmp_path, fields):
    touch, other = (module(tmp_path, PRESSED, **fields) for _ in range(2))
    sim, twin = warp(touch, 2, keyframe="home"), warp(other, 2, keyframe="home")
    for i in range(4):
        readings = sim.step_and_read(CONTROL)
        twin.step(CONTROL)
        expected = other(twin.state())
        assert all(torch.equal(readings[name], value) for name, value in expected.items())
        if i == 1:
            sim.reset([1])
            twin.reset([1])


class Forgetful:
    """Stands in for a `GraphedCall`, and counts how often its graph is dropped."""

    def __init__(self, body):
        self.body, self.count = body, 0

    def forget(self):
        self.count += 1

    def __call__(self):
        return self.body()


def test_a_graph_is_captured_again_only_when_the_modules_tensors_change(tmp_path):
    touch = module(tmp_path, PRESSED, noise={"white_noise": 5e-3, "hysteresis": {"strength": 0.5, "time_constant": 0.05}})
    sim = warp(touch, 2, substeps=2)
    sim._step_and_read = replay = Forgetful(sim._physics_and_touch)

    def num_dropped() -> int:
        before = replay.count
        sim.step_and_read()
        return replay.count - before

    num_dropped()  # this call creates the module's memory and `dt`
    assert [num_dropped() for _ in range(3)] == [1, 0, 0]
    sim.reset([0])
    touch(sim.state())
    sim.step()
    assert num_dropped() == 0
    for state in sim.substates():
        touch(state)  # another dt
    assert [num_dropped() for _ in range(3)] == [1, 1, 0]
    touch.seed(3)  # written in place: the graph stays valid
    assert [num_dropped() for _ in range(2)] == [0, 0]
    touch.free()
    assert [num_dropped() for _ in range(3)] == [1, 1, 0]
    touch.double()
    assert num_dropped() == 1


def test_step_and_read_works_under_inference_mode(tmp_path):
    """As in rollouts of reinforcement learning: outside that mode, inference tensors refuse in-place changes."""
    touch, other = (module(tmp_path, PRESSED, noise=NOISE) for _ in range(2))
    sim, twin = warp(touch, 2), warp(other, 2)
    with torch.inference_mode():
        for _ in range(2):
            inside = sim.step_and_read(torch.zeros(2))["touch"]
        sim.reset(torch.tensor([False, True]))
        sim.step(torch.zeros(2, 2))
        touch(sim.state())
    for _ in range(2):
        outside = twin.step_and_read(torch.zeros(2))["touch"]
    assert torch.equal(inside, outside)
    sim.step()


# rollouts and pictures


@pytest.mark.slow
def test_rollouts_tables_and_pictures_work_with_warp(tmp_path):
    touch = module(tmp_path, PRESSED)
    sims = warp(touch, 2, keyframe="home"), BatchSimulation(touch, 2, keyframe="home")
    controls = np.tile(CONTROL, (5, 1))
    steps = [list(rollout(touch, sim, controls))[-1] for sim in sims]
    assert steps[0].time == pytest.approx(steps[1].time)
    torch.testing.assert_close(steps[0].readings["touch"], steps[1].readings["touch"], atol=1e-4, rtol=0)
    assert table(touch, steps[0].readings)[2].startswith("table")
    for draw in (picture, overview):
        assert draw(touch, sims[0], steps[0].readings, tmp_path / "one.png", env=1).stat().st_size > 10_000


def test_body_poses_match_the_cpu(tmp_path):
    touch = module(tmp_path)
    sims = warp(touch, 2, keyframe="home"), BatchSimulation(touch, 2, keyframe="home")
    for _ in range(2):
        for poses, expected in zip(sims[0].body_poses(1), sims[1].body_poses(1), strict=True):
            np.testing.assert_allclose(poses, expected, atol=1e-6)
        for sim in sims:
            sim.step()
    sims[0].reset([1])
    assert np.abs(sims[0].body_poses(1)[0][-1] - warp(touch, 1, keyframe="home").body_poses(0)[0][-1]).max() < 1e-7


def test_env_model_has_the_environments_variant(tmp_path):
    variants = [{"type": "box", "size": [0.02, 0.02, 0.02]}, {"type": "sphere", "size": [0.015]}]
    touch = module(tmp_path, links=("table",), target={"variants": variants})
    sims = warp(touch, 3), BatchSimulation(touch, 3)
    for sim in sims:
        sim.set_objects({"cube": [1, 0]}, env_ids=[2, 1])  # in any order
    for env, number in enumerate((0, 0, 1)):
        models = [sim.env_model(env) for sim in sims]
        np.testing.assert_array_equal(models[0].geom_rgba, models[1].geom_rgba)
        for i in range(2):
            assert (models[0].geom(f"tgdsl/cube/{i}").rgba[3] > 0) == (number == i)
        assert [int(sim.state().variant[env, 0]) for sim in sims] == [number, number]
