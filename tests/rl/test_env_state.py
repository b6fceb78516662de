"""States of environments: saved, resumed, and refused by other environments."""

import pytest
import torch
from tiny_tasks import NOISY, RANDOM, actions, same, tiny_envs

from tgdsl.errors import SimulationError

STEPS = 12


@pytest.fixture
def make(tmp_path):
    yield from tiny_envs(tmp_path)


@pytest.mark.parametrize("joint_vel", ["exact", "measured"])
def test_resuming_is_exact_to_the_bit(make, joint_vel):
    more = NOISY + RANDOM + f"episode: 0.2 s\njoint_vel: {joint_vel}\n"
    env, other = make(more=more, seed=1), make(more=more, seed=9)
    for action in actions(env, 5):
        env.step(action)
    saved = env.state_dict()
    expected = [env.step(action) for action in actions(env, STEPS, 1)]
    for _ in range(3):
        other.step(torch.ones(4, 2))
    assert same(other.load_state_dict(saved), saved["obs"])
    for action, expected_result in zip(actions(env, STEPS, 1), expected, strict=True):
        result = other.step(action)
        assert same(result.obs, expected_result.obs) and torch.equal(result.reward, expected_result.reward)
        assert torch.equal(result.info.episode_return, expected_result.info.episode_return)
    with pytest.raises(SimulationError, match="of other environments"):
        make(5, more=more).load_state_dict(saved)
    fresh = make(more=more, seed=9)
    assert same(fresh.load_state_dict(saved), saved["obs"])
    assert torch.equal(fresh.step(actions(env, 1, 1)[0]).reward, expected[0].reward)


def test_a_state_saved_before_the_first_step_can_be_resumed_later(make):
    env = make(more=NOISY + RANDOM, seed=1)
    saved = env.state_dict()
    expected = [env.step(action) for action in actions(env, 3)]
    env.load_state_dict(saved)
    for action, expected_result in zip(actions(env, 3), expected, strict=True):
        result = env.step(action)
        assert same(result.obs, expected_result.obs) and torch.equal(
            result.info.episode_return, expected_result.info.episode_return
        )
        assert all(
            torch.equal(total, expected_result.info.episode_terms[name]) for name, total in result.info.episode_terms.items()
        )


def test_readings_are_available_one_step_after_loading_a_state(make):
    env = make(more="touch: depth\n", seed=1)
    saved = env.state_dict()
    env.load_state_dict(saved)
    for read in (lambda: env.now, env.images):
        with pytest.raises(SimulationError, match="a state was loaded: its readings are available after the next step"):
            read()
    env.step(torch.zeros(4, 2))
    assert env.now.object.pos.shape == (4, 3)


@pytest.mark.parametrize("is_begun", [False, True])
def test_a_refused_state_changes_nothing(make, is_begun):
    env, other = make(more=NOISY + RANDOM, seed=1), make(more=NOISY + RANDOM, seed=9)
    for environment in (env, other) if is_begun else (env,):
        environment.step(torch.ones(4, 2))
    saved, old_state = env.state_dict(), other.state_dict()
    cases = [({name: value for name, value in saved.items() if name != part}, part) for part in saved if part != "sim"]
    cases += [
        ({name: value for name, value in saved.items() if name != "sim"}, "the state of another simulation: state/time"),
        (saved | {"sim": dict(list(saved["sim"].items())[1:])}, "the state of another simulation: state/time missing"),
    ]
    for part in ("touch", "obs", "seed", "actuation"):
        match = f"is of other environments: .*{part} .* missing"
        cases.append((saved | {part: dict(list(saved[part].items())[1:])}, match))
    if is_begun:
        cases.append((saved | {"episodes": saved["episodes"] | {"sums/other": torch.zeros(4)}}, "episodes sums/other missing"))
    for state, match in cases:
        with pytest.raises(SimulationError, match=match):
            other.load_state_dict(state)
    new_state = other.state_dict()
    assert new_state.keys() == old_state.keys()
    for part, value in old_state.items():
        assert value.keys() == new_state[part].keys() and all(torch.equal(value[name], new_state[part][name]) for name in value)
    other.step(torch.ones(4, 2))
