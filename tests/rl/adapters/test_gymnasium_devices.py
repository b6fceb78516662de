"""The environment of gymnasium, of the CPU and of a GPU: what it gives is what the step has brought, on the host or where it is."""

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
    with pytest.warns(UserWarning, match="1 had controls that are not finite"):  # said once, here
        have_a_fault(env)
    yield env
    env.close()


@pytest.fixture
def made(touch_env, monkeypatch):
    """Every step of the environment itself."""
    steps, step = [], touch_env.step

    def noted(action):
        steps.append(step(action))
        return steps[-1]

    monkeypatch.setattr(touch_env, "step", noted)
    return steps


def drawn(seed):
    """Random actions; those of environment 1 are once not finite, which ends its episode for good."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (NUM_STEPS, NUM_ENVS, 2)).astype(np.float32)
    actions[3, 1, 0] = np.nan
    return actions


def on_host(value):
    return {name: on_host(part) for name, part in value.items()} if isinstance(value, dict) else value.cpu().numpy()


def test_arrays_are_what_the_step_has_brought(touch_env, made):
    """And the statistics of gymnasium are those of the environment: two episodes of each, and one of which half is left."""
    env = vector.RecordEpisodeStatistics(TouchVectorEnv(touch_env))
    env.reset(seed=7)
    touch_env.steps[2] = 5
    for action in drawn(0):
        obs, reward, terminated, truncated, told = env.step(action)
        step = made[-1]
        np.testing.assert_equal(obs, on_host(step.obs))
        for found, expected in zip((reward, terminated, truncated), step[1:4], strict=True):
            np.testing.assert_array_equal(found, expected.cpu().numpy())
        ended = step.info.ended.cpu().numpy()
        assert ("_final_obs" in told) == ended.any()
        for row in np.flatnonzero(ended):
            np.testing.assert_equal(told["final_obs"][row], {n: v[row].cpu().numpy() for n, v in step.info.final_obs.items()})
            final = told["final_info"]
            for name in ("score", "episode_return", "episode_steps", "faults"):
                assert final[name][row] == getattr(step.info, name)[row].item()
            np.testing.assert_allclose(told["episode"]["r"][row], final["episode_return"][row], atol=1e-6)
            if row != 2:
                assert told["episode"]["l"][row] == final["episode_steps"][row]
    assert env.episode_count == sum(int(step.info.ended.sum()) for step in made) == 2 * NUM_ENVS + 1


@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype")
def test_tensors_are_where_the_environment_is(touch_env, made):
    env = TouchVectorEnv(touch_env, output="torch")
    env.reset(seed=7)
    actions = torch.from_numpy(np.nan_to_num(drawn(1))).to(touch_env.device)
    is_cuda = touch_env.device.type == "cuda"
    if is_cuda:
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")
    try:
        given = [env.step(action) for action in actions]
    finally:
        if is_cuda:
            torch.cuda.set_sync_debug_mode("default")
    for (obs, reward, terminated, truncated, told), step in zip(given, made, strict=True):
        pairs = [(reward, step.reward), (terminated, step.terminated), (truncated, step.truncated)]
        pairs += [(obs[name], value) for name, value in step.obs.items()]
        pairs += [(told["final_obs"][name], value) for name, value in step.info.final_obs.items()]
        pairs += [(told[name], getattr(step.info, name)) for name in STEP_KEYS if name not in ("terms", "episode_terms")]
        pairs += [(told["_final_obs"], step.info.ended), (told["_score"], ~step.info.ended)]
        assert all(found.device == touch_env.device and torch.equal(found, expected) for found, expected in pairs)


def test_wrappers_of_actions_and_rewards(touch_env, made):
    env = vector.RescaleAction(TouchVectorEnv(touch_env), np.float32([-2, -2]), np.float32([2, 2]))
    env = vector.NormalizeReward(vector.TransformReward(vector.ClipAction(env), lambda reward: reward - 1), gamma=0.0)
    env.reset(seed=7)
    for action in np.nan_to_num(drawn(2)):
        reward = env.step(2 * action)[1]
        deviation = np.sqrt(env.return_rms.var + env.epsilon)
        np.testing.assert_allclose(reward, (made[-1].reward.cpu().numpy() - 1) / deviation, rtol=1e-5)
