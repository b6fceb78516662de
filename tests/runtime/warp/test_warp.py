"""MuJoCo Warp on its CPU device against MuJoCo's batch on the same states, and against Newton.

One side is float32, the other float64: poses and velocities agree to a few roundings. Forces depend on a solver and on depths
of a few micrometres at positions of a few centimetres: at rest they agree equally well, in motion less.
"""

import copy
import gc
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import (
    MOVING_FORCE,
    SCENE,
    TOLERANCE,
    WEIGHT,
    assert_agree,
    hand_over,
    module,
    pushed,
    wanting_contacts,
    warp,
)

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.runtime.warp.simulation import constraint_rows
from tgdsl.runtime.warp.stream import GraphedCall, WarpStream, no_collection


class PretendedGpu(WarpStream):
    """A capturing stream whose replays are counted and do nothing."""

    def __init__(self):
        super().__init__("cpu")
        self.is_captured, self.captures, self.replays = True, 0, 0

    def capture(self, body):
        self.captures += 1
        return None, body()

    def replay(self, graph):
        self.replays += 1


# readings as on the CPU


@pytest.mark.slow
def test_states_and_readings_match_the_cpu(tmp_path):
    touch, model = wanting_contacts(tmp_path)
    sim, cpu = warp(touch, 6, model=model, keyframe="home"), BatchSimulation(touch, 6, model=model, keyframe="home")
    assert_agree(sim.state(), cpu.state(), touch.inputs.fields)
    sim.warp_model.opt.tolerance.fill_(model.opt.tolerance)  # mujoco_warp's own is 100 times MuJoCo's
    pushed(sim, 0)
    num_active = 0
    for i in range(20):
        hand_over(sim, cpu)
        control = np.random.default_rng(i).normal(size=(6, 2))
        sim.step(control)
        cpu.step(control)
        state, cpu_state = sim.state(), cpu.state()
        assert_agree(state, cpu_state, touch.inputs.fields, MOVING_FORCE)
        readings, expected = touch(state)["touch"], touch(cpu_state)["touch"]
        scale = expected.abs().amax((0, 1)) + 1e-12
        assert ((readings - expected).abs().amax((0, 1)) <= TOLERANCE * scale).all()
        num_active += int((expected != 0).any())
    assert num_active > 10


def test_poses_and_contacts_belong_to_the_start_of_the_last_substep(tmp_path):
    touch, model = wanting_contacts(tmp_path)
    keys = {"model": model, "keyframe": "home", "substeps": 4}
    sim, cpu = warp(touch, 2, **keys), BatchSimulation(touch, 2, **keys)
    sim.warp_model.opt.tolerance.fill_(model.opt.tolerance)
    sim.step()
    cpu.step()
    state, cube = sim.state(), touch.inputs.bodies.index("cube")
    assert_agree(state, cpu.state(), touch.inputs.fields, MOVING_FORCE)
    assert (sim.arrays["qpos"][:, :3] - state.body_pos[:, cube]).abs().max() > 1e-4  # `qpos` is one substep further
    assert sim.control_step == pytest.approx(0.008)


@pytest.mark.parametrize(
    ("sensor", "times"), [("", 0), ('<jointpos joint="one"/>', 1), ('<jointpos joint="one" nsample="2" delay=".002"/>', 4)]
)
def test_sensors_are_evaluated_only_when_read(tmp_path, monkeypatch, sensor, times):
    """Sensors are evaluated at the last substep; one with a history needs every substep, tgdsl's need none."""
    touch = module(tmp_path)
    spec = mujoco.MjSpec.from_string(SCENE.replace("</mujoco>", f"<sensor>{sensor}</sensor></mujoco>"))
    tgdsl.instrument(spec, touch.inputs)
    sim = warp(touch, 2, model=spec.compile(), keyframe="home", substeps=4)
    plain_step, flags = sim._mjw.step, []

    def step(model, data):
        flags.append(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SENSOR))
        plain_step(model, data)

    monkeypatch.setattr(sim._mjw, "step", step)
    sim.step()
    assert [bool(flag) for flag in flags] == [times < 4] * 3 + [times < 1]
    assert bool(sim.warp_model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SENSOR)) == (times < 1)
    assert (sim.state().contact_found > 0).any()


@pytest.mark.slow
def test_a_resting_cube_presses_with_its_weight(tmp_path):
    touch, model = wanting_contacts(tmp_path)
    sim = warp(touch, 2, model=model, substeps=300)
    sim.step()
    state = sim.state()
    pair = [(pair.link, pair.object) for pair in touch.inputs.pairs].index(("table", "cube"))
    expected = torch.tensor([0, 0, -WEIGHT]).expand(2, 3)
    torch.testing.assert_close(state.contact_netforce[:, pair], expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(state.contact_force[:, pair].sum(dim=1), expected, atol=1e-4, rtol=0)
    assert state.contact_netforce.dtype == torch.float32


def test_step_and_read_equals_step_then_read(tmp_path):
    text = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"')
    modules = [module(tmp_path, text, kind="contact", threshold=1e-3, release_threshold=5e-4) for _ in range(2)]
    sim, twin = (warp(touch, 2, substeps=2) for touch in modules)
    contacts = []
    for _ in range(3):
        readings = sim.step_and_read(np.array([0.3, -0.2]))
        twin.step(np.array([0.3, -0.2]))
        torch.testing.assert_close(readings["touch"], modules[1](twin.state())["touch"], atol=0, rtol=0)
        contacts.append(bool(readings["touch"].any()))
    assert contacts[0]


def test_a_call_is_captured_the_third_time_and_then_replayed():
    stream, calls = PretendedGpu(), []
    replay = GraphedCall(stream, lambda: calls.append(0) or len(calls))
    assert [replay() for _ in range(5)] == [1, 2, 3, 3, 3]
    assert (stream.captures, stream.replays) == (1, 3)
    replay.forget()
    assert [replay() for _ in range(3)] == [4, 5, 6]
    assert (stream.captures, stream.replays) == (2, 4)


def test_no_garbage_is_collected_while_a_call_is_captured():
    """Else an array of Warp's that is freed by chance would break the capture."""
    with no_collection():
        assert not gc.isenabled()
    assert gc.isenabled()


@pytest.mark.slow
def test_a_cube_at_rest_and_squeezed_matches_the_cpu():
    """100 control steps, 500 physics steps, in float32 and in float64."""
    touch = tgdsl.compile(Path(__file__).parents[3] / "examples" / "xhand1_palm.yaml")
    keys = {"substeps": 5, "keyframe": "rest"}
    modules = touch, copy.deepcopy(touch)
    sims = warp(modules[0], 4, **keys), BatchSimulation(modules[1], 4, **keys)
    rest, squeeze = (sims[0].model.key(name).ctrl for name in ("rest", "squeeze"))
    strength, cube = np.array([[0.0], [0.8], [1.0], [1.1]]), touch.inputs.bodies.index("cube")
    forces, heights = ([[], []] for _ in range(2))
    for i in range(100):
        for which, sim in enumerate(sims):
            sim.step(rest + (squeeze - rest) * strength * min(1.0, i / 50))
            if i >= 75:
                state = sim.state()
                forces[which].append(modules[which](state)["touch"][..., :3].norm(dim=-1).sum(dim=1))
                heights[which].append(state.body_pos[:, cube, 2].double())
    force, expected = (torch.stack(series).mean(dim=0) for series in forces)
    assert expected.min() > 5 and (expected[1:] - expected[0]).abs().max() > 0.5
    torch.testing.assert_close(force, expected, rtol=0.01, atol=0)
    torch.testing.assert_close(torch.stack(heights[0]).mean(0), torch.stack(heights[1]).mean(0), rtol=0, atol=1e-4)


# resetting


def test_reset_restarts_the_chosen_environments_and_no_others(tmp_path):
    touch, model = wanting_contacts(tmp_path)
    sims = [warp(touch, 4, model=model, keyframe="home") for _ in range(2)]
    start = sims[0].state()
    for sim in sims:
        pushed(sim, 1)
        for _ in range(5):
            sim.step(np.array([0.2, -0.3]))
    before = sims[0].state()
    sims[0].reset(torch.tensor([False, True, False, True]))
    after = sims[0].state()
    for name in touch.inputs.fields:
        value = getattr(after, name)
        torch.testing.assert_close(value[[0, 2]], getattr(before, name)[[0, 2]], atol=0, rtol=0, msg=name)
        torch.testing.assert_close(value[[1, 3]], getattr(start, name)[[1, 3]], atol=1e-6, rtol=1e-6, msg=name)
    assert (before.body_pos - start.body_pos).abs().amax(dim=(1, 2)).min() > 1e-3
    torch.testing.assert_close(sims[0].arrays["ctrl"][1], torch.tensor([0.1, -0.1]))
    for sim in sims:
        sim.step()
    for name in ("qpos", "qvel"):  # the others go on as without a reset
        torch.testing.assert_close(sims[0].arrays[name][[0, 2]], sims[1].arrays[name][[0, 2]], atol=0, rtol=0)


def test_reset_reaches_the_module_for_the_chosen_environments(tmp_path):
    text = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"')
    touch = module(tmp_path, text, links=("table",), kind="contact", threshold=1e-3, release_threshold=5e-4)
    sim = warp(touch, 3)
    assert touch(sim.state())["touch"].all()
    sim.reset([1])
    bits = touch.memory.get_buffer("touch:bit")
    assert bits[:, 0].tolist() == [1, 0, 1]
    sim.reset(np.zeros(3, dtype=bool))
    sim.reset([])
    assert bits[:, 0].tolist() == [1, 0, 1]
    sim.reset()
    assert not bits.any()
    for ids in ([3], [-1], [True, False], np.array([0.5])):
        with pytest.raises(SimulationError, match=r"^env_ids: found .*, expected indices from 0 to 2, or a mask of 3$"):
            sim.reset(ids)


# errors


def test_a_pool_that_is_too_small_is_named(tmp_path):
    touch = module(tmp_path)
    with pytest.raises(SimulationError, match=r"^MuJoCo Warp: nconmax=1 is too small: .* num_envs is 2$"):
        warp(touch, 2, nconmax=1, njmax=64).step()
    sim = warp(touch, 2, njmax=5)
    with pytest.raises(SimulationError) as caught:
        sim.step()
    assert str(caught.value) == (
        "MuJoCo Warp: njmax=5 is too small in environments 0, 1: constraints are left out, 12 were wanted last"
    )
    with pytest.raises(SimulationError, match=r"^MuJoCo Warp: njmax=5"):
        sim.check()
    sim.arrays["qpos"][0, 2] = 1.0
    sim.reset([1])
    with pytest.raises(SimulationError, match=r"^MuJoCo Warp: njmax=5 is too small in environments 0: "):
        sim.check()
    sim.reset()
    sim.arrays["qpos"][:, 2] = 1.0
    sim.step()
    sim.check()


def test_the_default_has_room_for_all_contacts(tmp_path):
    touch = module(tmp_path)
    sim = warp(touch, 2)
    assert constraint_rows(sim.model, 4) == 4 * 3  # elliptic: one row per dimension
    data = mujoco.MjData(sim.model)
    mujoco.mj_forward(sim.model, data)
    assert (data.ncon, data.nefc) == (4, constraint_rows(sim.model, 4))
    assert sim.warp_data.njmax == constraint_rows(sim.model, 48)


def test_a_diverging_environment_is_reported(tmp_path):
    touch = module(tmp_path)
    sim, twin = warp(touch, 3, keyframe="home"), warp(touch, 3, keyframe="home")
    sim.arrays["qvel"][1, 0] = torch.nan
    with pytest.raises(SimulationError) as caught:
        sim.step()
    assert str(caught.value) == "environments 1 diverged; reset them to go on"
    sim.reset([1])
    sim.step()
    assert torch.isfinite(sim.arrays["qpos"]).all() and torch.isfinite(sim.state().body_linvel).all()
    twin.step()
    torch.testing.assert_close(sim.arrays["qpos"][1], twin.arrays["qpos"][1], atol=0, rtol=0)
    twin.step()
    torch.testing.assert_close(sim.arrays["qpos"][[0, 2]], twin.arrays["qpos"][[0, 2]], atol=0, rtol=0)


def test_controls_are_checked_broadcast_and_kept(tmp_path):
    sim = warp(module(tmp_path), 3, keyframe="home")
    before = sim.arrays["qpos"].clone()
    for control in (np.zeros(3), np.zeros((2, 2)), np.zeros((3, 1)), np.zeros((1, 3, 2)), np.asarray(1.0)):
        with pytest.raises(SimulationError) as caught:
            sim.step(control)
        assert str(caught.value) == f"control has shape {np.shape(control)}, expected (3, 2) or (2,)"
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 0, 2$"):
        sim.step(torch.tensor([[0.0, torch.nan], [1, 1], [torch.inf, 0]]))
    torch.testing.assert_close(sim.arrays["qpos"], before, atol=0, rtol=0)
    sim.step(np.array([0.1, 0.2]))
    torch.testing.assert_close(sim.arrays["ctrl"], torch.tensor([[0.1, 0.2]] * 3))
    sim.step(torch.arange(6, dtype=torch.float32, requires_grad=True).reshape(3, 2))
    sim.step()
    assert sim.arrays["ctrl"].tolist() == [[0, 1], [2, 3], [4, 5]]
    torch.testing.assert_close(sim.arrays["time"], torch.full((3,), 3 * 0.002))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"keyframe": "hme"}, r'^the scene has no keyframe "hme"; did you mean "home"\?$'),
        ({"substeps": 0}, r"^substeps is 0, expected a whole number of at least 1$"),
        ({"per_env": ["geom_type"]}, r"^MuJoCo Warp: Model field 'geom_type' is not a batched array field\.$"),
        ({"device": "gpu"}, r'^there is no device "gpu" to run physics on; did you mean "cuda"\?$'),
        ({"device": "meta"}, r'^physics on "meta" is not supported, expected "cuda" or "cpu"$'),
    ],
)
def test_invalid_options_are_named(tmp_path, keys, message):
    with pytest.raises(SimulationError, match=message):
        WarpSimulation(module(tmp_path), 2, **{"device": "cpu", **keys})


def test_a_users_model_needs_the_modules_bodies(tmp_path):
    touch = module(tmp_path)
    sims = warp(touch, 1), warp(touch, 1, model=mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")))
    assert (sims[0].model.nsensor, sims[1].model.nsensor) == (2, 0)
    for name in touch.inputs.fields:
        assert torch.equal(*(getattr(sim.state(), name) for sim in sims))
    with pytest.raises(SimulationError, match=r'^the scene has no body "cube"; did you mean "cub"\?$'):
        warp(touch, 1, model=mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='cub'/></worldbody></mujoco>"))
    with pytest.raises(SimulationError, match=r"^no object of this module differs between environments$"):
        warp(touch, 1).set_objects({"cube": 0})


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ('<option integrator="RK4"/>', r"^with the integrator RK4 MuJoCo's poses and contacts are of two instants"),
        ('<option><flag sleep="enable"/></option>', r"^bodies that sleep are not supported"),
    ],
)
def test_options_that_mix_instants_are_refused(tmp_path, option, message):
    touch = module(tmp_path, SCENE.replace("<worldbody>", option + "<worldbody>").replace(' integrator="implicitfast"', ""))
    with pytest.raises(SimulationError, match=message):
        warp(touch, 1)


def test_without_mujoco_warp_the_extra_is_named(tmp_path, monkeypatch):
    touch = module(tmp_path)
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(SimulationError, match=r'^physics on a GPU needs MuJoCo Warp: pip install "tgdsl\[gpu\]"$'):
        warp(touch, 1)
