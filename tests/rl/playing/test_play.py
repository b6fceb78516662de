"""Who acts, what is kept of it, and what is shown."""

import numpy as np
import pytest
import torch
from small_tasks import STEPS, small_task

from tgdsl.errors import SimulationError
from tgdsl.rl.draws import Draws
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.record import PlayRecord, Tally
from tgdsl.rl.playing.rollout import ScriptError, actor_of, check_actions, rollout, steps_of

NUM_ENVS = 3


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    return TouchEnv(small_task(tmp_path_factory.mktemp("playing")), NUM_ENVS)


@pytest.fixture
def script(tmp_path):
    """Write a script; return what names its function `act`."""

    def written(text):
        (tmp_path / "my script.py").write_text(text)
        return f"{tmp_path}/my script.py:act"

    return written


# Who acts


def test_nobody_and_chance(env):
    obs = env.reset(0)
    assert torch.equal(actor_of(env, "zero")(obs), torch.zeros(NUM_ENVS, 2))
    chance = actor_of(env, "random", seed=5)
    once, again = chance(obs), chance(obs)
    assert once.shape == (NUM_ENVS, 2) and once.abs().max() <= 1 and once.min() < 0 < once.max()
    assert not torch.equal(once, again)
    assert torch.equal(actor_of(env, "random", seed=5)(obs), once)
    assert not torch.equal(actor_of(env, "random", seed=6)(obs), once)
    assert torch.equal(actor_of(env, "random")(obs), actor_of(env, "random", seed=0)(obs))
    one = Draws(5, 1, first_env=2).uniform("played actions", torch.tensor([2]), 2, -1.0, 1.0)
    assert torch.equal(again[2:], one)  # the same for an environment however many there are


def test_a_script_is_given_the_environment_and_its_observations(env, script):
    name = script("def act(env, obs):\n    return obs['proprio'][:, :2] + 0.1 * env.steps[:, None]\n")
    check_actions(name)
    env.reset(0)
    obs = env.step(torch.ones(NUM_ENVS, 2)).obs
    torch.testing.assert_close(actor_of(env, name)(obs), obs["proprio"][:, :2] + 0.1)
    listed = actor_of(env, script("def act(env, obs):\n    return [[0, 0.5]] * env.num_envs\n"))(obs)
    assert listed.tolist() == [[0, 0.5]] * NUM_ENVS


def test_the_task_s_own_script(env, monkeypatch):
    with pytest.raises(ScriptError, match='the task "in_palm_rotate" has no script'):
        actor_of(env, "script")
    monkeypatch.setattr(type(env.task), "script", lambda self, obs: -obs["proprio"][:, :2], raising=False)
    obs = env.step(torch.ones(NUM_ENVS, 2)).obs
    assert torch.equal(actor_of(env, "script")(obs), -obs["proprio"][:, :2])


def test_scripts_that_cannot_be_had(script, tmp_path):
    check_actions("script")
    cases = {
        "zeros": 'there are no actions "zeros", expected zero, random, script or FILE.py:FUNCTION',
        f"{tmp_path}/none.py:act": f"{tmp_path}/none.py: there is no such file",
        script("def acts(env, obs): ...\n"): f'{tmp_path}/my script.py: there is no function "act"; did you mean "acts"?',
    }
    for name, message in cases.items():
        if "my script" in name:
            script("def acts(env, obs): ...\n")
        with pytest.raises(ScriptError) as raised:
            check_actions(name)
        assert str(raised.value) == message
    for text, message in {"x = 1\nact = y\n": ":2: NameError: name 'y'", "def act(:\n": ":1: SyntaxError: "}.items():
        with pytest.raises(ScriptError) as raised:
            check_actions(script(text))
        assert str(raised.value).startswith(f"{tmp_path}/my script.py{message}")


def test_scripts_that_do_wrong(env, script, tmp_path):
    obs = env.reset(0)
    file = f"{tmp_path}/my script.py"
    cases = {
        "def act(env, obs):\n    return obs['gaol']\n": f"{file}:2: act: KeyError: 'gaol'",
        "def act(env, obs):\n    return obs['goal']\n": "act: actions have shape (3, 7), expected (3, 2)",
        "def act(env, obs):\n    pass\n": "act: actions are NoneType, expected (3, 2) numbers",
        "def act(env):\n    pass\n": f"{file}: act: TypeError: act() takes 1 positional argument but 2 were given",
    }
    for text, message in cases.items():
        actor = actor_of(env, script(text))
        with pytest.raises(ScriptError) as raised:
            actor(obs)
        assert str(raised.value) == message


# What is kept


def played(env, actions="random", steps=2 * STEPS + 2):
    env.reset(4)
    record, tally, kept = PlayRecord(env, steps), Tally(env), []
    for each in rollout(actor_of(env, actions, 1), env, steps):
        record.add(each)
        tally.add(each.step.info)
        kept.append(each)
    return record, tally, kept


def test_steps(env):
    assert (steps_of(env, None), steps_of(env, 0.3), steps_of(env, 1e-9)) == (STEPS, 12, 1)
    for seconds in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(SimulationError, match=r"expected more than 0 s"):
            steps_of(env, seconds)


def test_a_record_holds_what_happened(env, tmp_path):
    """Stepped again with its actions, the environments do the same."""
    record, _, kept = played(env)
    record.write(tmp_path / "played.npz")
    with np.load(tmp_path / "played.npz") as file:
        found = dict(file)
    count = len(kept)
    np.testing.assert_allclose(found["time"], 0.025 * np.arange(count))
    assert (found["joints"].tolist(), str(found["score_unit"])) == (["swing", "bend"], "quarter turns")
    obs, ended = env.reset(4), []
    for i in range(count):
        for group, value in obs.items():
            np.testing.assert_array_equal(found[f"obs:{group}"][i], value)
        np.testing.assert_array_equal(found["qpos"][i], env.sim.qpos)
        if i % STEPS == 0:  # at the start of episodes observations are of the same instant
            np.testing.assert_allclose(found["qpos"][i][:, :2], found["obs:proprio"][i][:, :2], atol=1e-6)
        result = env.step(torch.from_numpy(found["action"][i]))
        obs, info = result.obs, result.info
        for name in ("reward", "terminated", "truncated"):
            np.testing.assert_array_equal(found[name][i], getattr(result, name))
        np.testing.assert_array_equal(found["score"][i], info.score)
        assert not found["fault"][i].any()
        ended += [(i, row) for row in info.ended.nonzero()[:, 0].tolist()]
    terms = sum(value for name, value in found.items() if name.startswith("term:"))
    np.testing.assert_allclose(terms, found["reward"], atol=1e-6)
    assert list(zip(found["ended:step"], found["ended:env"], strict=True)) == ended and len(ended) == 2 * NUM_ENVS
    returns = [found["reward"][i - STEPS + 1 : i + 1, row].sum() for i, row in ended]
    np.testing.assert_allclose(found["ended:return"], returns, atol=1e-6)
    assert found["ended:steps"].tolist() == [STEPS] * len(ended)
    last = np.stack([kept[i].step.info.final_obs["goal"][row] for i, row in ended])
    np.testing.assert_array_equal(found["ended:obs:goal"], last)


def test_a_record_beyond_all_memory(env):
    with pytest.raises(SimulationError, match="records of 3 environments at 1000000000000 steps need about"):
        PlayRecord(env, 10**12)


def test_a_record_without_an_end(env, tmp_path):
    record, tally, _ = played(env, "zero", 2)
    record.write(tmp_path / "played.npz")
    with np.load(tmp_path / "played.npz") as found:
        assert found["ended:obs:goal"].shape == (0, 7)
    assert tally.lines(0.05)[3].split()[-1] == "–"


# What is shown


def test_a_tally_shows_means_of_the_present_episodes_and_of_those_that_have_ended(env):
    _, tally, kept = played(env)
    lines = tally.lines(0.45)
    assert lines[0] == "t = 0.45 s, 3 environments, 6 episodes ended"
    assert lines[1].split() == ["mean", "over", "environments", "so", "far", "ended"]
    shown = {" ".join(line.split()[:-2]): line.split()[-2:] for line in lines[3:]}
    now = torch.stack([each.step.reward for each in kept[-2:]]).sum(dim=0).mean()
    over = torch.stack([each.step.reward for each in kept[:-2]]).sum(dim=0).mean() / 2
    assert shown["return"] == [f"{now:.3g}", f"{over:.3g}"]
    assert shown["score [quarter turns]"] == ["0", "0"]
    assert list(shown)[2:] == list(kept[0].step.info.terms)
    tilt = torch.stack([each.step.info.terms["tilt"] for each in kept[:-2]]).sum(dim=0).mean() / 2
    assert float(shown["tilt"][1]) == pytest.approx(float(tilt), rel=6e-3)


def test_faults_are_counted(env, script):
    actor = "def act(env, obs):\n    return [[float('nan') if env.steps[1] == 3 else 0] * 2, [0, 0], [0, 0]]\n"
    tally = Tally(env)
    env.reset(0)
    steps = rollout(actor_of(env, script(actor)), env, 5)
    with pytest.warns(UserWarning, match="not finite"):
        infos = [each.step.info for each in steps]
    for info in infos:
        tally.add(info)
    assert tally.lines(0.125)[0] == "t = 0.12 s, 3 environments, 1 episodes ended, 1 by a fault"
