"""Actors, records and tallies of playing."""

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
    """Return a function that writes a script and returns the reference to its `act`."""

    def write_script(text):
        (tmp_path / "my script.py").write_text(text)
        return f"{tmp_path}/my script.py:act"

    return write_script


# Actors


def test_zero_and_random_actors(env):
    obs = env.reset(0)
    assert torch.equal(actor_of(env, "zero")(obs), torch.zeros(NUM_ENVS, 2))
    actor = actor_of(env, "random", seed=5)
    first, second = actor(obs), actor(obs)
    assert first.shape == (NUM_ENVS, 2) and first.abs().max() <= 1 and first.min() < 0 < first.max()
    assert not torch.equal(first, second)
    assert torch.equal(actor_of(env, "random", seed=5)(obs), first)
    assert not torch.equal(actor_of(env, "random", seed=6)(obs), first)
    assert torch.equal(actor_of(env, "random")(obs), actor_of(env, "random", seed=0)(obs))
    alone = Draws(5, 1, first_env=2).uniform("played actions", torch.tensor([2]), 2, -1.0, 1.0)
    assert torch.equal(second[2:], alone)  # does not depend on the number of environments


def test_a_script_receives_the_environment_and_its_observations(env, script):
    name = script("def act(env, obs):\n    return obs['proprio'][:, :2] + 0.1 * env.steps[:, None]\n")
    check_actions(name)
    env.reset(0)
    obs = env.step(torch.ones(NUM_ENVS, 2)).obs
    torch.testing.assert_close(actor_of(env, name)(obs), obs["proprio"][:, :2] + 0.1)
    list_action = actor_of(env, script("def act(env, obs):\n    return [[0, 0.5]] * env.num_envs\n"))(obs)
    assert list_action.tolist() == [[0, 0.5]] * NUM_ENVS


def test_a_tasks_built_in_script(env, monkeypatch):
    with pytest.raises(ScriptError, match='the task "in_palm_rotate" has no script'):
        actor_of(env, "script")
    monkeypatch.setattr(type(env.task), "script", lambda self, obs: -obs["proprio"][:, :2], raising=False)
    obs = env.step(torch.ones(NUM_ENVS, 2)).obs
    assert torch.equal(actor_of(env, "script")(obs), -obs["proprio"][:, :2])


def test_missing_and_broken_scripts_are_reported(script, tmp_path):
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


def test_errors_in_scripts_are_reported(env, script, tmp_path):
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


# Records


def play(env, actions="random", steps=2 * STEPS + 2):
    env.reset(4)
    record, tally, frames = PlayRecord(env, steps), Tally(env), []
    for frame in rollout(actor_of(env, actions, 1), env, steps):
        record.add(frame)
        tally.add(frame.step.info)
        frames.append(frame)
    return record, tally, frames


def test_number_of_steps_from_seconds(env):
    assert (steps_of(env, None), steps_of(env, 0.3), steps_of(env, 1e-9)) == (STEPS, 12, 1)
    for seconds in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(SimulationError, match=r"expected more than 0 s"):
            steps_of(env, seconds)


def test_a_record_can_be_replayed(env, tmp_path):
    """Stepping the recorded actions reproduces everything."""
    record, _, frames = play(env)
    record.write(tmp_path / "played.npz")
    with np.load(tmp_path / "played.npz") as file:
        record_arrays = dict(file)
    count = len(frames)
    np.testing.assert_allclose(record_arrays["time"], 0.025 * np.arange(count))
    assert (record_arrays["joints"].tolist(), str(record_arrays["score_unit"])) == (["swing", "bend"], "quarter turns")
    obs, ended = env.reset(4), []
    for i in range(count):
        for group, value in obs.items():
            np.testing.assert_array_equal(record_arrays[f"obs:{group}"][i], value)
        np.testing.assert_array_equal(record_arrays["qpos"][i], env.sim.qpos)
        if i % STEPS == 0:  # at an episode's start observations have no delay
            np.testing.assert_allclose(record_arrays["qpos"][i][:, :2], record_arrays["obs:proprio"][i][:, :2], atol=1e-6)
        result = env.step(torch.from_numpy(record_arrays["action"][i]))
        obs, info = result.obs, result.info
        for name in ("reward", "terminated", "truncated"):
            np.testing.assert_array_equal(record_arrays[name][i], getattr(result, name))
        np.testing.assert_array_equal(record_arrays["score"][i], info.score)
        assert not record_arrays["fault"][i].any()
        ended += [(i, row) for row in info.ended.nonzero()[:, 0].tolist()]
    terms = sum(value for name, value in record_arrays.items() if name.startswith("term:"))
    np.testing.assert_allclose(terms, record_arrays["reward"], atol=1e-6)
    assert (
        list(zip(record_arrays["ended:step"], record_arrays["ended:env"], strict=True)) == ended and len(ended) == 2 * NUM_ENVS
    )
    returns = [record_arrays["reward"][i - STEPS + 1 : i + 1, row].sum() for i, row in ended]
    np.testing.assert_allclose(record_arrays["ended:return"], returns, atol=1e-6)
    assert record_arrays["ended:steps"].tolist() == [STEPS] * len(ended)
    last = np.stack([frames[i].step.info.final_obs["goal"][row] for i, row in ended])
    np.testing.assert_array_equal(record_arrays["ended:obs:goal"], last)


def test_a_record_that_exceeds_memory_is_refused(env):
    with pytest.raises(SimulationError, match="records of 3 environments at 1000000000000 steps need about"):
        PlayRecord(env, 10**12)


def test_a_record_without_finished_episodes(env, tmp_path):
    record, tally, _ = play(env, "zero", 2)
    record.write(tmp_path / "played.npz")
    with np.load(tmp_path / "played.npz") as file:
        assert file["ended:obs:goal"].shape == (0, 7)
    assert tally.lines(0.05)[3].split()[-1] == "–"


# Tallies


def test_a_tally_shows_means_of_running_and_finished_episodes(env):
    _, tally, frames = play(env)
    lines = tally.lines(0.45)
    assert lines[0] == "t = 0.45 s, 3 environments, 6 episodes ended"
    assert lines[1].split() == ["mean", "over", "environments", "so", "far", "ended"]
    columns = {" ".join(line.split()[:-2]): line.split()[-2:] for line in lines[3:]}
    running = torch.stack([frame.step.reward for frame in frames[-2:]]).sum(dim=0).mean()
    finished = torch.stack([frame.step.reward for frame in frames[:-2]]).sum(dim=0).mean() / 2
    assert columns["return"] == [f"{running:.3g}", f"{finished:.3g}"]
    assert columns["score [quarter turns]"] == ["0", "0"]
    assert list(columns)[2:] == list(frames[0].step.info.terms)
    tilt = torch.stack([frame.step.info.terms["tilt"] for frame in frames[:-2]]).sum(dim=0).mean() / 2
    assert float(columns["tilt"][1]) == pytest.approx(float(tilt), rel=6e-3)


def test_faults_are_counted(env, script):
    actor = "def act(env, obs):\n    return [[float('nan') if env.steps[1] == 3 else 0] * 2, [0, 0], [0, 0]]\n"
    tally = Tally(env)
    env.reset(0)
    steps = rollout(actor_of(env, script(actor)), env, 5)
    with pytest.warns(UserWarning, match="not finite"):
        infos = [frame.step.info for frame in steps]
    for info in infos:
        tally.add(info)
    assert tally.lines(0.125)[0] == "t = 0.12 s, 3 environments, 1 episodes ended, 1 by a fault"
