"""Joints and controls of a state, against MuJoCo's own functions: of the instant of the poses, in both simulators.

The oracle is `mj_forward` on one `MjData` that has the state's own joints: poses, velocities and actuator forces must follow.
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
"""float64 and the same functions; float32, relative to the largest number."""


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    return joint_module(tmp_path_factory.mktemp("joints"), TERMS, torch.float32)


def simulation(kind, touch, num_envs, **options):
    if kind is WarpSimulation:
        return WarpSimulation(touch, num_envs, device="cpu", keyframe="home", **options)
    return BatchSimulation(touch, num_envs, keyframe="home", **options)


def stepped(controls, substeps):
    """Return MuJoCo's data after control steps, as it is left: poses of the start of the last physics step."""
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


def expected(model, data, before):
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


def assert_is(state, env, wanted, tolerance):
    for name, values in wanted.items():
        found = getattr(state, name)[env].double().numpy()
        np.testing.assert_allclose(found, values, rtol=0, atol=tolerance * max(1.0, np.abs(values).max()), err_msg=name)


CONTROLS = np.random.default_rng(0).normal(scale=0.2, size=(5, 4))


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
@pytest.mark.parametrize("substeps", [1, 4])
def test_joints_are_those_of_mujoco_at_the_instant_of_the_poses(touch, kind, substeps):
    sim = simulation(kind, touch, 2, substeps=substeps)
    assert_is(sim.state(), 0, expected(*stepped([], substeps)), TOLERANCE[kind])
    for control in CONTROLS:
        sim.step(control)
    assert_is(sim.state(), 1, expected(*stepped(CONTROLS, substeps)), TOLERANCE[kind])
    assert touch.inputs.joints == JOINTS


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_poses_and_forces_follow_from_the_joints_of_the_state(touch, kind):
    """The state's own joints give its poses, velocities and efforts; those of `qpos`, a substep later, do not."""
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

    own = state.body_pos[0, touch.inputs.bodies.index("tip")].double().numpy()
    np.testing.assert_allclose(tip_pos(state.joint_pos[0].double().numpy()), own, atol=TOLERANCE[kind])
    later = [qpos[0, model.joint(name).qposadr[0]] for name in JOINTS]
    assert np.abs(tip_pos(later) - own).max() > 1e-4


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_a_reset_puts_its_own_environments_back_and_no_others(touch, kind):
    sim = simulation(kind, touch, 3, substeps=2)
    for control in CONTROLS:
        sim.step(control)
    moving, start = expected(*stepped(CONTROLS, 2)), expected(*stepped([], 2))
    sim.reset([1])
    state = sim.state()
    for env, wanted in enumerate([moving, start, moving]):
        assert_is(state, env, wanted, TOLERANCE[kind])
    sim.step(CONTROLS[0])
    assert_is(sim.state(), 1, expected(*stepped(CONTROLS[:1], 2)), TOLERANCE[kind])


@pytest.mark.parametrize("kind", [BatchSimulation, WarpSimulation])
def test_every_substep_has_its_own(touch, kind):
    sim = simulation(kind, touch, 1, substeps=3)
    for i, state in enumerate(sim.substates(CONTROLS[0])):
        assert_is(state, 0, expected(*stepped([CONTROLS[0]], i + 1)), TOLERANCE[kind])


def test_asking_changes_no_physics(tmp_path, touch):
    """A control step is made in two parts where joints are kept between: to the last bit it is the same."""
    plain = joint_module(tmp_path, {"policy": [{"type": "joint_effort"}]})
    sims = [BatchSimulation(module, 2, substeps=5, keyframe="home") for module in (touch, plain)]
    for control in CONTROLS:
        for sim in sims:
            sim.step(control)
    for name in ("qpos", "qvel", "xpos", "cvel", "sensordata"):
        assert (getattr(sims[0].batch, name) == getattr(sims[1].batch, name)).all()


def test_both_simulators_agree_through_the_module(touch):
    """From the controls to the policy, stepped and read in one; a later step does not reach into an earlier state."""
    sim, cpu = (simulation(kind, touch, 2, substeps=2) for kind in (WarpSimulation, BatchSimulation))
    kept = sim.state()
    first = kept.joint_pos.clone()
    for control in CONTROLS:
        readings = sim.step_and_read(control)
        cpu.step(control)
    other = touch(cpu.state())
    for name in ("joint_pos", "joint_vel", "joint_effort", "last_action"):
        torch.testing.assert_close(readings[name], other[name], rtol=1e-4, atol=1e-5)
    assert (kept.joint_pos == first).all()
    torch.testing.assert_close(touch.observe(readings)["policy"], touch.observe(other)["policy"], rtol=1e-4, atol=1e-5)


def test_a_reading_does_not_follow_the_simulation(touch):
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
def test_a_model_of_ones_own_that_lacks_them(touch, kind, old, new, message):
    xml = SCENE_XML.replace(old, new)
    spec = mujoco.MjSpec.from_string(xml[: xml.index("<keyframe>")] + "</mujoco>")
    model = tgdsl.instrument(spec, touch.inputs).compile()
    with pytest.raises(SimulationError, match=message):
        BatchSimulation(touch, 1, model=model) if kind is BatchSimulation else WarpSimulation(
            touch, 1, model=model, device="cpu"
        )


def test_tables_and_pictures_are_of_links_alone(touch, tmp_path):
    """Joints are on no link: they are kept with the readings of a rollout, and drawn nowhere."""
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
def test_where_objects_differ_the_robots_joints_are_the_same(tmp_path, kind):
    """Environments with another object restart, at the keyframe's joints; the others stay where they were."""
    document = joint_document(tmp_path, TERMS)
    still = (tmp_path / "robot.xml").read_text().replace("</worldbody>", f"{OBJECT}</worldbody>")
    (tmp_path / "scene.xml").write_text(re.sub('<joint name="spin"[^>]*>', "", still))
    size = {"type": "box", "size": [0.02, 0.02, 0.02]}
    document["objects"]["item"]["variants"] = [size, {"type": "sphere", "size": [0.02]}]
    sim = simulation(kind, touch := tgdsl.compile(document), 3, substeps=2)
    for control in CONTROLS:
        sim.step(np.delete(control, 1))  # that of the object, which moves nothing of the robot
    sim.set_objects(variants={"item": 1}, env_ids=[2])
    state = sim.state()
    assert state.variant is not None and state.variant[:, 0].tolist() == [0, 1, 1]
    for env, wanted in enumerate([expected(*stepped(CONTROLS, 2))] * 2 + [expected(*stepped([], 2))]):
        assert_is(state, env, wanted, TOLERANCE[kind])
    assert touch.observe(touch(state))["policy"].shape == (3, 4 * 3 + 1)
