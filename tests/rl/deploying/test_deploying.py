"""A policy on a simulation, an emulated hand and a log: observations and targets equal those of TouchEnv."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hand_logs import random_readings, write_log
from pressing_hands import CALIBRATION, ORDER, SCALE, TURN, Blind, press_policy, press_task

from tgdsl.rl.deploying.deploy import Deployment, deploy
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.evaluation import SEED, evaluate
from tgdsl.rl.playing.policy import policy_for, read_policy
from tgdsl.runtime.xhand1.source import TIME_CONSTANT_S, VelocityFilter
from tgdsl.runtime.xhand1.wire.protocol import JOINTS

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
EPISODES = 3
LOCKSTEP = {"lockstep": True, "calibration": CALIBRATION}
CLOSE = {"rtol": 1e-5, "atol": 2e-6}
"""float32: products of one row and of several round differently."""


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    return press_task(tmp_path_factory.mktemp("press"))


@pytest.fixture(scope="module")
def policy(task):
    """Return a linear policy of all its observations, with velocities measured as on a hand."""
    return press_policy(task.parent, task, joint_vel="measured")


@pytest.fixture(scope="module")
def blind(task):
    return press_policy(task.parent, task, Blind(6), "blind.pt", joint_vel="measured")


def run_in_environments(task, file, **overrides):
    """Return (observations, target) of each step of the environments' first episodes, and their scores."""
    env = TouchEnv(task, EPISODES, threads=1, overrides=overrides)
    policy, obs, steps = policy_for(env, read_policy(file)), env.reset(SEED), []
    for _ in range(env.max_steps):
        result = env.step(policy(obs))
        target = env.actuation.target.clone() if not result.info.ended.any() else None  # would be the next episode's
        steps.append((obs, target))
        obs = result.obs
    env.close()
    return steps, result.info.score


@pytest.mark.parametrize(("joint_vel", "scale"), [("measured", 1.0), ("exact", 0.2)])
def test_deployment_in_simulation_equals_environments(task, joint_vel, scale):
    """Episode i equals environment i: observations, targets and scores, with play, bias and delay of the drives."""
    overrides = {"joint_vel": joint_vel, "proprio.vel_scale": scale}
    file = press_policy(task.parent, task, name=f"{joint_vel}_{scale}.pt", **overrides)
    expected, scores = run_in_environments(task, file, **overrides)
    moments = list(Deployment(task, file).steps(EPISODES))
    assert len(moments) == EPISODES * len(expected)
    for moment in moments:
        obs, target = expected[moment.index]
        assert list(moment.obs) == ["proprio", "tactile_sensors", "goal"]
        for name, value in moment.obs.items():
            torch.testing.assert_close(value[0], obs[name][moment.episode], **CLOSE)
        if target is not None:
            torch.testing.assert_close(moment.target[0], target[moment.episode], rtol=0, atol=1e-6)
    last = [moment.step for moment in moments if moment.index == len(expected) - 1]
    assert all(step.truncated for step in last) and not any(m.step.info.ended for m in moments if m.index < 20)
    np.testing.assert_allclose([step.info.score for step in last], scores[:, None], atol=1e-5)
    assert max(moment.obs["tactile_sensors"].abs().max() for moment in moments) > 10


def test_following_set_points_equals_stepping_with_actions(task):
    """Equal to the bit when the set-points are the actions' targets."""
    generator, runs, targets = torch.Generator().manual_seed(0), [], []
    actions = [2 * torch.rand((2, 6), generator=generator) - 1 for _ in range(12)]
    for follows in (False, True):
        env, states = TouchEnv(task, 2, threads=1), []
        for i, action in enumerate(actions):
            if follows:
                control = env.sim.ctrl.clone()
                control[:, torch.from_numpy(env.task.setup.actuators.actuator)] = targets[i]
                result = env.follow(control)
            else:
                result = env.step(action)
                targets.append(env.actuation.target.clone())
            states.append((env.sim.qpos.clone(), result.obs["tactile_sensors"].clone(), result.info.score.clone()))
        runs.append(states)
        env.close()
    for state, other_state in zip(*runs, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(state, other_state, strict=True))
    assert runs[0][0][0].abs().max() > 0


def test_an_emulated_hand_reports_the_simulations_state(task, blind):
    """Forces to half a count, angles to the wire's float precision, velocities accordingly."""
    runs = [list(Deployment(task, blind, source, **options).steps(2)) for source, options in SOURCES.items()]
    half_count = 0.5 * np.abs(SCALE * TURN).sum(axis=1).max()
    for simulated, emulated in zip(*runs, strict=True):
        assert torch.equal(simulated.target, emulated.target) and torch.equal(simulated.obs["goal"], emulated.obs["goal"])
        one, other = simulated.obs["tactile_sensors"], emulated.obs["tactile_sensors"]
        assert (one - other).abs().max() <= half_count * (1 + 1e-4)
        one, other = simulated.obs["proprio"], emulated.obs["proprio"]
        torch.testing.assert_close(other[:, :6], one[:, :6], rtol=2e-7, atol=1e-7)
        torch.testing.assert_close(other[:, 6:12], one[:, 6:12], rtol=0, atol=4e-7 / 0.02)
        assert torch.equal(one[:, 12:], other[:, 12:])
        assert simulated.step.info.score.item() == pytest.approx(emulated.step.info.score.item(), abs=1e-6)
    last = runs[1][-1]
    assert last.obs["tactile_sensors"].abs().max() > 50 * half_count
    assert (runs[0][-1].obs["tactile_sensors"] != last.obs["tactile_sensors"]).any() and last.age_s is None


SOURCES = {"simulation": {}, "emulator": LOCKSTEP}


@pytest.mark.slow
def test_scores_on_the_emulator_agree_with_the_simulation(task, policy):
    """For a policy that uses touch: within the interval of as many episodes in environments."""
    env = TouchEnv(task, EPISODES, threads=1, overrides={"joint_vel": "measured"})
    expected = evaluate(env, policy_for(env, read_policy(policy)), EPISODES)
    env.close()
    simulated = deploy(task, policy, episodes=EPISODES).scores
    assert simulated.mean == pytest.approx(expected.score, abs=1e-5)
    assert simulated.interval == pytest.approx(expected.score_interval, abs=1e-4)
    emulated = deploy(task, policy, "emulator", episodes=EPISODES, **LOCKSTEP).scores
    assert expected.score_interval[0] < emulated.mean < expected.score_interval[1]
    assert emulated.held == expected.held == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_contact_bits_are_forces_beyond_the_threshold(tmp_path, side):
    """The emulated hand reads forces that this policy does not observe."""
    task = press_task(tmp_path, side)
    file = press_policy(tmp_path, task, Blind(6), touch="agg_bool")
    bits = list(Deployment(task, file, "emulator", **LOCKSTEP).steps())
    file = press_policy(tmp_path, task, Blind(6), "force.pt")
    forces = list(Deployment(task, file, "emulator", **LOCKSTEP).steps())
    for bit, force in zip(bits, forces, strict=True):
        norm = force.obs["tactile_sensors"].reshape(3, 5).norm(dim=0)
        assert bit.obs["tactile_sensors"].tolist() == [(norm > CALIBRATION.contact_threshold).float().tolist()]
    assert 0 < bit.obs["tactile_sensors"].sum() < 5


def test_a_log_is_replayed_without_motion(task, policy, tmp_path):
    """Angles are in the order of actions, speeds and forces follow; targets start from the first angles."""
    readings = random_readings(1.0 + 0.02 * np.arange(20))
    log = write_log(tmp_path / "a.npz", readings)
    deployment = Deployment(task, policy, str(log), goal=(1.0,), lockstep=True, calibration=CALIBRATION)
    moments = list(deployment.steps())
    names = deployment.prepared.moved.names
    ids = [JOINTS.index(name.removeprefix("right_hand_")) for name in names]
    assert [f"right_hand_{name}" for name in ORDER if f"right_hand_{name}" in names] == list(names) and len(names) == 6
    speeds, target = VelocityFilter(TIME_CONSTANT_S), np.clip(readings[0].state.position[ids].astype(np.float64), -1, 1)
    assert 15 < len(moments) <= 20
    for moment, reading in zip(moments, readings, strict=False):
        position, proprio = reading.state.position, moment.obs["proprio"][0].numpy()
        np.testing.assert_allclose(proprio[:6], position[ids], atol=1e-6)
        speed = speeds.update(reading.requested_at, position.astype(np.float64))
        np.testing.assert_allclose(proprio[6:12], speed[ids], rtol=1e-5)
        force = CALIBRATION.apply(reading.state.total_force)
        np.testing.assert_allclose(moment.obs["tactile_sensors"].reshape(3, 5), force.T[::-1], rtol=1e-6)
        unsmoothed = np.clip(target + 0.05 * np.clip(moment.action[0].numpy(), -1, 1), -1, 1)
        target = 0.8 * unsmoothed + 0.2 * target
        np.testing.assert_allclose(moment.target[0], target, atol=1e-9)
        assert moment.step.info.score.isnan() and moment.obs["goal"].tolist() == [[1.0]]
    report = deployment.report()
    assert report.scores is None and not report.moves and report.age.median > 0
    assert str(report).startswith(f"no score: {log} has no scene that knows what happened; 1 episode, {len(moments)} control")
    assert str(report).endswith(f"{log} was not moved: actions were computed, and went nowhere")
    repeated = list(deployment.steps(episodes=3))
    assert [moment.episode for moment in repeated] == [0] * len(moments)  # the log has only one episode
    parts = list(deployment.steps(episodes=9, seconds=0.1))
    assert len(parts) >= len(moments) - 5 and max(moment.episode for moment in parts) >= 2


def test_an_unfinished_episode_has_no_score(task, blind):
    deployment = Deployment(task, blind, goal=(1.0,))
    steps = deployment.steps()
    for _ in range(3):
        next(steps)
    steps.close()
    assert str(deployment.report()).startswith("no score: no episode has ended; 0 episodes, 3 control steps")


def test_samples_have_an_age_in_real_time(task, blind):
    """On a busy machine too: latency is age plus inference, and every score is kept."""
    deployment = Deployment(task, blind, "emulator", calibration=CALIBRATION)
    moments = list(deployment.steps(seconds=0.1))
    report = deployment.report()
    assert len(moments) == report.steps == 5 and all(moment.age_s > 0 for moment in moments)
    latencies = [moment.age_s + moment.inference_s for moment in moments]
    assert report.latency.median == pytest.approx(1e3 * np.median(latencies))
    assert report.latency.p99 == pytest.approx(1e3 * np.quantile(latencies, 0.99))
    assert report.control_rate == pytest.approx(50) and report.rate > 0 and len(report.scores.each) == 1


@pytest.mark.parametrize("goal", [(), (0.7,)])
def test_goals_come_from_the_task_or_the_user(task, blind, goal):
    goals = {moment.obs["goal"].item() for moment in Deployment(task, blind, goal=goal).steps(2, 0.1)}
    if goal:
        assert goals == {np.float32(0.7)}
    else:
        assert len(goals) == 2 and all(0.5 <= value <= 1.5 for value in goals)


def test_a_policy_without_a_card_is_deployed(task, tmp_path):
    """It is assumed to fit the document, and its groups are those of a hand."""
    sizes = 18 + 15 + 1
    torch.jit.trace(torch.nn.Linear(sizes, 6), torch.zeros(1, sizes)).save(str(tmp_path / "plain.pt"))
    deployment = Deployment(task, tmp_path / "plain.pt", goal=(1.0,))
    assert deployment.prepared.groups == {"proprio": 18, "tactile_sensors": 15, "goal": 1}
    assert len(list(deployment.steps(seconds=0.1))) == 5


@pytest.mark.slow
def test_deployment_on_mujoco_warp(task, blind):
    """On a CPU in float32: only the first steps, before noise and contacts diverge."""
    simulated, warp = (list(Deployment(task, blind, source).steps(seconds=0.2)) for source in ("simulation", "warp:cpu"))
    for moment, other in zip(simulated, warp, strict=True):
        torch.testing.assert_close(moment.obs["proprio"][:, :6], other.obs["proprio"][:, :6], rtol=0, atol=2e-3)
        assert torch.equal(moment.action, other.action)


REPOSITORY = Path(__file__).parents[3]
KEPT = REPOSITORY / "policies" / "grip_force_agg_force.pt"


@pytest.mark.slow
def test_the_kept_student_scores_the_same_in_simulation_and_emulation():
    """Four episodes of 1.5 s, each with another object; within the simulation's interval."""
    task, calibration = REPOSITORY / "examples/tasks/grip_force.yaml", REPOSITORY / "examples/tasks/grip_calibration.yaml"
    options = {"episodes": 4, "overrides": {"episode": "1.5 s"}}
    simulated = deploy(task, KEPT, **options).scores
    emulated = deploy(task, KEPT, "emulator", lockstep=True, calibration=calibration, **options).scores
    assert simulated.interval[0] < emulated.mean < simulated.interval[1]


def test_the_threshold_of_the_calibration_sets_contact_bits(tmp_path):
    task = press_task(tmp_path)
    file = press_policy(tmp_path, task, Blind(6), touch="agg_bool")
    deaf = replace(CALIBRATION, contact_threshold=1e6)
    bits = [m.obs["tactile_sensors"].sum() for m in Deployment(task, file, "emulator", lockstep=True, calibration=deaf).steps()]
    assert not any(bits)
