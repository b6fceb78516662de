"""The gymnasium environment on CPU and GPU: it returns the step's values, as arrays on the host or tensors on the device."""

import numpy as np
import pytest
import torch
from gymnasium.wrappers import vector
from small_tasks import DEVICES, STEPS, have_a_fault, small_task

from tgdsl.rl.adapters.gymnasium import STEP_KEYS, TouchVectorEnv
from tgdsl.rl.env import TouchEnv

NUM_ENVS, NUM_STEPS = 6, 2 * STEPS + 3


@pytest.fixture(scope="module", params=DEVICES)
def touch_env(request, tmp_path_factory):
    env = TouchEnv(small_task(tmp_path_factory.mktemp("gymnasium")), NUM_ENVS, device=request.param)
    with pytest.warns(UserWarning, match="1 had controls that are not finite"):  # shown once, here
        have_a_fault(env)
    yield env
    env.close()


@pytest.fixture
def recorded_steps(touch_env, monkeypatch):
    """Return a list that records every step of the environment itself."""
    steps, step = [], touch_env.step

    def recording_step(action):
        steps.append(step(action))
        return steps[-1]

    monkeypatch.setattr(touch_env, "step", recording_step)
    return steps


def random_actions(seed):
    """Return random actions; a NaN terminates an episode of environment 1."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (NUM_STEPS, NUM_ENVS, 2)).astype(np.float32)
    actions[3, 1, 0] = np.nan
    return actions


def on_host(value):
    return {name: on_host(part) for name, part in value.items()} if isinstance(value, dict) else value.cpu().numpy()


def test_arrays_equal_the_steps_tensors(touch_env, recorded_steps):
    """Statistics of gymnasium agree too: two episodes of each environment, and one of environment 2 cut short."""
    env = vector.RecordEpisodeStatistics(TouchVectorEnv(touch_env))
    env.reset(seed=7)
    touch_env.steps[2] = 5
    for action in random_actions(0):
        obs, reward, terminated, truncated, infos = env.step(action)
        step = recorded_steps[-1]
        np.testing.assert_equal(obs, on_host(step.obs))
        for actual, expected in zip((reward, terminated, truncated), step[1:4], strict=True):
            np.testing.assert_array_equal(actual, expected.cpu().numpy())
        ended = step.info.ended.cpu().numpy()
        assert ("_final_obs" in infos) == ended.any()
        for row in np.flatnonzero(ended):
            np.testing.assert_equal(infos["final_obs"][row], {n: v[row].cpu().numpy() for n, v in step.info.final_obs.items()})
            final = infos["final_info"]
            for name in ("score", "episode_return", "episode_steps", "faults"):
                assert final[name][row] == getattr(step.info, name)[row].item()
            np.testing.assert_allclose(infos["episode"]["r"][row], final["episode_return"][row], atol=1e-6)
            if row != 2:
                assert infos["episode"]["l"][row] == final["episode_steps"][row]
    assert env.episode_count == sum(int(step.info.ended.sum()) for step in recorded_steps) == 2 * NUM_ENVS + 1


@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype")
def test_tensors_stay_on_the_environments_device(touch_env, recorded_steps):
    env = TouchVectorEnv(touch_env, output="torch")
    env.reset(seed=7)
    actions = torch.from_numpy(np.nan_to_num(random_actions(1))).to(touch_env.device)
    is_cuda = touch_env.device.type == "cuda"
    if is_cuda:
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")
    try:
        results = [env.step(action) for action in actions]
    finally:
        if is_cuda:
            torch.cuda.set_sync_debug_mode("default")
    for (obs, reward, terminated, truncated, infos), step in zip(results, recorded_steps, strict=True):
        pairs = [(reward, step.reward), (terminated, step.terminated), (truncated, step.truncated)]
        pairs += [(obs[name], value) for name, value in step.obs.items()]
        pairs += [(infos["final_obs"][name], value) for name, value in step.info.final_obs.items()]
        pairs += [(infos[name], getattr(step.info, name)) for name in STEP_KEYS if name not in ("terms", "episode_terms")]
        pairs += [(infos["_final_obs"], step.info.ended), (infos["_score"], ~step.info.ended)]
        assert all(actual.device == touch_env.device and torch.equal(actual, expected) for actual, expected in pairs)


def test_wrappers_of_actions_and_rewards(touch_env, recorded_steps):
    env = vector.RescaleAction(TouchVectorEnv(touch_env), np.float32([-2, -2]), np.float32([2, 2]))
    env = vector.NormalizeReward(vector.TransformReward(vector.ClipAction(env), lambda reward: reward - 1), gamma=0.0)
    env.reset(seed=7)
    for action in np.nan_to_num(random_actions(2)):
        reward = env.step(2 * action)[1]
        deviation = np.sqrt(env.return_rms.var + env.epsilon)
        np.testing.assert_allclose(reward, (recorded_steps[-1].reward.cpu().numpy() - 1) / deviation, rtol=1e-5)
