"""Joints and controls of a state, at the instant of its poses, against MuJoCo's functions on both simulators.

The oracle is `mj_forward` on one `MjData` with the state's joints: poses, velocities and actuator forces must follow.
"""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from joint_scenes import ACTUATED, ACTUATORS, ALL, OBJECT, SCENE_XML, joint_document, joint_module

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.rollout import Recorder, rollout
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.view.overview import drawing
from tgdsl.view.table import table

TERMS = {"policy": [*ALL, {"type": "joint_pos", "joints": ["passive"]}]}
JOINTS = (*ACTUATED, "passive")
TOLERANCE = {BatchSimulation: 1e-12, WarpSimulation: 2e-5}
"""float64 with the same functions; float32, relative to the largest number."""


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    return joint_module(tmp_path_factory.mktemp("joints"), TERMS, torch.float32)


def simulation(kind, touch, num_envs, **options):
    if kind is WarpSimulation:
        return WarpSimulation(touch, num_envs, device="cpu", keyframe="home", **options)
    return BatchSimulation(touch, num_envs, keyframe="home", **options)


def data_after(controls, substeps):
    """Return MuJoCo's data after control steps, with the poses at the start of the last physics step."""
    model = mujoco.MjModel.from_xml_string(SCENE_XML)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    before = (data.qpos.copy(), data.qvel.copy(), data.ctrl.copy())
    for control in controls:
        data.ctrl[:] = control
        for _ in range(substeps):
            before = (data.qpos.copy(), data.qvel.copy(), data.ctrl.copy())
            mujoco.mj_step(model, data)
    return model, data, before


def expected_fields(model, data, before):
    qpos, qvel, ctrl = before
    joints = [model.joint(name).id for name in JOINTS]
    dofs = model.jnt_dofadr[joints]
    actuators = [model.actuator(name).id for name in ACTUATORS]
    return {
        "joint_pos": qpos[model.jnt_qposadr[joints]],
        "joint_vel": qvel[dofs],
        "joint_effort": data.qfrc_actuator[dofs],
        "last_action": ctrl[actuators],
    }


def assert_fields(state, env, expected, tolerance):
    for name, values in expected.items():
        array = getattr(state, name)[env].double().numpy()
        np.testing.assert_allclose(array, values, rtol=0, atol=tolerance * max(1.0, np.abs(values).max()), err_msg=name)


CONTROLS = np.random.default_rng(0).normal(scale=0.2, size=(5, 4))


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
@pytest.mark.parametrize("substeps", [1, 4])
def test_joints_match_mujoco_at_the_instant_of_the_poses(touch, kind, substeps):
    sim = simulation(kind, touch, 2, substeps=substeps)
    assert_fields(sim.state(), 0, expected_fields(*data_after([], substeps)), TOLERANCE[kind])
    for control in CONTROLS:
        sim.step(control)
    assert_fields(sim.state(), 1, expected_fields(*data_after(CONTROLS, substeps)), TOLERANCE[kind])
    assert touch.inputs.joints == JOINTS


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_poses_and_forces_follow_from_the_states_joints(touch, kind):
    """The state's joints give its poses; `qpos`, a substep later, does not."""
    sim = simulation(kind, touch, 1, substeps=3)
    for control in CONTROLS:
        sim.step(control)
    state = sim.state()
    model = mujoco.MjModel.from_xml_string(SCENE_XML)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    qpos = sim.batch.qpos if kind is BatchSimulation else sim.arrays["qpos"].numpy()

    def tip_pos(joints):
        for name, value in zip(JOINTS, joints, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = value
        mujoco.mj_forward(model, data)
        return data.body("tip").xpos

    tip = state.body_pos[0, touch.inputs.bodies.index("tip")].double().numpy()
    np.testing.assert_allclose(tip_pos(state.joint_pos[0].double().numpy()), tip, atol=TOLERANCE[kind])
    later = [qpos[0, model.joint(name).qposadr[0]] for name in JOINTS]
    assert np.abs(tip_pos(later) - tip).max() > 1e-4


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_reset_restores_the_chosen_environments_and_no_others(touch, kind):
    sim = simulation(kind, touch, 3, substeps=2)
    for control in CONTROLS:
        sim.step(control)
    moving, start = expected_fields(*data_after(CONTROLS, 2)), expected_fields(*data_after([], 2))
    sim.reset([1])
    state = sim.state()
    for env, expected in enumerate([moving, start, moving]):
        assert_fields(state, env, expected, TOLERANCE[kind])
    sim.step(CONTROLS[0])
    assert_fields(sim.state(), 1, expected_fields(*data_after(CONTROLS[:1], 2)), TOLERANCE[kind])


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_every_substep_has_its_joints(touch, kind):
    sim = simulation(kind, touch, 1, substeps=3)
    for i, state in enumerate(sim.substates(CONTROLS[0])):
        assert_fields(state, 0, expected_fields(*data_after([CONTROLS[0]], i + 1)), TOLERANCE[kind])


def test_reading_joints_does_not_change_the_physics(tmp_path, touch):
    """A control step is split in two to store the joints between them; it stays bit-identical."""
    plain = joint_module(tmp_path, {"policy": [{"type": "joint_effort"}]})
    sims = [BatchSimulation(module, 2, substeps=5, keyframe="home") for module in (touch, plain)]
    for control in CONTROLS:
        for sim in sims:
            sim.step(control)
    for name in ("qpos", "qvel", "xpos", "cvel", "sensordata"):
        assert (getattr(sims[0].batch, name) == getattr(sims[1].batch, name)).all()


def test_both_simulators_agree_through_the_module(touch):
    """From controls to the policy's group, with `step_and_read`; later steps leave earlier states unchanged."""
    sim, cpu = (simulation(kind, touch, 2, substeps=2) for kind in (WarpSimulation, BatchSimulation))
    start_state = sim.state()
    first = start_state.joint_pos.clone()
    for control in CONTROLS:
        readings = sim.step_and_read(control)
        cpu.step(control)
    expected = touch(cpu.state())
    for name in ("joint_pos", "joint_vel", "joint_effort", "last_action"):
        torch.testing.assert_close(readings[name], expected[name], rtol=1e-4, atol=1e-5)
    assert (start_state.joint_pos == first).all()
    torch.testing.assert_close(touch.observe(readings)["policy"], touch.observe(expected)["policy"], rtol=1e-4, atol=1e-5)


def test_readings_are_copies(touch):
    sim = BatchSimulation(touch, 1, keyframe="home")
    sim.step(CONTROLS[0])
    state, readings = sim.state(), touch(sim.state())
    before = readings["joint_pos"].clone(), state.last_action.clone()
    sim.step(CONTROLS[1])
    assert (readings["joint_pos"] == before[0]).all() and (state.last_action == before[1]).all()


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="passive"', 'name="pasive"', 'the scene has no joint "passive"; did you mean "pasive"'),
        ('name="raise"', 'name="rise"', 'the scene has no actuator "raise"; did you mean "rise"'),
        ('<joint name="passive" axis="1 0 0"', '<joint name="passive" type="ball"', 'joint "passive" is a ball or free joint'),
    ],
)
def test_a_users_model_must_have_the_joints_and_actuators(touch, kind, old, new, message):
    xml = SCENE_XML.replace(old, new)
    spec = mujoco.MjSpec.from_string(xml[: xml.index("<keyframe>")] + "</mujoco>")
    model = tgdsl.instrument(spec, touch.inputs).compile()
    with pytest.raises(SimulationError, match=message):
        BatchSimulation(touch, 1, model=model) if kind is BatchSimulation else WarpSimulation(
            touch, 1, model=model, device="cpu"
        )


def test_tables_and_pictures_show_links_only(touch, tmp_path):
    """Joints are on no link: a rollout records them, and nothing draws them."""
    sim = BatchSimulation(touch, 1, keyframe="home")
    recorder = Recorder(touch, 2, 1)
    for step in rollout(touch, sim, CONTROLS[:2]):
        recorder.add(step)
        readings = step.readings
    lines = table(touch, readings)
    assert "dist" in lines[0] and "joint_pos" not in lines[0] and len(lines) == 4
    assert [axes.get_title(loc="left") for axes in drawing(touch, sim, readings).axes] == ["dist  ·  surface_distance"]
    recorder.write(tmp_path / "readings.npz", CONTROLS[:2], Path("scene.yaml"), ["a", "b"])
    with np.load(tmp_path / "readings.npz") as archive:
        assert (archive["joint_vel"][1, 0, :, 0] == readings["joint_vel"][0, :, 0].numpy()).all()
        assert archive["last_action:units"].tolist() == ["control"]


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_environments_with_other_objects_keep_the_robots_joints(tmp_path, kind):
    """Environments that get another object restart at the keyframe's joints; the others stay."""
    document = joint_document(tmp_path, TERMS)
    text = (tmp_path / "robot.xml").read_text().replace("</worldbody>", f"{OBJECT}</worldbody>")
    (tmp_path / "scene.xml").write_text(re.sub('<joint name="spin"[^>]*>', "", text))
    size = {"type": "box", "size": [0.02, 0.02, 0.02]}
    document["objects"]["item"]["variants"] = [size, {"type": "sphere", "size": [0.02]}]
    sim = simulation(kind, touch := tgdsl.compile(document), 3, substeps=2)
    for control in CONTROLS:
        sim.step(np.delete(control, 1))  # without the object's control, which does not move the robot
    sim.set_objects(variants={"item": 1}, env_ids=[2])
    state = sim.state()
    assert state.variant is not None and state.variant[:, 0].tolist() == [0, 1, 1]
    for env, expected in enumerate([expected_fields(*data_after(CONTROLS, 2))] * 2 + [expected_fields(*data_after([], 2))]):
        assert_fields(state, env, expected, TOLERANCE[kind])
    assert touch.observe(touch(state))["policy"].shape == (3, 4 * 3 + 1)
