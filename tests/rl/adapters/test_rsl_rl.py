"""The rsl_rl environment: its runner trains on it, and its log covers finished episodes."""

import importlib
import json
import sys

import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from small_tasks import DEVICES, STEPS, have_a_fault, small_task
from tensordict import TensorDict

from tgdsl.errors import TgdslError
from tgdsl.rl.adapters.rsl_rl import TouchVecEnv
from tgdsl.rl.env import TouchEnv

NUM_ENVS = 4


@pytest.fixture(scope="module", params=DEVICES)
def touch_env(request, tmp_path_factory):
    env = TouchEnv(small_task(tmp_path_factory.mktemp("rsl_rl")), NUM_ENVS, device=request.param)
    with pytest.warns(UserWarning, match="1 had controls that are not finite"):  # shown once, here
        have_a_fault(env)
    yield env
    env.close()


MLP = {"class_name": "MLPModel"}
LSTM = {"class_name": "RNNModel", "rnn_type": "lstm", "rnn_hidden_dim": 8, "rnn_num_layers": 1}


def runner_of(env, log_dir=None, groups=("proprio", "tactile_sensors", "goal"), model=MLP):
    """Return a PPO runner with small networks: a hand's observations for the actor, privileged ones for the critic."""
    network = model | {"hidden_dims": [16], "activation": "elu", "obs_normalization": True}
    actor = network | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}}
    config = {
        "num_steps_per_env": 12,
        "save_interval": 100,
        "obs_groups": {"actor": list(groups), "critic": ["priv_proprio", "priv_obj_state", "priv_obj_props", "goal"]},
        "actor": actor,
        "critic": dict(network),
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 2, "num_mini_batches": 2},
    }
    torch.manual_seed(0)
    return OnPolicyRunner(env, config, log_dir=None if log_dir is None else str(log_dir), device=str(env.device))


def logged_values(folder):
    """Return the values in a run's TensorBoard file by name."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_the_runner_trains(touch_env, tmp_path):
    """Two iterations change the policy; the log has their episodes: 4 of 8 steps in 12, then 8 in 12."""
    env = TouchVecEnv(touch_env)
    env.reset(seed=1)
    runner = runner_of(env, tmp_path)
    old_weights = [weight.clone() for weight in runner.alg.get_policy().parameters()]
    runner.learn(2)
    new_weights = list(runner.alg.get_policy().parameters())
    assert all(not torch.equal(old, new) and new.isfinite().all() for old, new in zip(old_weights, new_weights, strict=True))
    values = logged_values(tmp_path)
    assert values["Episode/steps"] == values["Train/mean_episode_length"] == [STEPS, STEPS]
    assert values["Episode/fault"] == [0, 0]
    terms = [sum(values[f"Reward/{name}"][i] for name in touch_env.step(torch.zeros(4, 2)).info.terms) for i in range(2)]
    assert values["Episode/return"] == pytest.approx(terms, abs=1e-6)
    assert values["Train/mean_reward"][0] == pytest.approx(values["Episode/return"][0], abs=1e-6)


def test_recurrent_networks_train_and_forget_finished_episodes(touch_env):
    """With rsl_rl's PPO and RNNModel: all weights change, including those of the memory."""
    env = TouchVecEnv(touch_env)
    env.reset(seed=1)
    runner = runner_of(env, model=LSTM)
    old_weights = {name: weight.clone() for name, weight in runner.alg.actor.named_parameters()}
    runner.learn(2)
    new_weights = dict(runner.alg.actor.named_parameters())
    assert any(name.startswith("rnn.") for name in new_weights)
    assert all(not torch.equal(old_weights[name], weight) and weight.isfinite().all() for name, weight in new_weights.items())
    with torch.inference_mode():
        runner.alg.actor(env.get_observations())
        hidden, cell = runner.alg.actor.get_hidden_state()
        assert hidden.abs().amax(dim=(0, 2)).min() > 0
        ended = torch.tensor([True, False, True, False], device=touch_env.device)
        runner.alg.actor.reset(ended)
    hidden, cell = runner.alg.actor.get_hidden_state()
    for memory in (hidden, cell):
        assert ((memory.abs().amax(dim=(0, 2)) == 0) == ended).all()


def test_the_environment_can_be_used_after_training(touch_env):
    """The runner collects in inference mode, yet the environment's state stays writable outside of it."""
    env = TouchVecEnv(touch_env)
    runner = runner_of(env)
    runner.learn(1, init_at_random_ep_len=True)
    assert not any(value.is_inference() for value in env.get_observations().values())
    env.reset(seed=1)
    env.step(torch.zeros(NUM_ENVS, 2))
    runner.learn(1, init_at_random_ep_len=True)


@pytest.mark.slow
def test_training_on_a_task_of_the_hand():
    """The README's example: the XHand1 with an object on its palm."""
    env = TouchVecEnv(TouchEnv("examples/tasks/in_palm_rotate.yaml", 2, overrides={"touch": "bool", "placement": "tips"}))
    runner_of(env).learn(1)
    env.close()


def test_time_outs_are_distinguished_from_terminations(touch_env):
    """A NaN terminates environment 1 at step 3; the others time out after 8 steps, environment 2 after 5."""
    env = TouchVecEnv(touch_env)
    env.reset(seed=2)
    env.episode_length_buf[2] = 3
    ends = {}
    for step in range(1, STEPS + 1):
        action = torch.zeros(NUM_ENVS, 2)
        action[1, 0] = torch.nan if step == 3 else 0.0
        _, reward, dones, extras = env.step(action)
        assert (dones.dtype, extras["time_outs"].dtype, reward.dtype) == (torch.int64, torch.bool, torch.float32)
        assert set(extras) == ({"time_outs", "log"} if dones.any() else {"time_outs"})
        if dones.any():
            log = {name: value.tolist() for name, value in extras["log"].items()}
            ends[step] = (dones.tolist(), extras["time_outs"].tolist(), log["Episode/steps"], log["Episode/fault"])
    assert ends == {
        3: ([0, 1, 0, 0], [False] * 4, [3], [1]),
        5: ([0, 0, 1, 0], [False, False, True, False], [8], [0]),
        8: ([1, 0, 0, 1], [True, False, False, True], [8, 8], [0, 0]),
    }


def test_the_log_covers_finished_episodes(touch_env):
    env = TouchVecEnv(touch_env)
    env.reset(seed=2)
    steps = [env.step(torch.full((NUM_ENVS, 2), 0.3)) for _ in range(STEPS - 1)]
    touch_env.task.memory["reached"].copy_(torch.arange(NUM_ENVS))  # pretend that many goals were reached
    steps.append(env.step(torch.full((NUM_ENVS, 2), 0.3)))
    log = steps[-1][3]["log"]
    torch.testing.assert_close(log["Episode/return"], torch.stack([reward for _, reward, *_ in steps]).sum(dim=0))
    terms = [value for name, value in log.items() if name.startswith("Reward/")]
    torch.testing.assert_close(torch.stack(terms).sum(dim=0), log["Episode/return"], atol=1e-6, rtol=1e-5)
    assert log["Episode/score"].tolist() == list(range(NUM_ENVS))


def test_observations_match_the_environments_groups(touch_env):
    """After the end of an episode they are the first ones of the next."""
    env = TouchVecEnv(touch_env)
    obs, extras = env.reset(seed=3)
    assert isinstance(obs, TensorDict) and extras == {}
    assert (obs.batch_size, {name: value.shape[1] for name, value in obs.items()}) == (torch.Size([NUM_ENVS]), touch_env.groups)
    copy = obs.clone()
    first = touch_env.reset(3)
    tolerance = 0.0 if env.device.type == "cpu" else 1e-4  # sums on a GPU have no fixed order
    for name, value in obs.items():
        torch.testing.assert_close(first[name], value, rtol=tolerance, atol=tolerance)
    for _ in range(STEPS):
        next_obs = env.step(torch.ones(NUM_ENVS, 2))[0]
        assert env.get_observations() is next_obs
        assert (obs == copy).all()  # not overwritten
    assert next_obs["proprio"].abs().max() == 0  # at rest, without a last action


def test_episode_lengths_can_be_read_and_written(touch_env):
    env = TouchVecEnv(touch_env)
    env.reset()
    assert env.max_episode_length == STEPS
    env.episode_length_buf = torch.tensor([0, 7, 6, 2])
    env.episode_length_buf[3] = 5
    ended = [env.step(torch.zeros(NUM_ENVS, 2))[2].tolist() for _ in range(3)]
    assert ended == [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert env.episode_length_buf.tolist() == [3, 2, 1, 0]


def test_attributes_that_the_runner_reads(touch_env):
    env = TouchVecEnv(touch_env)
    assert (env.num_envs, env.num_actions, env.device) == (NUM_ENVS, 2, touch_env.device)
    assert json.loads(json.dumps(env.cfg))["task"] == "in_palm_rotate"
    with pytest.raises(ValueError, match="'gaol' in observation set 'actor' not found"):
        runner_of(env, groups=("gaol",))


@pytest.mark.parametrize("missing", ["rsl_rl.env", "tensordict"])
def test_without_its_packages_the_error_names_what_to_install(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.delitem(sys.modules, "tgdsl.rl.adapters.rsl_rl")
    with pytest.raises(TgdslError, match=r'needs rsl-rl-lib and tensordict: pip install "tgdsl\[rl\]"'):
        importlib.import_module("tgdsl.rl.adapters.rsl_rl")
