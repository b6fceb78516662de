"""The examples of skrl and Stable-Baselines3 train on the hand's observations and learn how episodes end."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from small_tasks import STEPS, small_task

from tgdsl.rl.adapters.gymnasium import TouchVectorEnv
from tgdsl.rl.env import TouchEnv

EXAMPLES = Path(__file__).parents[2] / "examples" / "rl"


@pytest.fixture
def task(tmp_path):
    return str(small_task(tmp_path))


def test_skrl_learns(task, tmp_path):
    """After 24 steps it has learned once, from 6 + 4 + 7 observations."""
    example = runpy.run_path(str(EXAMPLES / "skrl_ppo.py"))
    agent = example["main"](["--task", task, "--envs", "4", "--steps", "24", "--out", str(tmp_path / "out")])
    assert agent.policy.num_observations == 17
    changed = agent.optimizer.state_dict()["state"]
    assert changed and all(weight.isfinite().all() for weight in agent.policy.parameters())


def test_stable_baselines3_learns(task, capsys):
    example = runpy.run_path(str(EXAMPLES / "stable_baselines3_ppo.py"))
    model = example["main"](["--task", task, "--envs", "4", "--steps", "24"])
    assert list(model.observation_space.spaces) == ["proprio", "tactile_sensors", "goal"]
    assert model.policy.optimizer.state_dict()["state"] and model.num_timesteps == 96
    assert f"ep_len_mean     | {STEPS} " in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:environments had faults")
def test_stable_baselines3_distinguishes_ends_of_episodes(task):
    """Environment 1 terminates by a non-finite action, the others are truncated after 8 steps."""
    example = runpy.run_path(str(EXAMPLES / "stable_baselines3_ppo.py"))
    touch_env = TouchEnv(task, 3)
    env = example["Sb3VecEnv"](TouchVectorEnv(touch_env))
    env.seed(5)
    first, total = env.reset(), np.zeros(3)
    ends = {}
    for step in range(STEPS):
        action = np.zeros((3, 2))
        action[1] = np.nan if step == 2 else 0.0
        obs, reward, done, infos = env.step(action)
        total += reward
        for i in np.flatnonzero(done):
            info = infos[i]
            ends[int(i)] = (step, info["TimeLimit.truncated"], info["episode"]["l"])
            assert info["episode"]["r"] == pytest.approx(total[i], abs=1e-6)
            assert set(info["terminal_observation"]) == set(obs)
        assert [bool(info) for info in infos] == done.tolist()
    assert ends == {1: (2, False, 3), 0: (7, True, 8), 2: (7, True, 8)}
    observation = touch_env.reset(5)  # the first of the seeds
    assert all(torch.equal(observation[name], torch.from_numpy(value)) for name, value in first.items())
    assert (env.get_attr("num_envs"), env.env_is_wrapped(dict)) == ([3] * 3, [False] * 3)
    env.close()
