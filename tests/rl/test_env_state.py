"""States of environments: saved, gone on from, and refused where they are of others."""

import pytest
import torch
from tiny_tasks import NOISY, RANDOM, actions, same, tiny_envs

from tgdsl.errors import SimulationError

STEPS = 12


@pytest.fixture
def make(tmp_path):
    yield from tiny_envs(tmp_path)


@pytest.mark.parametrize("joint_vel", ["exact", "measured"])
def test_stop_and_go_on_is_bit_for_bit(make, joint_vel):
    more = NOISY + RANDOM + f"episode: 0.2 s\njoint_vel: {joint_vel}\n"
    env, other = make(more=more, seed=1), make(more=more, seed=9)
    for action in actions(env, 5):
        env.step(action)
    saved = env.state_dict()
    expected = [env.step(action) for action in actions(env, STEPS, 1)]
    for _ in range(3):
        other.step(torch.ones(4, 2))
    assert same(other.load_state_dict(saved), saved["obs"])
    for action, before in zip(actions(env, STEPS, 1), expected, strict=True):
        made = other.step(action)
        assert same(made.obs, before.obs) and torch.equal(made.reward, before.reward)
        assert torch.equal(made.info.episode_return, before.info.episode_return)
    with pytest.raises(SimulationError, match="of other environments"):
        make(5, more=more).load_state_dict(saved)
    fresh = make(more=more, seed=9)
    assert same(fresh.load_state_dict(saved), saved["obs"])
    assert torch.equal(fresh.step(actions(env, 1, 1)[0]).reward, expected[0].reward)


def test_a_state_from_before_the_first_step_is_gone_on_from_after_some(make):
    env = make(more=NOISY + RANDOM, seed=1)
    saved = env.state_dict()
    expected = [env.step(action) for action in actions(env, 3)]
    env.load_state_dict(saved)
    for action, before in zip(actions(env, 3), expected, strict=True):
        made = env.step(action)
        assert same(made.obs, before.obs) and torch.equal(made.info.episode_return, before.info.episode_return)
        assert all(torch.equal(total, before.info.episode_terms[name]) for name, total in made.info.episode_terms.items())


def test_what_is_read_is_there_again_after_a_loaded_states_next_step(make):
    env = make(more="touch: depth\n", seed=1)
    saved = env.state_dict()
    env.load_state_dict(saved)
    for told in (lambda: env.now, env.images):
        with pytest.raises(SimulationError, match="a state was loaded: its readings are available after the next step"):
            told()
    env.step(torch.zeros(4, 2))
    assert env.now.object.pos.shape == (4, 3)


@pytest.mark.parametrize("is_begun", [False, True])
def test_a_state_of_other_environments_changes_nothing(make, is_begun):
    env, other = make(more=NOISY + RANDOM, seed=1), make(more=NOISY + RANDOM, seed=9)
    for each in (env, other) if is_begun else (env,):
        each.step(torch.ones(4, 2))
    saved, before = env.state_dict(), other.state_dict()
    cases = [({name: own for name, own in saved.items() if name != part}, part) for part in saved if part != "sim"]
    cases += [
        ({name: own for name, own in saved.items() if name != "sim"}, "the state of another simulation: state/time"),
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
    after = other.state_dict()
    assert after.keys() == before.keys()
    for part, own in before.items():
        assert own.keys() == after[part].keys() and all(torch.equal(own[name], after[part][name]) for name in own)
    other.step(torch.ones(4, 2))
