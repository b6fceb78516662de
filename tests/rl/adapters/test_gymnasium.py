"""The environment of gymnasium: what it gives is what gymnasium's own SyncVectorEnv makes of the same episodes."""

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
    with pytest.warns(UserWarning, match="1 had controls that are not finite"):  # said once, here
        env.step(torch.tensor([[torch.nan, 0.0], *[[0.0, 0.0]] * (NUM_ENVS - 1)]))
    return env


@pytest.fixture(scope="module")
def actions():
    """Random actions; those of environment 1 are once not finite, which ends its episode for good."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (NUM_STEPS, NUM_ENVS, 2)).astype(np.float32)
    drawn[3, 1, 0] = np.nan
    return drawn


def staggered(env):
    """Let environment 2 end its episodes at other steps than the others."""
    env.steps[2] = 5


@pytest.fixture(scope="module")
def truth(touch_env, actions):
    """The observations of a reset, and all steps, as tensors."""
    first = touch_env.reset(7)
    staggered(touch_env)
    return SimpleNamespace(first=first, steps=[touch_env.step(torch.from_numpy(action)) for action in actions])


class Row(gymnasium.Env):
    """One environment of the truth, which SyncVectorEnv steps and resets."""

    def __init__(self, truth, env, space):
        self.truth, self.env, self.index = truth, env, -1
        self.observation_space, self.action_space = space, gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        obs = self.truth.first if self.index < 0 else self.truth.steps[self.index].obs
        return {name: value[self.env].numpy() for name, value in obs.items()}, {}

    def step(self, action):
        self.index += 1
        made, row = self.truth.steps[self.index], self.env
        info = made.info
        told = {"terms": {name: value[row].numpy()[()] for name, value in info.terms.items()}}
        told |= {"episode_terms": {name: value[row].numpy()[()] for name, value in info.episode_terms.items()}}
        told |= {name: getattr(info, name)[row].numpy()[()] for name in ("score", "episode_return", "episode_steps")}
        told["faults"] = bool(info.faults[row])
        obs = {name: value[row].numpy() for name, value in info.final_obs.items()}
        return obs, float(made.reward[row]), bool(made.terminated[row]), bool(made.truncated[row]), told


def same(found, expected, where=""):
    """Compare nested dictionaries and arrays, types and all."""
    assert type(found) is type(expected), where
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), where
        for name, value in expected.items():
            same(found[name], value, f"{where}/{name}")
    elif isinstance(expected, tuple):
        same(dict(enumerate(found)), dict(enumerate(expected)), where)
    elif isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape), where
        if expected.dtype == object:
            for i, (mine, theirs) in enumerate(zip(found, expected, strict=True)):
                same(mine, theirs, f"{where}[{i}]")
        else:
            np.testing.assert_array_equal(found, expected, err_msg=where)
    else:
        assert found == expected, where


def test_it_gives_what_sync_vector_env_makes_of_the_same_episodes(touch_env, truth, actions):
    """Observations, rewards, ends, and all of `info`: final observations, nested dictionaries, masks, zeros, dtypes, keys."""
    env = TouchVectorEnv(touch_env)
    rows = [lambda i=i: Row(truth, i, env.single_observation_space) for i in range(NUM_ENVS)]
    reference = SyncVectorEnv(rows, autoreset_mode=AutoresetMode.SAME_STEP)
    same(env.reset(seed=7), reference.reset())
    staggered(touch_env)
    ends = []
    for action in actions:
        found, expected = env.step(action), reference.step(action)
        same(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1].astype(np.float32))
        same(found[2:], expected[2:])
        ends.append((list(np.flatnonzero(found[2])), list(np.flatnonzero(found[3]))))
    expected = {2: ([], [2]), 3: ([1], []), 7: ([], [0, 3]), 10: ([], [2]), 11: ([], [1]), 15: ([], [0, 3]), 18: ([], [2])}
    assert {step: which for step, which in enumerate(ends) if which != ([], [])} == expected


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

    def played(seed):
        first, _ = env.reset(seed=seed)
        return [first, *(env.step(action)[0] for action in actions)]

    once, again, other = played(3), played(np.int64(3)), played(4)
    same(dict(enumerate(again)), dict(enumerate(once)))
    assert not np.array_equal(other[0]["priv_obj_state"], once[0]["priv_obj_state"])
    assert env.np_random_seed == 4
    np.testing.assert_raises(AssertionError, np.testing.assert_array_equal, env.reset()[0]["goal"], other[0]["goal"])


def test_what_was_handed_out_stays_as_it_was(touch_env, actions):
    env = TouchVectorEnv(touch_env)
    given, _ = env.reset(seed=3)
    before = {name: value.copy() for name, value in given.items()}
    for action in actions:
        result = env.step(action)
        same(given, before)
        given, before = result[0], {name: value.copy() for name, value in result[0].items()}


def test_tensors_are_the_same_numbers(touch_env, actions):
    """Rows that masks leave out mean nothing; masks are always there."""
    arrays, tensors = TouchVectorEnv(touch_env), TouchVectorEnv(touch_env, output="torch")
    arrays.reset(seed=7)
    expected = [arrays.step(action) for action in actions]
    first, info = tensors.reset(seed=7)
    assert info == {} and all(isinstance(value, torch.Tensor) for value in first.values())
    for action, (obs, reward, terminated, truncated, told) in zip(actions, expected, strict=True):
        result = tensors.step(torch.from_numpy(action))
        same({name: value.numpy() for name, value in result[0].items()}, obs)
        same(tuple(value.numpy() for value in result[1:4]), (reward, terminated, truncated))
        ended, info = terminated | truncated, result[4]
        same(info["_final_obs"].numpy(), ended)
        same(info["_score"].numpy(), ~ended)
        assert set(info) == {
            *STEP_KEYS,
            *(f"_{name}" for name in STEP_KEYS),
            *("final_obs", "_final_obs", "final_info", "_final_info"),
        }
        if ended.any():
            terms = told["final_info"]["episode_terms"]
            for name, value in info["final_info"]["episode_terms"].items():
                np.testing.assert_array_equal(value.numpy()[ended], terms[name][ended])
            for row in np.flatnonzero(ended):
                same({name: value[row].numpy() for name, value in info["final_obs"].items()}, told["final_obs"][row])


def test_chosen_groups_alone_in_their_order(touch_env, actions):
    env = TouchVectorEnv(touch_env, groups=("goal", "proprio"))
    assert list(env.single_observation_space.spaces) == ["goal", "proprio"]
    assert list(env.reset(seed=1)[0]) == ["goal", "proprio"]
    infos = [env.step(action)[4] for action in actions]
    given = next(info["final_obs"][0] for info in infos if "final_obs" in info and info["final_obs"][0] is not None)
    assert list(given) == ["goal", "proprio"]


def test_actions_of_other_types(touch_env, actions):
    env = TouchVectorEnv(touch_env)

    def after(action):
        env.reset(seed=5)
        return env.step(action)[0]

    expected = after(actions[0])
    for action in (
        actions[0].astype(np.float64),
        torch.from_numpy(actions[0]),
        actions[0].tolist(),
        np.asfortranarray(actions[0]),
    ):
        same(after(action), expected)


# Wrappers


def test_infos_as_a_list(touch_env, truth, actions):
    env = vector.DictInfoToList(TouchVectorEnv(touch_env))
    assert env.reset(seed=7)[1] == [{}] * NUM_ENVS
    staggered(touch_env)
    for action, made in zip(actions, truth.steps, strict=True):
        for row, info in enumerate(env.step(action)[4]):
            ended = bool(made.info.ended[row])
            assert set(info) == ({"final_obs", "final_info"} if ended else set(STEP_KEYS))
            told = info["final_info"] if ended else info
            assert told["terms"]["tilt"] == made.info.terms["tilt"][row]
            assert told["episode_steps"] == made.info.episode_steps[row]


@pytest.mark.parametrize("wrapper", [vector.FlattenObservation, vector.NormalizeObservation])
def test_wrappers_of_observations_refuse_this_mode_of_anyone(touch_env, wrapper):
    with pytest.raises(ValueError, match=r"NEXT_STEP.*SAME_STEP"):
        wrapper(TouchVectorEnv(touch_env))


# Wrong use


def test_wrong_use(touch_env):
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


def test_close(tmp_path):
    touch_env = TouchEnv(small_task(tmp_path), 1)
    env = TouchVectorEnv(touch_env)
    env.close()
    assert env.closed
    with pytest.raises(SimulationError):
        touch_env.reset()
