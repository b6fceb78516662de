"""`tgdsl deploy`, as users run it."""

import itertools
import json

import numpy as np
import pytest
from hand_logs import random_readings, write_log
from pressing_hands import CALIBRATION, Blind, press_policy, press_task

from tgdsl.rl.deploying.deploy import Deployment

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")


@pytest.fixture
def base(tmp_path):
    press_policy(tmp_path, press_task(tmp_path), Blind(6))
    (tmp_path / "hand.yaml").write_text(CALIBRATION.text())
    return tmp_path


@pytest.mark.slow
def test_simulation_and_emulator_give_the_same_score(base, here):
    """The record matches the printed score."""
    scores = []
    for source in (["simulation"], ["emulator", "--lockstep", "--calibration", "hand.yaml"]):
        arguments = ("--policy", "student.pt", "--seconds", "0.2", "--goal", "1", "--out", "a b/made.npz")
        code, out, error = here(base, "deploy", "task.yaml", "--source", *source, *arguments)
        assert code == 0, error
        lines = out.splitlines()
        assert lines[0].startswith("score ") and lines[0].endswith(" rad, 100.0% of full length; 1 episode, 10 control steps")
        assert lines[1].startswith("inference ") and lines[1].endswith("of 50.0 control steps per second, not in real time")
        assert lines[-1] == "record: a b/made.npz" and len(lines) == 2 + 2 + 6 + 1
        with np.load(base / "a b" / "made.npz") as record:
            assert record["obs:tactile_sensors"].shape == (10, 15) and (record["obs:goal"] == 1).all()
            assert np.isnan(record["age"]).all() and record["joints"].shape == (6,)
            expected = record["target"][:-1] + 0.8 * 0.05 * record["action"][1:]
            np.testing.assert_allclose(record["target"][1:], expected, atol=1e-7)
            scores.append(f"{record['score'][-1]:.4f}")
        assert lines[0].split()[1] == scores[-1]
    assert scores[0] == scores[1]


def test_changes_of_the_task_are_printed(base, here):
    """Goals that the user gives are no changes."""
    arguments = ("--policy", "student.pt", "--seconds", "0.1", "--goal", "1", "--set", "randomise.drive.delay=[0, 1]")
    code, out, error = here(base, "deploy", "task.yaml", *arguments)
    assert code == 0, error
    first, second, *_ = out.splitlines()
    assert first == "changed since the policy was learned: randomise.drive.delay: [0.0, 2.0], now [0.0, 1.0]"
    assert second.startswith("score ")


def test_a_log_is_played_without_a_score(base, here):
    write_log(base / "press.npz", random_readings(1.0 + 0.02 * np.arange(8)))
    arguments = ("--policy", "student.pt", "--source", "press.npz", "--lockstep", "--goal", "1", "--calibration", "hand.yaml")
    code, out, error = here(base, "deploy", "task.yaml", *arguments)
    assert code == 0, error
    assert out.startswith("no score: press.npz has no scene that knows what happened; 1 episode, ")
    assert "press.npz was not moved: actions were computed, and went nowhere\n" in out


def test_ctrl_c_keeps_the_record_so_far(base, here, monkeypatch):
    steps = Deployment.steps

    def interrupted(self, *arguments):
        yield from itertools.islice(steps(self, *arguments), 3)
        raise KeyboardInterrupt

    monkeypatch.setattr(Deployment, "steps", interrupted)
    code, out, error = here(base, "deploy", "task.yaml", "--policy", "student.pt", "--goal", "1", "--out", "made.npz")
    assert code == 0, error
    first, second, *_ = out.splitlines()
    assert first == "interrupted" and second.endswith("no episode has ended; 0 episodes, 3 control steps")
    with np.load(base / "made.npz") as record:
        assert record["action"].shape == (3, 6)


def test_wrong_arguments_are_refused(base, here):
    card = json.loads((base / "student.json").read_text())
    assert card["spec"]["touch"] == "agg_force"
    policy = ("--policy", "student.pt")
    cases = {
        ("--policy", "none.pt"): "tgdsl: none.pt: cannot read this file: No such file or directory\n",
        (*policy, "--source", "gazebo"): 'tgdsl: unknown source "gazebo"; expected "simulation"',
        (*policy, "--source", "xhand1:/dev/none"): 'tgdsl: student.pt: the task "press.py:Press" draws its goal from its scene',
        (*policy, "--source", "xhand1:/dev/none", "--goal", "1"): "tgdsl: /dev/none cannot be opened",
        (*policy, "--goal", "7"): "tgdsl: goal: a bend of 7 rad; expected 0.5 to 1.5 rad (`bend` of the task's document)\n",
        (*policy, "--kp", "3"): "tgdsl: --speed, --current-limit: missing; a hand moves only with a speed, a current limit",
        (*policy, "--episodes", "0"): "tgdsl: 0 episodes of None s, expected at least 1, and more than 0 s\n",
        (*policy, "--set", "episode=0"): "--set episode=0: episode: ",
        (*policy, "--goal", "1", "--out", "task.yaml/made.npz"): "tgdsl: task.yaml/made.npz: ",
        (*policy, "--calibration", "none.yaml", "--source", "emulator"): "none.yaml: cannot read this file",
    }
    for arguments, message in cases.items():
        code, out, error = here(base, "deploy", "task.yaml", *arguments)
        assert (code, out) == (2, ""), arguments
        assert error.startswith(message), (arguments, error)
