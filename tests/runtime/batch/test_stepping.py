"""The MuJoCo batch: environments step and reset independently; invalid arguments are refused."""

import mujoco
import numpy as np
import pytest
import torch
from batch_cases import ARM, PAD, arm, module, scene, value, wanting

from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.connect import simulate

# stepping and resetting


def test_environments_match_single_simulations(tmp_path):
    path = scene(tmp_path, ARM.format(pad="box", item="box"))
    touch, model = wanting(module(path, ("item",)), path)
    controls = np.random.default_rng(1).normal(size=(6, 5, model.nu))
    many = BatchSimulation(touch, 5, model=model, substeps=3, keyframe="home")
    for control in controls:
        many.step(control)
    state = many.state()
    for env in range(5):
        one = BatchSimulation(touch, 1, model=model, substeps=3, keyframe="home", threads=1)
        for control in controls:
            one.step(control[env])
        for name in touch.inputs.fields:
            np.testing.assert_array_equal(value(state, name)[env], value(one.state(), name)[0], err_msg=name)


@pytest.mark.parametrize(
    "ids", [[1, 3], torch.tensor([1, 3]), np.array([1, 3]), [False, True, False, True], torch.tensor([0, 1, 0, 1]).bool()]
)
def test_reset_restarts_the_chosen_environments_and_no_others(tmp_path, ids):
    path = scene(tmp_path, ARM.format(pad="box", item="sphere"))
    touch, model = wanting(module(path, ("item",)), path)
    sim = BatchSimulation(touch, 4, model=model, keyframe="home")
    start = sim.state()
    for _ in range(10):
        sim.step(np.array([0.2, -0.3]))
    before, qpos = sim.state(), sim.batch.qpos.copy()
    sim.reset(ids)
    after = sim.state()
    for name in touch.inputs.fields:
        np.testing.assert_array_equal(value(after, name)[[0, 2]], value(before, name)[[0, 2]], err_msg=name)
        np.testing.assert_array_equal(value(after, name)[[1, 3]], value(start, name)[[1, 3]], err_msg=name)
    np.testing.assert_array_equal(sim.batch.qpos[[0, 2]], qpos[[0, 2]])
    np.testing.assert_array_equal(sim.batch.ctrl[[1, 3]], 0)
    sim.step()  # the reset ones go on like new ones
    fresh = BatchSimulation(touch, 1, model=model, keyframe="home")
    fresh.step()
    np.testing.assert_array_equal(sim.batch.qpos[1], fresh.batch.qpos[0])


@pytest.mark.parametrize("ids", [[3, 1], torch.tensor([3, 1, 3]), np.array([3, 1])])
def test_the_order_of_reset_environments_does_not_matter(tmp_path, ids):
    touch, _ = arm(tmp_path)
    sims = [BatchSimulation(touch, 4, keyframe="home") for _ in range(2)]
    for sim, chosen in zip(sims, (ids, [1, 3]), strict=True):
        for _ in range(3):
            sim.step(np.array([0.2, -0.3]))
        sim.reset(chosen)
    for name in ("qpos", "qvel", "ctrl", "time"):
        np.testing.assert_array_equal(getattr(sims[0].batch, name), getattr(sims[1].batch, name), err_msg=name)


@pytest.mark.parametrize("ids", [[], torch.zeros(0, dtype=torch.long), np.zeros(3, dtype=bool)])
def test_reset_of_none_does_nothing(tmp_path, ids):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    sim.step()
    before = sim.batch.qpos.copy()
    sim.reset(ids)
    np.testing.assert_array_equal(sim.batch.qpos, before)


@pytest.mark.parametrize("ids", [[3], [-1], [True, False], np.array([0.5])])
def test_reset_of_unknown_environments_is_refused(tmp_path, ids):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    with pytest.raises(SimulationError, match=r"^env_ids: found .*, expected indices from 0 to 2, or a mask of 3$"):
        sim.reset(ids)


def test_reset_reaches_the_module(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .0295'"))
    touch = module(path, kind="contact", threshold=1e-3, release_threshold=5e-4)
    sim = simulate(touch, 3)
    assert touch(sim.state())["touch"].all()
    sim.reset([1])
    bits = touch.memory.get_buffer("touch:bit")
    assert bits[:, 0].tolist() == [1, 0, 1]
    sim.reset()
    assert not bits.any()


def test_environments_start_at_the_keyframe(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 2, keyframe="far")
    np.testing.assert_array_equal(sim.batch.qpos[1], sim.model.key("far").qpos)
    np.testing.assert_array_equal(sim.batch.ctrl, [[0.1, -0.1]] * 2)
    np.testing.assert_allclose(value(sim.state(), "body_pos")[:, touch.inputs.bodies.index("item")], [[3, 0, 0]] * 2)
    plain = BatchSimulation(touch, 1)
    np.testing.assert_array_equal(plain.batch.qpos[0], plain.model.qpos0)
    with pytest.raises(SimulationError) as caught:
        simulate(touch, 1, keyframe="hme")
    assert str(caught.value) == 'the scene has no keyframe "hme"; did you mean "home"?'


def test_controls_are_broadcast_and_kept(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, substeps=2, keyframe="home")
    assert sim.control_step == pytest.approx(0.004)
    sim.step(np.array([0.1, 0.2]))
    np.testing.assert_array_equal(sim.batch.ctrl, [[0.1, 0.2]] * 3)
    sim.step(torch.arange(6, dtype=torch.float32, requires_grad=True).reshape(3, 2))
    np.testing.assert_array_equal(sim.batch.ctrl, [[0, 1], [2, 3], [4, 5]])
    sim.step()
    np.testing.assert_array_equal(sim.batch.ctrl, [[0, 1], [2, 3], [4, 5]])
    np.testing.assert_allclose(sim.batch.time, 3 * 0.004)


def test_invalid_controls_take_no_step(tmp_path):
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    before = sim.batch.qpos.copy()
    for control in (np.zeros(3), np.zeros((2, 2)), np.zeros((3, 1)), np.zeros((1, 3, 2)), 1.0):
        with pytest.raises(SimulationError) as caught:
            sim.step(np.asarray(control))
        assert str(caught.value) == f"control has shape {np.shape(control)}, expected (3, 2) or (2,)"
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 0, 2$"):
        sim.step(torch.tensor([[0.0, torch.nan], [1, 1], [torch.inf, 0]]))
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 0$"):
        sim.step(np.array([np.nan, 0.0]))
    np.testing.assert_array_equal(sim.batch.qpos, before)
    assert not sim.batch.ctrl.any()


def test_a_diverging_environment_is_reported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the current folder
    touch, _ = arm(tmp_path)
    sim = BatchSimulation(touch, 3, keyframe="home")
    sim.batch.qvel[1, 0] = np.nan
    with pytest.raises(SimulationError) as caught:
        sim.step()
    assert str(caught.value) == "environments 1 diverged, and MuJoCo has restarted them; reset them to go on"
    sim.reset([1])
    sim.step()
    np.testing.assert_allclose(sim.batch.time, [0.004, 0.002, 0.004])
    assert np.isfinite(sim.batch.qpos).all()


# scenes that lack something


def test_a_users_model_needs_the_contact_sensors(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch = module(path)
    with pytest.raises(SimulationError) as caught:
        BatchSimulation(touch, 1, model=mujoco.MjModel.from_xml_path(str(path)))
    assert str(caught.value) == (
        'the scene has no contact sensor "tgdsl/contact/pad/cube", which the module wants; '
        "add them with tgdsl.instrument(spec, touch.inputs) before compiling"
    )


def test_a_users_model_needs_the_bodies(tmp_path):
    path = scene(tmp_path, PAD.format(mount="", place="pos='0 0 .03'"))
    touch = module(path)
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='cub'/></worldbody></mujoco>")
    with pytest.raises(SimulationError) as caught:
        BatchSimulation(touch, 1, model=other)
    assert str(caught.value) == 'the scene has no body "cube"; did you mean "cub"?'


@pytest.mark.parametrize("keys", [{"num_envs": 0}, {"num_envs": "2"}, {"num_envs": 1, "substeps": 0}])
def test_numbers_of_environments_and_substeps_are_checked(tmp_path, keys):
    touch, _ = arm(tmp_path)
    name, value = list(keys.items())[-1]
    with pytest.raises(SimulationError, match=f"^{name} is {value!r}, expected a whole number of at least 1$"):
        simulate(touch, **keys)


def test_rk4_is_refused_because_its_poses_and_contacts_are_of_two_instants(tmp_path):
    text = PAD.format(mount="", place="pos='0 0 .03'").replace("<option ", "<option integrator='RK4' ")
    touch = module(scene(tmp_path, text))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    data.qvel[0] = 1
    mujoco.mj_step(model, data)
    assert data.body("cube").xpos[0] > 1e-3  # not where the contacts were found
    with pytest.raises(SimulationError, match=r"^with the integrator RK4 MuJoCo's poses and contacts are of two instants"):
        simulate(touch, 1)


def test_an_error_about_a_missing_body_lists_the_bodies(tmp_path):
    touch, _ = arm(tmp_path)
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='zzz'/></worldbody></mujoco>")
    with pytest.raises(SimulationError, match=r'^the scene has no body "arm"; known bodies: world, zzz$'):
        BatchSimulation(touch, 1, model=other)
