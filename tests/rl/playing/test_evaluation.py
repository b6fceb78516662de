"""Evaluation: which episodes count, means and intervals."""

import json
import math

import numpy as np
import pytest
import torch
from scipy import stats
from small_tasks import small_task

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.evaluation import evaluate, mean_interval, share_interval
from tgdsl.rl.playing.rollout import ZeroActor


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    return TouchEnv(small_task(tmp_path_factory.mktemp("evaluated")), 4, threads=1)


class Ends(ZeroActor):
    """Asks for what is no number in environment 1 at each third step: its episodes are short, and end for good."""

    def __call__(self, obs):
        action = super().__call__(obs).clone()
        self.count = getattr(self, "count", 0) + 1
        if self.count % 3 == 0:
            action[1] = torch.nan
        return action


@pytest.mark.filterwarnings("ignore:environments had faults")
def test_first_episodes_of_each_environment_count(env):
    """Of 10 episodes of 4 environments: 3, 3, 2 and 2, however short those of environment 1 are."""
    told: list[str] = []
    found = evaluate(env, Ends(env), 10, progress=told.append)
    assert told[0] == "evaluating: 0 of 10 episodes"
    assert (found.episodes, found.envs, found.faults) == (10, 4, 3)
    assert found.held == pytest.approx(0.7) and found.held_interval == share_interval(0.7, 10)
    assert found.seconds == pytest.approx((3 * 3 + 7 * 8) / 10 * 0.025)
    assert str(found).endswith("in 10 episodes; 70.0% (95 %: 39.7% to 89.2%) of full length")
    json.dumps(found.plain())


def test_scores_are_those_of_the_task_and_the_same_each_time(env):
    """Score k in the k-th environment, as if so many goals had been reached."""

    class Reaches(ZeroActor):
        def __call__(self, obs):
            env.task.memory["reached"].copy_(torch.arange(4))
            return super().__call__(obs)

    found = evaluate(env, Reaches(env), 3)
    assert (found.score, found.envs) == (1.0, 3)
    half = 4.302653 * math.sqrt(1 / 3)  # Student's, of two degrees of freedom
    assert found.score_interval == pytest.approx((1 - half, 1 + half), abs=1e-5)
    again = [evaluate(env, ZeroActor(env), 4) for _ in range(2)]
    assert again[0] == again[1]


def test_what_is_not_known_of_one_episode_is_null(env):
    found = evaluate(env, ZeroActor(env), 1)
    assert found.score_interval == (-math.inf, math.inf)
    assert str(found).startswith(f"score {found.score:.3f} quarter turns in one episode; ")
    assert json.loads(json.dumps(found.plain(), allow_nan=False))["score_interval"] == [None, None]


def test_intervals():
    """Against SciPy's, of few episodes and of many; and Wilson's interval of 8 of 10, as tables have it."""
    for num in (2, 4, 500):
        values = np.random.default_rng(0).normal(3.0, 2.0, num)
        expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
        assert mean_interval(values.mean(), (values**2).sum(), num) == pytest.approx((expected.low, expected.high))
    assert mean_interval(1.0, 1.0, 1) == (-math.inf, math.inf)
    assert share_interval(0.8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert share_interval(1.0, 1000)[1] == 1.0 and share_interval(0.0, 1000)[0] == pytest.approx(0.0, abs=1e-15)
