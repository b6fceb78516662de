"""`tgdsl sweep`: trials, error messages, and runs whose worker is killed."""

import json
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from small_runs import SMALL
from small_tasks import small_task

from tgdsl.commands.sweep import left, run_trial
from tgdsl.commands.sweep_document import Trial, load_sweep
from tgdsl.errors import SpecError
from tgdsl.rl.train.folder import FORMAT, RunFolder, read_checkpoint

EXAMPLE = Path(__file__).parents[2] / "examples" / "tasks" / "sweep.yaml"
FIXED = {"--device": "cpu", "--envs": 4, "--iterations": 3, "--episodes": 4, **SMALL}
KILLED = """
import os, signal
from contextlib import suppress
from pathlib import Path
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate

class Killed(InPalmRotate):
    def advance(self, now):
        mark = Path(__file__).parent / "kill"
        if list(mark.parent.glob("runs/**/checkpoint.pt")):
            with suppress(FileNotFoundError):  # of two workers that come at once one has it
                mark.unlink()
                os.kill(os.getpid(), signal.SIGKILL)
        super().advance(now)
"""


def write(folder, matrix, fixed=FIXED, task="task.yaml", **rest):
    text = json.dumps({"tgdsl": 1, "task": task, "fixed": fixed, "matrix": matrix, **rest})
    (folder / "sweep.yaml").write_text(text)
    return folder / "sweep.yaml"


@pytest.fixture
def base(tmp_path):
    small_task(tmp_path)
    return tmp_path


def test_every_combination_is_a_trial(base):
    fixed = {"--minutes": 0.5, "randomise": {}, "train.rnd": "off"}
    spec, trials = load_sweep(write(base, {"action.scale": [0.1, "10 deg"], "--seed": [1, 2, 3]}, fixed, gpus=0.5))
    assert (spec.gpus, spec.cpus, spec.retries) == (0.5, 1.0, 3)
    assert [trial.name for trial in trials] == [
        f"action.scale={scale},seed={seed}" for scale in ("0.1", "10_deg") for seed in (1, 2, 3)
    ]
    common = ("train", str(base / "task.yaml"), "--minutes", "0.5", "--set", "randomise={}", "--set", "train.rnd=off")
    assert trials[4].words == (*common, "--set", "action.scale=10 deg", "--seed", "2")
    assert trials[4].settings == {"action.scale": "10 deg", "--seed": 2}


def test_students_can_be_trials(base):
    """A teacher's path is relative to the sweep's document."""
    (base / "teachers").mkdir()
    (base / "teachers" / "t.pt").write_bytes(b"")
    fixed = {"--teacher": "teachers/t.pt", "--types": "bool,none", "--seeds": 1, "--resolutions": "low,high"}
    document = write(base, {"--iterations": [1, 2]}, fixed, command="distill")
    _, trials = load_sweep(document)
    teacher_options = (
        "--teacher",
        str(base / "teachers" / "t.pt"),
        "--types",
        "bool,none",
        "--seeds",
        "1",
        "--resolutions",
        "low,high",
    )
    assert trials[1].words == ("distill", str(base / "task.yaml"), *teacher_options, "--iterations", "2")


def test_the_example_has_nine_trials():
    spec, trials = load_sweep(EXAMPLE)
    assert len(trials) == 9 and (spec.cpus, spec.gpus) == (4, 1)


@pytest.mark.parametrize(
    ("changes", "place", "what"),
    [
        (
            {"matrix": {"--sede": [1]}},
            "1:",
            r"`tgdsl train` has no option --sede that a sweep may set; did you mean \"--seed\"",
        ),
        ({"matrix": {"--out": ["a", "b"]}}, "1:", "has no option --out that a sweep may set"),
        ({"matrix": {"--seed": [1, 1]}}, "1:", "two combinations are the same"),
        (
            {"matrix": {"--placements": ["a b", "a_b"]}, "command": "distill", "fixed": {"--teacher": "task.yaml"}},
            "1:",
            "two combinations have one name: placements=a_b",
        ),
        (
            {"matrix": {"rewards": [{"spin": 1}], "rewards.spin": [1, 2]}},
            "rewards.spin",
            "lies below matrix.rewards, which would",
        ),
        (
            {"matrix": {"train": [{"steps": 8}]}, "fixed": {"train.rnd": "off"}},
            "fixed.train.rnd",
            "lies below matrix.train, which",
        ),
        ({"matrix": {"--seed": [1, 2]}, "fixed": {"--seed": 3}}, "matrix.--seed", "--seed stands under fixed too"),
        (
            {"matrix": {"--types": ["bool," * 40]}, "command": "distill", "fixed": {"--teacher": "task.yaml"}},
            "1:",
            "the name of a run's folder has 206 characters, expected 200 at most: types=bool,bool",
        ),
        ({"matrix": {"--seed": []}}, "1:", "at least 1"),
        ({"matrix": {}}, "1:", "at least 1"),
        ({"matrix": {"action.scael": [0.1]}}, "action", "scael"),
        ({"matrix": {"action.scale": [0.1, -1]}}, "action", "scale"),
        ({"matrix": {"--seed": [1]}, "gpus": -1}, "1:", "gpus"),
        (
            {"matrix": {"--iterations": [3, 2.5]}},
            "matrix.--iterations[1]",
            "--iterations is 2.5, expected a whole number of at",
        ),
        (
            {"matrix": {"--seed": [1]}, "fixed": {"--envs": 0}},
            "fixed.--envs",
            "--envs is 0, expected a whole number of at least 1",
        ),
        (
            {"matrix": {"--seed": [1]}, "fixed": {"--minutes": "5 min"}},
            "1:",
            '--minutes is "5 min", expected a positive number',
        ),
        ({"matrix": {"--minutes": [0]}, "fixed": {"--envs": True}}, "1:", "(?s)--envs is true.*--minutes is 0"),
        ({"matrix": {"--seed": [1]}, "command": "trian"}, "1:", "command"),
        ({"matrix": {"--seed": [1.5, "x"]}}, "1:", r'(?s)--seed\[0\]: --seed is 1.5, expected a whole number\n.*--seed is "x"'),
        ({"matrix": {"--seed": [1]}, "fixed": {"--device": 7}}, "fixed.--device", "--device is 7, expected a text, as on the"),
        ({"matrix": {"--device": ["cpu", "CPU"]}}, "matrix.--device[1]", '--device is "CPU", expected cuda or cpu'),
        ({"matrix": {"--types": ["bool"]}}, "1:", "`tgdsl train` has no option --types that a sweep may set"),
        ({"matrix": {"--seed": [1]}, "command": "distill", "fixed": {}}, "command", "`tgdsl distill` needs a --teacher, under"),
        (
            {"matrix": {"--teacher": ["t.pt"]}, "command": "distill", "fixed": {}},
            "matrix.--teacher[0]",
            '--teacher is "t.pt", expected a policy: there is no file /.*/t.pt',
        ),
        (
            {
                "matrix": {"--minutes": [1]},
                "command": "distill",
                "fixed": {"--teacher": "task.yaml", "--seeds": 0, "--resolutions": "low,high"},
            },
            "fixed.--resolutions",
            '(?s)--seeds is 0.*--resolutions is "low,high", expected one, as --minutes count for each: list them under matrix',
        ),
    ],
)
def test_mistakes_are_named_before_anything_runs(base, changes, place, what):
    with pytest.raises(SpecError, match=what) as error:
        load_sweep(write(base, **changes))
    assert place in str(error.value)


@pytest.mark.parametrize("place", [".", "low"])
def test_a_resumed_run_learns_for_the_remaining_minutes(tmp_path, place):
    """The checkpoint was written after 9 of 30 seconds: 0.35 minutes remain, and none after 42 seconds.

    Iterations after the checkpoint, even a partly written one, do not count.
    """
    words = ["train", "task.yaml", "--minutes", "0.5", "--seed", "1"]
    assert left(words, tmp_path) == words
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "curve.csv").write_text("iteration,samples,seconds\n1,8,9.0\n2,16,12.0\n3,2")
    for seconds, expected in ((9.0, 0.35), (42.0, 0.0)):
        state = {"format": FORMAT, "seconds": seconds}
        torch.save(state, tmp_path / place / "checkpoint.pt")
        remaining = left(words, tmp_path)
        assert remaining[:3] + remaining[4:] == words[:3] + words[4:] and float(remaining[3]) == pytest.approx(expected)


def test_wrong_trials_report_it_and_finished_ones_are_left_alone(base, monkeypatch):
    for name in ("argv", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, getattr(sys, name))
    trial = Trial("x", {"--seed": 1}, ("train", "nowhere.yaml", "--device", "cpu"))
    assert run_trial(trial, str(base / "x")) == "failed: exit code 2"
    assert "nowhere.yaml" in (base / "x" / "log.txt").read_text()
    assert not (base / "x" / "ended.json").exists()
    (base / "x" / "ended.json").write_text("{}")
    assert run_trial(trial, str(base / "x")) == "finished earlier"
    other = Trial("x", {"--seed": 1}, ("train", "nowhere.yaml", "--envs", "4"))
    message = "its folder holds a run of other settings, `tgdsl train nowhere.yaml --device cpu`; give another --out"
    assert run_trial(other, str(base / "x")) == f"failed: {message}"


def test_an_error_of_a_trial_is_in_its_log(base, monkeypatch):
    for name in ("argv", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, getattr(sys, name))
    (base / "z").mkdir()
    (base / "z" / "checkpoint.pt").write_text("")
    result = run_trial(Trial("z", {}, ("train", "task.yaml", "--minutes", "1")), str(base / "z"))
    assert result.startswith("failed: CheckpointError: ") and "checkpoint.pt: found 0 bytes that are cut off" in result
    (base / "broken.py").write_text("raise ZeroDivisionError('of this test')")
    monkeypatch.setattr("runpy.run_module", lambda *_, **__: runpy.run_path(str(base / "broken.py")))
    assert run_trial(Trial("y", {}, ("train", "task.yaml")), str(base / "y")) == "failed: ZeroDivisionError: of this test"
    assert 'broken.py", line 1' in (base / "y" / "log.txt").read_text()
    assert not (base / "y" / "ended.json").exists()


def test_the_score_of_a_trial_is_reported(base, monkeypatch):
    """With its confidence interval, unless there is only one episode."""
    monkeypatch.setattr(sys, "argv", sys.argv)
    for ends, expected in (([0.1234, 0.5], "[0.123, 0.5]"), ([None, None], "[–, –]")):
        folder = base / str(ends[0])
        score = json.dumps({"score": 0.25, "score_interval": ends, "unit": "rad"})
        monkeypatch.setattr(
            "runpy.run_module", lambda *_, folder=folder, score=score, **__: (folder / "evaluation.json").write_text(score)
        )
        assert run_trial(Trial("x", {}, ("train", "task.yaml")), str(folder)) == f"score 0.25 {expected} rad"


def fake_ray(monkeypatch, cpus, gpus):
    """Replace Ray by one with a single machine; return the list of its options."""
    requests = []
    work = SimpleNamespace(remote=lambda trial, place: (trial.name, place))
    ray = ModuleType("ray")
    ray.init = ray.shutdown = lambda **_: None
    ray.nodes = lambda: [{"Resources": {"CPU": cpus, "GPU": gpus}}]
    ray.remote = lambda **options: lambda _: requests.append(options) or work
    ray.wait, ray.get = lambda waiting: (waiting[:1], waiting[1:]), lambda done: f"was {done[0]}"
    ray.exceptions = ModuleType("ray.exceptions")
    for name in ("LocalRayletDiedError", "NodeDiedError", "OutOfMemoryError", "RayError", "WorkerCrashedError"):
        setattr(ray.exceptions, name, type(name, (Exception,), {}))
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", ray.exceptions)
    return requests


@pytest.mark.parametrize(("cpus", "gpus"), [(1.0, 2.0), (4.0, 0.0)])
def test_a_run_too_large_for_every_machine_is_refused(base, here, monkeypatch, cpus, gpus):
    fake_ray(monkeypatch, cpus, gpus)
    write(base, {"--seed": [1]}, cpus=2, gpus=1)
    code, out, error = here(base, "sweep", "sweep.yaml")
    expected = f"a run takes 2 processors and 1 GPUs, no machine has more than {cpus:g} and {gpus:g}"
    assert (code, out) == (2, "") and expected in error


def test_each_run_gets_a_new_process(base, here, monkeypatch):
    requests = fake_ray(monkeypatch, 2.0, 0.0)
    write(base, {"--seed": [1, 2]}, cpus=2, retries=1)
    code, out, error = here(base, "sweep", "sweep.yaml")
    assert (code, error) == (0, "")
    assert requests == [{"num_cpus": 2, "num_gpus": 0, "max_retries": 1, "max_calls": 1}]
    first = f"2 runs; log.txt in each folder of {(base / 'out/sweep').resolve()} has a run's progress"
    assert out.splitlines() == [first, "1/2 seed=1: was seed=1", "2/2 seed=2: was seed=2"]


def test_names_of_trials_may_have_200_characters(base):
    _, (trial,) = load_sweep(write(base, {"--types": ["b" * 194]}, {"--teacher": "task.yaml"}, command="distill"))
    assert len(trial.name) == 200


def killed_once(folder):
    """Make the task kill the first worker that reaches it after a checkpoint."""
    (folder / "killed.py").write_text(KILLED)
    (folder / "kill").write_text("")
    task = (folder / "task.yaml").read_text().replace("task: in_palm_rotate", "task: killed.py:Killed")
    (folder / "task.yaml").write_text(task)


@pytest.mark.slow
def test_a_run_whose_worker_is_killed_resumes(base, here):
    """Both runs finish: the killed one resumes from its checkpoint, and its curve has each iteration once."""
    killed_once(base)
    write(base, {"--seed": [1, 2]}, {**FIXED, "train.checkpoint": 1e-9})
    (base / "elsewhere").mkdir()
    code, out, error = here(base / "elsewhere", "sweep", "../sweep.yaml", "--out", "../runs")
    assert code == 0, error
    assert not (base / "kill").exists()
    ended = re.findall(r"^([12])/2 .*quarter turns", out, re.MULTILINE)  # Ray prints other lines about the dead worker
    assert ended == ["1", "2"]
    starts = []
    for seed in (1, 2):
        folder = base / "runs" / f"seed={seed}"
        assert read_checkpoint(folder / "checkpoint.pt")["iteration"] == 3
        assert [row["iteration"] for row in RunFolder(folder).rows()] == ["1", "2", "3"]
        assert json.loads((folder / "ended.json").read_text()) == {"--seed": seed}
        starts.append(len(json.loads((folder / "run.json").read_text())["starts"]))
    assert sorted(starts) == [1, 2]
