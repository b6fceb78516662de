"""An iteration: what is seen, what is told, and that it learns."""

import pytest
import torch
from small_runs import small_learner
from small_tasks import STEPS

from tgdsl.rl.train.learner import EpisodeTally


def test_an_iteration(tmp_path):
    """Episodes of 8 steps that begin together, and iterations of 4 steps: each second one has all their ends."""
    learner, _ = small_learner(tmp_path, train__desynchronise=False)
    steps, returns = [], []
    step = learner.env.step

    def recorded(action):
        made = step(action)
        steps.append(made)
        return made

    learner.env.step = recorded
    found = [learner.iterate() for _ in range(4)]
    assert [made.episodes for made in found] == [0, 4, 0, 4]
    assert "Episode/return" not in found[0].metrics and found[1].metrics["Episode/steps"] == STEPS
    returns = torch.stack([made.reward for made in steps[:STEPS]]).sum(dim=0).mean()
    assert found[1].metrics["Episode/return"] == pytest.approx(float(returns), rel=1e-5)
    terms = sum(value for name, value in found[1].metrics.items() if name.startswith("Reward/"))
    assert found[1].metrics["Episode/return"] == pytest.approx(terms, rel=1e-4)
    assert found[1].metrics["Episode/dropped"] == 0.0
    assert learner.samples == 4 * 4 * 4 and learner.iteration == 4
    assert all(made.rollout > 0 and made.update > 0 for made in found)


def test_curricula_follow_iterations_and_scores(tmp_path):
    """The score is that of the episodes which ended before an iteration, and goes on with a run."""
    ramp = {"term": "linear", "first": 0, "last": 4, "start": 0, "end": -1}
    terms = {"ramp": ramp | {"of": "rewards.effort"}, "skill": ramp | {"of": "rewards.near", "by": "score", "last": 10}}
    learner, _ = small_learner(tmp_path, train__desynchronise=False, terms=terms)
    values, found = learner.env.curricula.values, []
    for i in range(4):
        score = next((made.metrics["Episode/score"] for made in reversed(found) if "Episode/score" in made.metrics), 0.0)
        found.append(learner.iterate())
        assert values["rewards.effort"].item() == pytest.approx(-i / 4)
        assert values["rewards.near"].item() == pytest.approx(-min(1.0, max(0.0, score / 10)))
    assert learner.state_dict()["score"] == found[-1].metrics["Episode/score"]


def test_only_what_somebody_sees_is_kept(tmp_path):
    learner, _ = small_learner(tmp_path)
    assert set(learner.algorithm.storage.observations.keys()) == {"priv_proprio", "goal", "priv_obj_state", "priv_obj_props"}


def test_first_episodes_end_at_random_times(tmp_path):
    learner, _ = small_learner(tmp_path, num_envs=64)
    found = [learner.iterate().episodes for _ in range(2)]
    assert sum(found) == 64 and min(found) > 15


@pytest.mark.parametrize("rnd", ["off", "both"])
def test_a_return_goes_on_with_the_value_at_the_end_of_an_episode_that_was_cut_off(tmp_path, rnd):
    """Of what was observed there, before the next episode began."""
    options = {} if rnd == "both" else {"train__rnd": "off"}
    learner, _ = small_learner(tmp_path, train__desynchronise=False, **options)
    algorithm, steps, seen, paid = learner.algorithm, [], [], []
    act, step, keep = algorithm.act, learner.env.step, algorithm.storage.add_transition

    def acted(obs):
        seen.append(obs.clone())
        return act(obs)

    def stepped(action):
        steps.append(step(action))
        return steps[-1]

    def kept(own):
        paid.append(own.rewards - algorithm.intrinsic_rewards if rnd == "both" else own.rewards.clone())
        assert all(torch.equal(own.observations[name], value) for name, value in seen[-1].items())
        keep(own)

    algorithm.act, learner.env.step, algorithm.storage.add_transition = acted, stepped, kept
    learner.roll()
    algorithm.storage.clear()
    learner.roll()
    assert steps[-1].truncated.all() and len(steps) == STEPS
    with torch.no_grad():
        final = algorithm.critic(learner._seen(steps[-1].info.final_obs))[:, 0]
        begun = algorithm.critic(learner._seen(learner.env.observe()))[:, 0]
    assert (final - begun).abs().min() > 1e-4
    torch.testing.assert_close(paid[-1].flatten(), steps[-1].reward + algorithm.gamma * final)
    torch.testing.assert_close(paid[-2].flatten(), steps[-2].reward)


def test_the_same_seed_learns_the_same_and_another_seed_something_else(tmp_path):
    weights = []
    for seed in (1, 1, 2):
        learner, _ = small_learner(tmp_path, seed=seed)
        learner.iterate()
        weights.append(torch.cat([value.flatten() for value in learner.algorithm.actor.parameters()]))
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


@pytest.mark.slow
def test_it_learns(tmp_path):
    """To ask for nothing costs nothing: with a penalty of actions alone, actions become small."""
    zero = {
        f"rewards__{name}": 0 for name in ("success", "spin", "near", "tilt", "object_distance", "drop", "joint_limit", "work")
    }
    options = {"num_envs": 32, "train__rnd": "off", "train__steps": 8, "train__entropy": 0, "rewards__action_rate": -10}
    learner, _ = small_learner(tmp_path, **zero, **options)
    found = [learner.iterate() for _ in range(40)]
    first, last = (sum(made.metrics["Episode/return"] for made in part) / 5 for part in (found[:5], found[-5:]))
    assert first < 0 and last > 0.6 * first
    assert found[-1].metrics["Policy/mean_std"] < 0.9 * found[0].metrics["Policy/mean_std"]


def test_no_episode_no_means():
    assert EpisodeTally().means([0.0]) == {}
