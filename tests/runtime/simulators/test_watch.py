"""Bodies, sites and joints that a task watches: MuJoCo's values at the instant of the readings, on both simulators."""

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import SCENE, module, warp

from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulators.watch import Watch, product, rotated

BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
SITES = SCENE.replace(
    'pos=".008 -.01 .02" euler="10 20 30"/>',
    'pos=".008 -.01 .02" euler="10 20 30"/><site name="tip" pos=".01 .02 .03" euler="40 10 0"/><body><site name="bare"/></body>',
)
WATCH = Watch(bodies=("cube", "arm"), sites=("tip",), joints=("two", "one"), actuators=("two",), pairs=(("table", "cube"),))


def watching(simulator, tmp_path, watch=WATCH, **options):
    assert SITES != SCENE
    touch = module(tmp_path, SITES, kind="force_taxel")
    return simulator(touch, 3, keyframe="home", watch=watch, **options)


def one_step_ago(sim, env: int, control) -> mujoco.MjData:
    """Return MuJoCo's data at the start of an environment's next physics step."""
    data = mujoco.MjData(sim.model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = sim.qpos[env].numpy(), sim.qvel[env].numpy(), control
    data.qacc_warmstart[:] = sim._arrays["qacc_warmstart"][env].numpy()
    mujoco.mj_forward(sim.model, data)
    return data


@BOTH
def test_watched_values_match_mujoco_at_the_instant_of_readings(tmp_path, simulator):
    sim, tolerance = watching(simulator, tmp_path), 1e-12 if simulator is BatchSimulation else 2e-6
    for _ in range(30):
        sim.step(np.array([0.1, -0.2]))
    control = np.array([0.3, 0.2])
    data = one_step_ago(sim, 1, control)
    sim.step(control)
    watched, state = sim.watched(), sim.state()
    assert torch.equal(watched.body("cube").pos, state.body_pos[:, sim._touch.inputs.bodies.index("cube")].to(watched.body_pos))
    tolerances = {"rtol": 1e-6 if tolerance > 1e-9 else 1e-12, "atol": tolerance}
    for i, name in enumerate(WATCH.bodies):
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(sim.model, data, mujoco.mjtObj.mjOBJ_XBODY, sim.model.body(name).id, velocity, 0)
        np.testing.assert_allclose(watched.body_pos[1, i], data.body(name).xpos, **tolerances)
        np.testing.assert_allclose(watched.body_quat[1, i], data.body(name).xquat, **tolerances)
        np.testing.assert_allclose(watched.body_angvel[1, i], velocity[:3], **tolerances)
        np.testing.assert_allclose(watched.body_linvel[1, i], velocity[3:], **tolerances)
    np.testing.assert_allclose(watched.site_pos[1, 0], data.site("tip").xpos, **tolerances)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, data.site("tip").xmat)
    assert abs(float(watched.site_quat[1, 0] @ torch.from_numpy(quaternion).to(watched.site_quat))) == pytest.approx(
        1, abs=1e-6
    )
    for i, name in enumerate(WATCH.joints):
        np.testing.assert_allclose(watched.joint_pos[1, i], data.joint(name).qpos[0], **tolerances)
        np.testing.assert_allclose(watched.joint_vel[1, i], data.joint(name).qvel[0], **tolerances)
        np.testing.assert_allclose(watched.joint_effort[1, i], data.joint(name).qfrc_actuator[0], **tolerances)
    np.testing.assert_allclose(watched.last_action[:, 0], 0.2, **tolerances)
    assert watched.pair_force[1, 0, 2] < -1  # the cube lies on the table
    pair = [(p.link, p.object) for p in sim._touch.inputs.pairs].index(("table", "cube"))
    assert torch.equal(watched.pair_force[:, 0], state.contact_netforce[:, pair].to(watched.pair_force))


@BOTH
@pytest.mark.parametrize("substeps", [1, 4])
def test_watching_does_not_change_the_simulation(tmp_path, simulator, substeps):
    final_states = []
    for watch in (None, WATCH):
        sim = watching(simulator, tmp_path, watch, substeps=substeps)
        for _ in range(5):
            sim.step(np.array([0.1, -0.2]))
            if watch:
                sim.watched()
        final_states.append((sim.qpos.clone(), sim.state().body_pos.clone()))
    for expected, result in zip(*final_states, strict=True):
        assert torch.equal(expected, result)


@BOTH
def test_reset_updates_watched_poses_and_zeroes_efforts(tmp_path, simulator):
    sim = watching(simulator, tmp_path)
    for _ in range(3):
        sim.step(np.array([0.4, -0.2]))
    before = sim.watched()
    sim.reset(torch.tensor([False, True, False]), contacts="none", qpos=np.array([0, 0, 0.5, 1, 0, 0, 0, 0.7, -0.3]))
    after = sim.watched()
    np.testing.assert_allclose(after.joint_pos[1], [-0.3, 0.7], rtol=1e-6)
    np.testing.assert_allclose(after.body("cube").pos[1], [0, 0, 0.5], atol=1e-7)
    assert before.joint_effort[1].all() and not after.joint_effort[1].any() and not after.pair_force[1].any()
    for name in ("body_pos", "joint_pos", "joint_effort", "pair_force", "site_pos"):
        assert torch.equal(getattr(after, name)[[0, 2]], getattr(before, name)[[0, 2]]), name


@BOTH
@pytest.mark.parametrize(
    ("watch", "message"),
    [
        (Watch(bodies=("cub",)), 'the scene has no body "cub"; did you mean "cube"?'),
        (Watch(sites=("tipp",)), 'the scene has no site "tipp"; did you mean "tip"?'),
        (Watch(sites=("bare",)), 'the site "bare" is on a body without a name; name it in the scene'),
        (Watch(joints=("thre",)), 'the scene has no joint "thre"'),
        (Watch(actuators=("tow",)), 'the scene has no actuator "tow"'),
        (Watch(pairs=(("arm", "cube"),)), "no sensor of this module reads the whole force of cube on arm; add one of kind"),
    ],
)
def test_missing_names_are_refused(tmp_path, simulator, watch, message):
    with pytest.raises(SimulationError) as caught:
        watching(simulator, tmp_path, watch)
    assert str(caught.value).startswith(message)


@BOTH
def test_unwatched_names_are_refused(tmp_path, simulator):
    sim = watching(simulator, tmp_path, None)
    with pytest.raises(SimulationError, match="nothing is watched"):
        sim.watched()
    with pytest.raises(SimulationError, match='the body "pad" is not watched; known watched bodies: arm, cube'):
        watching(simulator, tmp_path).watched().body("pad")


def test_quaternions_rotate_and_multiply_like_mujocos():
    rng = np.random.default_rng(0)
    one, two = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in rng.normal(size=(2, 20, 4)))
    vectors = rng.normal(size=(20, 3))
    rotated_vectors, multiplied = np.zeros((20, 3)), np.zeros((20, 4))
    for i in range(20):
        mujoco.mju_rotVecQuat(rotated_vectors[i], vectors[i], one[i])
        mujoco.mju_mulQuat(multiplied[i], one[i], two[i])
    np.testing.assert_allclose(rotated(torch.from_numpy(one), torch.from_numpy(vectors)), rotated_vectors, atol=1e-15)
    np.testing.assert_allclose(product(torch.from_numpy(one), torch.from_numpy(two)), multiplied, atol=1e-15)
