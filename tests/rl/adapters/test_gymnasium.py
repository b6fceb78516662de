"""The gymnasium environment, compared with gymnasium's SyncVectorEnv on the same episodes."""

import importlib
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils import passive_env_checker
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector
from small_tasks import STEPS, small_task

from tgdsl.errors import SimulationError, TgdslError
from tgdsl.rl.adapters.gymnasium import STEP_KEYS, TouchVectorEnv
from tgdsl.rl.env import TouchEnv

NUM_ENVS, NUM_STEPS = 4, 2 * STEPS + 3


@pytest.fixture(scope="module")
def touch_env(tmp_path_factory):
    env = TouchEnv(small_task(tmp_path_factory.mktemp("gymnasium")), NUM_ENVS)
    with pytest.warns(UserWarning, match="1 had controls that are not finite"):  # shown once, here
        env.step(torch.tensor([[torch.nan, 0.0], *[[0.0, 0.0]] * (NUM_ENVS - 1)]))
    return env


@pytest.fixture(scope="module")
def actions():
    """Random actions; a NaN terminates an episode of environment 1."""
    values = np.random.default_rng(0).uniform(-1, 1, (NUM_STEPS, NUM_ENVS, 2)).astype(np.float32)
    values[3, 1, 0] = np.nan
    return values


def stagger(env):
    """Make the episodes of environment 2 end at other steps than the others."""
    env.steps[2] = 5


@pytest.fixture(scope="module")
def truth(touch_env, actions):
    """Observations of a reset and all steps, as tensors."""
    first = touch_env.reset(7)
    stagger(touch_env)
    return SimpleNamespace(first=first, steps=[touch_env.step(torch.from_numpy(action)) for action in actions])


class Row(gymnasium.Env):
    """One environment of `truth`, for SyncVectorEnv to step and reset."""

    def __init__(self, truth, env, space):
        self.truth, self.env, self.index = truth, env, -1
        self.observation_space, self.action_space = space, gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        obs = self.truth.first if self.index < 0 else self.truth.steps[self.index].obs
        return {name: value[self.env].numpy() for name, value in obs.items()}, {}

    def step(self, action):
        self.index += 1
        result, row = self.truth.steps[self.index], self.env
        info = result.info
        step_info = {"terms": {name: value[row].numpy()[()] for name, value in info.terms.items()}}
        step_info |= {"episode_terms": {name: value[row].numpy()[()] for name, value in info.episode_terms.items()}}
        step_info |= {name: getattr(info, name)[row].numpy()[()] for name in ("score", "episode_return", "episode_steps")}
        step_info["faults"] = bool(info.faults[row])
        obs = {name: value[row].numpy() for name, value in info.final_obs.items()}
        return obs, float(result.reward[row]), bool(result.terminated[row]), bool(result.truncated[row]), step_info


def assert_same(actual, expected, where=""):
    """Compare nested dictionaries and arrays, including types."""
    assert type(actual) is type(expected), where
    if isinstance(expected, dict):
        assert actual.keys() == expected.keys(), where
        for name, value in expected.items():
            assert_same(actual[name], value, f"{where}/{name}")
    elif isinstance(expected, tuple):
        assert_same(dict(enumerate(actual)), dict(enumerate(expected)), where)
    elif isinstance(expected, np.ndarray):
        assert (actual.dtype, actual.shape) == (expected.dtype, expected.shape), where
        if expected.dtype == object:
            for i, (actual_item, expected_item) in enumerate(zip(actual, expected, strict=True)):
                assert_same(actual_item, expected_item, f"{where}[{i}]")
        else:
            np.testing.assert_array_equal(actual, expected, err_msg=where)
    else:
        assert actual == expected, where


def test_it_equals_sync_vector_env(touch_env, truth, actions):
    """Observations, rewards, ends and all of `info`: final observations, nesting, masks, zeros, dtypes, keys."""
    env = TouchVectorEnv(touch_env)
    rows = [lambda i=i: Row(truth, i, env.single_observation_space) for i in range(NUM_ENVS)]
    reference = SyncVectorEnv(rows, autoreset_mode=AutoresetMode.SAME_STEP)
    assert_same(env.reset(seed=7), reference.reset())
    stagger(touch_env)
    ends = []
    for action in actions:
        actual, expected = env.step(action), reference.step(action)
        assert_same(actual[0], expected[0])
        np.testing.assert_array_equal(actual[1], expected[1].astype(np.float32))
        assert_same(actual[2:], expected[2:])
        ends.append((list(np.flatnonzero(actual[2])), list(np.flatnonzero(actual[3]))))
    expected = {2: ([], [2]), 3: ([1], []), 7: ([], [0, 3]), 10: ([], [2]), 11: ([], [1]), 15: ([], [0, 3]), 18: ([], [2])}
    assert {step: envs for step, envs in enumerate(ends) if envs != ([], [])} == expected


def test_spaces(touch_env):
    env = TouchVectorEnv(touch_env)
    assert list(env.single_observation_space.spaces) == list(touch_env.groups)
    assert {name: box.shape for name, box in env.single_observation_space.spaces.items()} == {
        name: (size,) for name, size in touch_env.groups.items()
    }
    assert env.action_space.shape == (NUM_ENVS, touch_env.num_actions) == (NUM_ENVS, 2)
    assert env.single_action_space.low.tolist() == [-1, -1] and env.single_action_space.high.tolist() == [1, 1]
    assert (env.metadata["autoreset_mode"], env.num_envs) == (AutoresetMode.SAME_STEP, NUM_ENVS)
    obs, info = env.reset(seed=1)
    assert obs in env.observation_space and info == {}
    assert env.step(env.action_space.sample())[0] in env.observation_space
    row = {name: value[0] for name, value in obs.items()}
    passive_env_checker.check_obs(row, env.single_observation_space, "reset")
    for space, kind in ((env.single_observation_space, "observation"), (env.single_action_space, "action")):
        check = getattr(passive_env_checker, f"_check_box_{kind}_space")
        passive_env_checker.check_space(space, kind, check)


def test_a_seed_gives_the_same_episodes(touch_env, actions):
    env = TouchVectorEnv(touch_env)

    def play(seed):
        first, _ = env.reset(seed=seed)
        return [first, *(env.step(action)[0] for action in actions)]

    first_run, repeated, other = play(3), play(np.int64(3)), play(4)
    assert_same(dict(enumerate(repeated)), dict(enumerate(first_run)))
    assert not np.array_equal(other[0]["priv_obj_state"], first_run[0]["priv_obj_state"])
    assert env.np_random_seed == 4
    np.testing.assert_raises(AssertionError, np.testing.assert_array_equal, env.reset()[0]["goal"], other[0]["goal"])


def test_returned_observations_are_not_overwritten(touch_env, actions):
    env = TouchVectorEnv(touch_env)
    obs, _ = env.reset(seed=3)
    copy = {name: value.copy() for name, value in obs.items()}
    for action in actions:
        result = env.step(action)
        assert_same(obs, copy)
        obs, copy = result[0], {name: value.copy() for name, value in result[0].items()}


def test_tensors_equal_arrays(touch_env, actions):
    """Masks are always present; rows that they leave out are undefined."""
    arrays, tensors = TouchVectorEnv(touch_env), TouchVectorEnv(touch_env, output="torch")
    arrays.reset(seed=7)
    expected = [arrays.step(action) for action in actions]
    first, info = tensors.reset(seed=7)
    assert info == {} and all(isinstance(value, torch.Tensor) for value in first.values())
    for action, (obs, reward, terminated, truncated, expected_info) in zip(actions, expected, strict=True):
        result = tensors.step(torch.from_numpy(action))
        assert_same({name: value.numpy() for name, value in result[0].items()}, obs)
        assert_same(tuple(value.numpy() for value in result[1:4]), (reward, terminated, truncated))
        ended, info = terminated | truncated, result[4]
        assert_same(info["_final_obs"].numpy(), ended)
        assert_same(info["_score"].numpy(), ~ended)
        assert set(info) == {
            *STEP_KEYS,
            *(f"_{name}" for name in STEP_KEYS),
            *("final_obs", "_final_obs", "final_info", "_final_info"),
        }
        if ended.any():
            terms = expected_info["final_info"]["episode_terms"]
            for name, value in info["final_info"]["episode_terms"].items():
                np.testing.assert_array_equal(value.numpy()[ended], terms[name][ended])
            for row in np.flatnonzero(ended):
                assert_same(
                    {name: value[row].numpy() for name, value in info["final_obs"].items()}, expected_info["final_obs"][row]
                )


def test_only_the_chosen_groups_are_returned_in_order(touch_env, actions):
    env = TouchVectorEnv(touch_env, groups=("goal", "proprio"))
    assert list(env.single_observation_space.spaces) == ["goal", "proprio"]
    assert list(env.reset(seed=1)[0]) == ["goal", "proprio"]
    infos = [env.step(action)[4] for action in actions]
    final_obs = next(info["final_obs"][0] for info in infos if "final_obs" in info and info["final_obs"][0] is not None)
    assert list(final_obs) == ["goal", "proprio"]


def test_actions_of_other_types_are_accepted(touch_env, actions):
    env = TouchVectorEnv(touch_env)

    def obs_after(action):
        env.reset(seed=5)
        return env.step(action)[0]

    expected = obs_after(actions[0])
    for action in (
        actions[0].astype(np.float64),
        torch.from_numpy(actions[0]),
        actions[0].tolist(),
        np.asfortranarray(actions[0]),
    ):
        assert_same(obs_after(action), expected)


# Wrappers


def test_infos_can_be_a_list(touch_env, truth, actions):
    env = vector.DictInfoToList(TouchVectorEnv(touch_env))
    assert env.reset(seed=7)[1] == [{}] * NUM_ENVS
    stagger(touch_env)
    for action, result in zip(actions, truth.steps, strict=True):
        for row, info in enumerate(env.step(action)[4]):
            ended = bool(result.info.ended[row])
            assert set(info) == ({"final_obs", "final_info"} if ended else set(STEP_KEYS))
            episode_info = info["final_info"] if ended else info
            assert episode_info["terms"]["tilt"] == result.info.terms["tilt"][row]
            assert episode_info["episode_steps"] == result.info.episode_steps[row]


@pytest.mark.parametrize("wrapper", [vector.FlattenObservation, vector.NormalizeObservation])
def test_gymnasiums_observation_wrappers_refuse_this_autoreset_mode(touch_env, wrapper):
    with pytest.raises(ValueError, match=r"NEXT_STEP.*SAME_STEP"):
        wrapper(TouchVectorEnv(touch_env))


# Wrong use


def test_wrong_use_is_refused(touch_env):
    env = TouchVectorEnv(touch_env)
    cases = [
        (lambda: TouchVectorEnv(touch_env, output="jax"), 'output is "jax", expected "numpy" or "torch"'),
        (lambda: TouchVectorEnv(touch_env, groups=("gaol",)), 'there is no group of observations "gaol"; did you mean "goal"?'),
        (lambda: env.reset(seed=[1, 2, 3, 4]), "seed is [1, 2, 3, 4]: expected one whole number for all environments, which"),
        (lambda: env.reset(options={"reset_mask": None}), "reset has no options, found 'reset_mask': all environments"),
    ]
    for call, message in cases:
        with pytest.raises(TgdslError) as raised:
            call()
        assert str(raised.value).startswith(message)
    with pytest.raises(SimulationError, match=r"action has shape \(4, 3\), expected \(4, 2\)"):
        env.step(np.zeros((4, 3)))


def test_without_gymnasium_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium.spaces", None)
    monkeypatch.delitem(sys.modules, "tgdsl.rl.adapters.gymnasium")
    with pytest.raises(TgdslError, match=r'needs gymnasium: pip install "tgdsl\[rl\]"'):
        importlib.import_module("tgdsl.rl.adapters.gymnasium")


def test_close_closes_the_environment(tmp_path):
    touch_env = TouchEnv(small_task(tmp_path), 1)
    env = TouchVectorEnv(touch_env)
    env.close()
    assert env.closed
    with pytest.raises(SimulationError):
        touch_env.reset()
