"""The example of a custom task, and the policy that learns it by touch."""

import dataclasses
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import binomtest
from task_records import reference_rates

from tgdsl.errors import SimulationError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.evaluation import evaluate
from tgdsl.rl.playing.rollout import ZeroActor
from tgdsl.rl.task import HandNow

EXAMPLES = Path(__file__).parents[2] / "examples"
sys.path.append(str(EXAMPLES))  # as with `python examples/learn.py`

import learn  # noqa: E402

TASK = EXAMPLES / "tasks" / "find_ridge.yaml"
LOADED = load_task(TASK)
OWN = sys.modules[LOADED.task.__module__]
TOLERANCE = 1e-6  # of rewards: computed in float64, returned in float32
FAR = [0.03, 0.03]  # a ridge out of the finger's reach
PRESS = 0.225  # target of the first joint for a light press on the plate [rad]
SEED = 5
TORCHSCRIPT = "ignore:`torch.jit:DeprecationWarning"  # rsl_rl's format of policies


@pytest.fixture
def make():
    environments_made = []

    def environments(num_envs, seed=SEED, **overrides):
        dotted = {name.replace("__", "."): value for name, value in overrides.items()}
        environments_made.append(TouchEnv(TASK, num_envs, seed=seed, threads=1, overrides=dotted))
        return environments_made[-1]

    yield environments
    for env in environments_made:
        env.close()


def slide(env, obs, to):
    """Return actions that press and slide to targets of the bending joint [rad], regardless of the ridge."""
    target = obs["command"][:, :3]
    joint_targets = torch.stack([to.expand(env.num_envs), torch.full((env.num_envs,), PRESS), torch.zeros(env.num_envs)], dim=1)
    action = ((joint_targets - target) / env.spec.action.scale).clamp(-1.0, 1.0)
    action[:, 0] *= torch.where(env.steps < 3, 0.0, 0.8)
    return action


def test_rewards_ends_and_scores_match_the_reference(make):
    """Scripted and random actions, over several episodes."""
    env = make(8, noise="clean", episode=1.0, randomise__place=[0.010, 0.016])
    rows, advance = [], env.task.advance

    def recorded(now):
        tip = now.watched.body(env.spec.tip)
        measured = {"place": now.object.pos[:, 1], "force": now.link_force[:, 0], "action": now.action}
        rows.append(measured | {name: getattr(tip, name) for name in ("pos", "quat", "linvel", "angvel")})
        rows[-1] = {name: value.clone().numpy() for name, value in rows[-1].items()}
        advance(now)

    env.task.advance = recorded
    env_steps, obs = [], env.reset(SEED)
    rng = np.random.default_rng(SEED)
    for _ in range(2 * env.max_steps):
        action = env.task.script(obs)
        action[::2] += torch.from_numpy(rng.normal(0.0, 0.7, (4, 3))).float()
        env_steps.append(env.step(action.clamp(-1.0, 1.0)))
        obs = env_steps[-1].obs
    has_found = False
    for first in (0, env.max_steps):
        steps_of_episode = slice(first, first + env.max_steps)
        for i in range(env.num_envs):
            record = {name: np.stack([row[name][i] for row in rows[steps_of_episode]]) for name in rows[0]}
            record = {name: np.concatenate([np.zeros_like(value[:1]), value]) for name, value in record.items()}
            expected = reference_rates(env.task, OWN.reference, env.spec, record, env.control_step)
            for t, step in enumerate(env_steps[steps_of_episode]):
                terms = {name: float(value[i]) for name, value in step.info.terms.items()}
                assert terms == pytest.approx({name: expected[name][t] * env.control_step for name in terms}, abs=TOLERANCE)
                assert float(step.reward[i]) == pytest.approx(sum(terms.values()), abs=TOLERANCE)
                assert bool(step.terminated[i]) == expected["is_over"][t] and not step.truncated[i]
                assert float(step.info.score[i]) == expected["score"][t]
                has_found |= terms["found"] > 0
    assert has_found


def test_observations_of_a_blind_policy_do_not_depend_on_the_ridge(make):
    """They are equal bit for bit while the finger slides across; other observations differ."""
    assert learn.SEES["blind"] == ("command",)
    near, far = (make(4, episode=1.0, randomise__place=place) for place in ([0.012, 0.012], FAR))
    observations = [env.reset(SEED) for env in (near, far)]
    differs = dict.fromkeys(("proprio", "tactile_sensors"), False)
    for _ in range(near.max_steps):
        assert torch.equal(observations[0]["command"], observations[1]["command"])
        differs = {
            name: is_so or not torch.equal(observations[0][name], observations[1][name]) for name, is_so in differs.items()
        }
        action = slide(near, observations[0], torch.tensor(0.0))
        observations = [env.step(action).info.final_obs for env in (near, far)]
    assert torch.equal(observations[0]["command"], observations[1]["command"])
    assert differs == {"proprio": True, "tactile_sensors": True}


@pytest.mark.parametrize("friction", [0.5, 1.5])
def test_the_ridge_does_not_stop_the_finger(make, friction):
    """A blindly sliding finger ends at the same position with and without a ridge."""
    env = make(2, touch="none", randomise__place=[0.0, 0.0], randomise__friction=[friction, friction])
    obs, forces = env.reset(SEED), []
    env.sim.arrays["mocap_pos"][1, 0, 1] = FAR[0]
    for _ in range(env.max_steps):
        env_step = env.step(slide(env, obs, torch.tensor(-0.15)))
        obs = env_step.info.final_obs
        forces.append(obs["priv_ridge"][:, 2])
    assert (torch.stack(forces).amax(dim=0) > env.spec.min_force).tolist() == [True, False]
    with_ridge, without = (obs["priv_ridge"][:, 0] + torch.tensor([0.0, FAR[0]])).tolist()
    assert with_ridge == pytest.approx(without, abs=env.spec.tolerance) and with_ridge < -0.01


def test_the_script_stops_on_the_ridge(make):
    env = make(96, noise="clean")
    obs = env.reset(SEED)
    for _ in range(env.max_steps):
        env_step = env.step(env.task.script(obs))
        obs = env_step.obs
    assert env_step.info.score.mean() >= 0.95


def test_episodes_that_terminate_at_their_time_limit_are_complete(make):
    env = make(3, touch="none")
    evaluation = evaluate(env, ZeroActor(env), 4)
    assert evaluation.held == 1.0 and evaluation.seconds == 2.0


def test_chance_is_the_score_of_the_best_fixed_position(make):
    """Within 5 standard errors, 2 ε / (b − a) of 200,000 ridges are within ε of an inner position, fewer near the ends."""
    env = make(500, touch="none")
    spec, chance = env.spec, OWN.chance(env.spec)
    all_envs = torch.ones(env.num_envs, dtype=torch.bool)
    starts = [env.task.reset(all_envs, torch.full((env.num_envs,), episode)) for episode in range(1, 401)]
    ridge = torch.stack([start.values["mocap_pos"][:, 0, 1] for start in starts]).flatten()
    low, high = spec.randomise.place
    assert low <= ridge.min() < ridge.max() <= high
    positions = torch.linspace(low - 0.002, high + 0.002, 281, dtype=ridge.dtype)
    shares = torch.stack([((ridge - place).abs() <= spec.tolerance).double().mean() for place in positions])
    error = 5.0 * (chance * (1.0 - chance) / len(ridge)) ** 0.5
    is_inside = (positions >= low + spec.tolerance) & (positions <= high - spec.tolerance)
    assert (shares[is_inside] - chance).abs().max() < error
    assert shares[~is_inside].max() < chance + error
    assert shares[0] == 0.0 and chance == pytest.approx(2 * 0.001 / 0.024)


@pytest.mark.slow
def test_no_fixed_stop_does_better_than_chance(make):
    """Fingers slide to fixed targets: compare the mean over targets and the best one (5 standard errors)."""
    env = make(400, touch="none")
    to = torch.linspace(-0.05, 0.13, 10).repeat(40)
    obs, scores = env.reset(SEED), []
    for _ in range(4 * env.max_steps):
        env_step = env.step(slide(env, obs, to))
        obs = env_step.obs
        if env_step.terminated.any():
            scores.append(env_step.info.score)
    shares, chance = torch.stack(scores).view(-1, 10).double(), OWN.chance(env.spec)
    assert abs(shares.mean() - chance) < 0.2 * chance
    assert shares.mean(dim=0).max() < chance + 5.0 * (chance * (1.0 - chance) / len(shares)) ** 0.5


def test_each_number_of_the_document_takes_effect(make):
    env = make(2, noise="clean", randomise__place=[0.016, 0.016], episode=0.5)
    scores = {}
    changes = {"": {}, "tolerance": {"tolerance": 1e-6}, "force": {"min_force": 50.0}, "speed": {"max_speed": 1e-9}}
    for name, changed in changes.items():
        env.task.spec = env.spec.model_copy(update=changed)
        obs = env.reset(SEED)
        for _ in range(20):
            env_step = env.step(env.task.script(obs))
            obs = env_step.obs
        scores[name] = float(env_step.info.score.mean())
    assert scores == {"": 1.0, "tolerance": 0.0, "force": 0.0, "speed": 0.0}
    assert env.max_steps == env.task.num_steps == 20


def test_a_ridge_that_cannot_be_moved_is_refused(make):
    with pytest.raises(SimulationError, match=r'"plate" is no mocap body: give it mocap="true" in the scene'):
        make(1, object="plate")


@pytest.mark.parametrize(("found", "num"), [(0, 10), (83, 1000), (500, 1000), (1000, 1000)])
def test_intervals_are_wilson_intervals(found, num):
    expected = binomtest(found, num).proportion_ci(method="wilson")
    assert learn.interval(found / num, num) == pytest.approx((expected.low, expected.high), abs=1e-9)


def run(condition, iterations, out, num_envs=128):
    return learn.learn(condition, 1, num_envs, 1, 0.0, iterations, out)


@pytest.mark.slow
@pytest.mark.filterwarnings(TORCHSCRIPT)
def test_runs_are_repeatable_and_written(tmp_path, monkeypatch):
    monkeypatch.setattr(learn, "EVALUATION_ENVS", 20)
    monkeypatch.setattr(learn, "evaluate", partial(learn.evaluate, num=20))
    first, second = (run("touch", 4, tmp_path / name, num_envs=8) for name in ("first", "again"))
    same = [dataclasses.replace(result, minutes=0.0, curve=[row[1:] for row in result.curve]) for result in (first, second)]
    assert same[0] == same[1] and first.iterations == 4 and first.episodes == 16 and first.evaluated == 20
    assert learn.read(tmp_path / "first")[0].success == first.success
    env = TouchEnv(TASK, 8, seed=1, threads=1)
    observation = torch.cat([env.reset(1)[name] for name in learn.SEES["touch"]], dim=1)
    policies = [torch.jit.load(tmp_path / name / "touch_1.pt") for name in ("first", "again")]
    assert torch.equal(policies[0](observation), policies[1](observation))
    learn.plot(learn.read(tmp_path / "first"), tmp_path / "curve.png")
    assert "| touch | 1 |" in learn.table([first])
    env.close()


@pytest.mark.slow
@pytest.mark.filterwarnings(TORCHSCRIPT)
def test_half_a_minute_of_learning_with_touch_is_far_above_chance(tmp_path, monkeypatch):
    """30 updates are 150,000 control steps; measured success was 0.92."""
    monkeypatch.setattr(learn, "evaluate", partial(learn.evaluate, num=200))
    result = run("touch", 30, tmp_path)
    assert result.success > 0.6 > 5.0 * result.chance


def test_a_hand_and_the_scene_give_the_same_command(make):
    """The command depends only on targets, actions and time."""
    env, generator = make(2), torch.Generator().manual_seed(0)
    for i in range(3):
        env_step = env.step(2 * torch.rand((2, env.num_actions), generator=generator) - 1)
        now = env.now
        hand_now = HandNow(now.joint_pos, now.joint_vel, now.target, now.action, i + 1, env.control_step, now.target[:, :0])
        assert torch.equal(OWN.FindRidge.observe_hand(env.spec, hand_now)["command"].float(), env_step.obs["command"])
