"""Training iterations: observations, metrics and progress."""

import pytest
import torch
from small_runs import small_learner
from small_tasks import STEPS

from tgdsl.rl.train.learner import EpisodeTally


def test_metrics_of_an_iteration(tmp_path):
    """Episodes of 8 steps start together, so with 4 steps per iteration every second one has all their ends."""
    learner, _ = small_learner(tmp_path, train__desynchronise=False)
    steps, returns = [], []
    step = learner.env.step

    def recording_step(action):
        result = step(action)
        steps.append(result)
        return result

    learner.env.step = recording_step
    iterations = [learner.iterate() for _ in range(4)]
    assert [result.episodes for result in iterations] == [0, 4, 0, 4]
    assert "Episode/return" not in iterations[0].metrics and iterations[1].metrics["Episode/steps"] == STEPS
    returns = torch.stack([result.reward for result in steps[:STEPS]]).sum(dim=0).mean()
    assert iterations[1].metrics["Episode/return"] == pytest.approx(float(returns), rel=1e-5)
    terms = sum(value for name, value in iterations[1].metrics.items() if name.startswith("Reward/"))
    assert iterations[1].metrics["Episode/return"] == pytest.approx(terms, rel=1e-4)
    assert iterations[1].metrics["Episode/dropped"] == 0.0
    assert learner.samples == 4 * 4 * 4 and learner.iteration == 4
    assert all(result.rollout > 0 and result.update > 0 for result in iterations)


def test_curricula_follow_iterations_and_scores(tmp_path):
    """The score is the mean of the episodes that ended before the iteration; it is saved with the run."""
    ramp = {"term": "linear", "first": 0, "last": 4, "start": 0, "end": -1}
    terms = {"ramp": ramp | {"of": "rewards.effort"}, "skill": ramp | {"of": "rewards.near", "by": "score", "last": 10}}
    learner, _ = small_learner(tmp_path, train__desynchronise=False, terms=terms)
    values, iterations = learner.env.curricula.values, []
    for i in range(4):
        score = next(
            (iteration.metrics["Episode/score"] for iteration in reversed(iterations) if "Episode/score" in iteration.metrics),
            0.0,
        )
        iterations.append(learner.iterate())
        assert values["rewards.effort"].item() == pytest.approx(-i / 4)
        assert values["rewards.near"].item() == pytest.approx(-min(1.0, max(0.0, score / 10)))
    assert learner.state_dict()["score"] == iterations[-1].metrics["Episode/score"]


def test_only_used_groups_are_stored(tmp_path):
    learner, _ = small_learner(tmp_path)
    assert set(learner.algorithm.storage.observations.keys()) == {"priv_proprio", "goal", "priv_obj_state", "priv_obj_props"}


def test_first_episodes_end_at_random_times(tmp_path):
    learner, _ = small_learner(tmp_path, num_envs=64)
    num_episodes = [learner.iterate().episodes for _ in range(2)]
    assert sum(num_episodes) == 64 and min(num_episodes) > 15


@pytest.mark.parametrize("rnd", ["off", "both"])
def test_returns_of_truncated_episodes_bootstrap_from_the_final_value(tmp_path, rnd):
    """The value is that of the final observation, before the next episode begins."""
    options = {} if rnd == "both" else {"train__rnd": "off"}
    learner, _ = small_learner(tmp_path, train__desynchronise=False, **options)
    algorithm, steps, observations, rewards = learner.algorithm, [], [], []
    act, step, add = algorithm.act, learner.env.step, algorithm.storage.add_transition

    def recording_act(obs):
        observations.append(obs.clone())
        return act(obs)

    def recording_step(action):
        steps.append(step(action))
        return steps[-1]

    def recording_add(transition):
        rewards.append(transition.rewards - algorithm.intrinsic_rewards if rnd == "both" else transition.rewards.clone())
        assert all(torch.equal(transition.observations[name], value) for name, value in observations[-1].items())
        add(transition)

    algorithm.act, learner.env.step, algorithm.storage.add_transition = recording_act, recording_step, recording_add
    learner.roll()
    algorithm.storage.clear()
    learner.roll()
    assert steps[-1].truncated.all() and len(steps) == STEPS
    with torch.no_grad():
        final_values = algorithm.critic(learner._seen(steps[-1].info.final_obs))[:, 0]
        next_values = algorithm.critic(learner._seen(learner.env.observe()))[:, 0]
    assert (final_values - next_values).abs().min() > 1e-4
    torch.testing.assert_close(rewards[-1].flatten(), steps[-1].reward + algorithm.gamma * final_values)
    torch.testing.assert_close(rewards[-2].flatten(), steps[-2].reward)


def test_learning_is_determined_by_the_seed(tmp_path):
    weights = []
    for seed in (1, 1, 2):
        learner, _ = small_learner(tmp_path, seed=seed)
        learner.iterate()
        weights.append(torch.cat([value.flatten() for value in learner.algorithm.actor.parameters()]))
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


@pytest.mark.slow
def test_a_penalty_of_actions_makes_actions_small(tmp_path):
    zero_weights = {
        f"rewards__{name}": 0 for name in ("success", "spin", "near", "tilt", "object_distance", "drop", "joint_limit", "work")
    }
    options = {"num_envs": 32, "train__rnd": "off", "train__steps": 8, "train__entropy": 0, "rewards__action_rate": -10}
    learner, _ = small_learner(tmp_path, **zero_weights, **options)
    iterations = [learner.iterate() for _ in range(40)]
    first, last = (
        sum(iteration.metrics["Episode/return"] for iteration in part) / 5 for part in (iterations[:5], iterations[-5:])
    )
    assert first < 0 and last > 0.6 * first
    assert iterations[-1].metrics["Policy/mean_std"] < 0.9 * iterations[0].metrics["Policy/mean_std"]


def test_a_tally_without_episodes_has_no_means():
    assert EpisodeTally().means([0.0]) == {}
