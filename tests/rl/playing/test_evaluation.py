"""Evaluation: which episodes count, means and intervals."""

import json
import math

import numpy as np
import pytest
import torch
from scipy import stats
from small_tasks import small_task

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.evaluation import evaluate, mean_interval, score_interval, share_interval
from tgdsl.rl.playing.rollout import ZeroActor
from tgdsl.rl.task import Task


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    return TouchEnv(small_task(tmp_path_factory.mktemp("evaluated")), 4, threads=1)


class FailingActor(ZeroActor):
    """Returns NaN for environment 1 at each third step, so that its episodes terminate early."""

    def __call__(self, obs):
        action = super().__call__(obs).clone()
        self.count = getattr(self, "count", 0) + 1
        if self.count % 3 == 0:
            action[1] = torch.nan
        return action


@pytest.mark.filterwarnings("ignore:environments had faults")
def test_each_environment_contributes_its_first_episodes(env):
    """10 episodes of 4 environments are 3, 3, 2 and 2, however short those of environment 1 are."""
    messages: list[str] = []
    evaluation = evaluate(env, FailingActor(env), 10, progress=messages.append)
    assert messages[0] == "evaluating: 0 of 10 episodes"
    assert (evaluation.episodes, evaluation.envs, evaluation.faults) == (10, 4, 3)
    assert evaluation.held == pytest.approx(0.7) and evaluation.held_interval == share_interval(0.7, 10)
    assert evaluation.seconds == pytest.approx((3 * 3 + 7 * 8) / 10 * 0.025)
    assert str(evaluation).endswith("in 10 episodes; 70.0% (95 %: 39.7% to 89.2%) of full length")
    json.dumps(evaluation.plain())


def test_scores_come_from_the_task_and_are_reproducible(env):
    """The k-th environment scores k, as if it had reached that many goals."""

    class ReachingActor(ZeroActor):
        def __call__(self, obs):
            env.task.memory["reached"].copy_(torch.arange(4))
            return super().__call__(obs)

    evaluation = evaluate(env, ReachingActor(env), 3)
    assert (evaluation.score, evaluation.envs) == (1.0, 3)
    half = 4.302653 * math.sqrt(1 / 3)  # Student's t with two degrees of freedom
    assert evaluation.score_interval == pytest.approx((1 - half, 1 + half), abs=1e-5)
    repeats = [evaluate(env, ZeroActor(env), 4) for _ in range(2)]
    assert repeats[0] == repeats[1]


def test_the_interval_of_one_episode_is_null(env):
    evaluation = evaluate(env, ZeroActor(env), 1)
    assert evaluation.score_interval == (-math.inf, math.inf)
    assert str(evaluation).startswith(f"score {evaluation.score:.3f} quarter turns in one episode; ")
    assert json.loads(json.dumps(evaluation.plain(), allow_nan=False))["score_interval"] == [None, None]


def test_intervals_match_known_values():
    """Means against SciPy's, for few and many episodes; shares against a table's Wilson interval of 8 in 10."""
    for num in (2, 4, 500):
        values = np.random.default_rng(0).normal(3.0, 2.0, num)
        expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
        assert mean_interval(values.mean(), (values**2).sum(), num) == pytest.approx((expected.low, expected.high))
    assert mean_interval(1.0, 1.0, 1) == (-math.inf, math.inf)
    assert share_interval(0.8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert share_interval(1.0, 1000)[1] == 1.0 and share_interval(0.0, 1000)[0] == pytest.approx(0.0, abs=1e-15)


class ShareTask(Task):
    score_range = (0, 1)


@pytest.mark.parametrize(
    ("task", "scores", "interval"),
    [
        (Task, [1.0] * 7 + [0.0], (0.579, 1.171)),
        (ShareTask, [1.0] * 7 + [0.0], (0.529, 0.978)),
        (ShareTask, [1.0] * 6 + [0.5, 0.0], (0.501, 1.0)),
        (ShareTask, [1.0], (-math.inf, math.inf)),
    ],
    ids=["any number", "0 or 1", "from 0 to 1", "one episode"],
)
def test_intervals_of_scores_stay_within_their_range(task, scores, interval):
    values = np.array(scores)
    found = score_interval(task, values.mean(), (values**2).sum(), len(values))
    assert found == pytest.approx(interval, abs=1e-3)
