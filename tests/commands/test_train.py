"""`tgdsl train` and `tgdsl evaluate`, as users run them."""

import json
import os
import shlex
import signal
import sys
import time
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from silent_browser import silent_browser
from small_runs import ARGUMENTS, small_learner
from small_tasks import small_task

from tgdsl.commands.train import learner_page
from tgdsl.errors import FileError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.stage import LearnerStage
from tgdsl.rl.train.folder import RunFolder, read_checkpoint
from tgdsl.rl.train.learner import Learner

pytestmark = [pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"), pytest.mark.usefixtures("no_onnx")]
ON = ["--device", "cpu", "--envs", "4"]


@pytest.fixture
def base(tmp_path):
    small_task(tmp_path)
    return tmp_path


@pytest.fixture
def fails(here, base):
    """Return a function that runs a wrong command and returns its message; it must write nothing."""

    def run(*arguments):
        files_before = sorted(base.rglob("*"))
        code, out, message = here(base, *arguments)
        assert (code, out) == (2, ""), message
        assert sorted(base.rglob("*")) == files_before
        return message

    return run


def test_from_nothing_to_a_policy_that_plays(base, here):
    code, out, error = here(
        base, "train", "task.yaml", *ON, "--iterations", "2", "--episodes", "6", *ARGUMENTS, "--set", "rewards.spin=3"
    )
    assert code == 0, error
    lines = out.splitlines()
    assert lines[0].startswith("1/2: ") and lines[0].endswith(" left")
    assert lines[-2] == "policy: out/task/policy.pt, after 2 iterations, 32 steps, 0.0 min"
    assert lines[-1].startswith("score ") and "quarter turns" in lines[-1] and "in 6 episodes" in lines[-1]
    folder = base / "out" / "task"
    names = {file.name.split(".out.")[0] for file in folder.iterdir()}
    assert names == {
        "checkpoint.pt",
        "curve.csv",
        "evaluation.json",
        "events",
        "policy.json",
        "policy.onnx",
        "policy.pt",
        "run.json",
    } | {
        "sensors.yaml",
        "task.yaml",
        "taxels.csv",
    }
    card = json.loads((folder / "policy.json").read_text())
    assert card["score"] == json.loads((folder / "evaluation.json").read_text())
    assert card["spec"]["rewards"]["spin"] == 3 and card["command"].startswith("tgdsl train task.yaml --device cpu")
    code, out, error = here(
        base,
        "evaluate",
        "task.yaml",
        "--policy",
        "out/task/policy.pt",
        "--episodes",
        "6",
        "--envs",
        "4",
        "-o",
        "e.json",
        "--set",
        "rewards.spin=3",
    )
    assert code == 0, error
    assert out.splitlines()[0] == lines[-1] and "progress while no finger touches the object" in out
    assert json.loads((base / "e.json").read_text()) == card["score"]
    code, out, error = here(
        base, "play", "task.yaml", "--policy", "out/task/policy.pt", "--envs", "1", "--seconds", "0.1", "--no-video"
    )
    assert code == 0, error
    assert out.splitlines()[0] == "changed since the policy was learned: rewards.spin: 3.0, now 2.0"
    with np.load(base / "out" / "played.npz") as record:
        assert record["action"].shape == (4, 1, 2)


def test_a_resumed_run_keeps_its_overrides_and_prints_changes(base, here):
    start = ["train", "task.yaml", "--device", "cpu", "--episodes", "0"]
    assert here(base, *start, "--envs", "3", "--seed", "7", "--iterations", "1", "-o", "a run", *ARGUMENTS)[0] == 0
    code, out, error = here(base, *start, "--iterations", "3", "--resume", "a run", "--set", "rewards.spin=3")
    assert code == 0, error
    assert out.splitlines()[0] == "changed since the run began: rewards.spin: 2.0, now 3.0"
    assert "after 3 iterations, 36 steps" in out
    starts = json.loads((base / "a run" / "run.json").read_text())["starts"]
    assert [(entry["seed"], entry["envs"], len(entry["overrides"])) for entry in starts] == [(7, 3, 8), (7, 3, 9)]
    assert here(base, *start, "--iterations", "4", "--resume", "a run", "-o", "other", *ARGUMENTS)[0] == 0
    assert json.loads((base / "other" / "run.json").read_text())["starts"][0]["spec"]["rewards"]["spin"] == 2.0
    assert [read_checkpoint(base / name / "checkpoint.pt")["iteration"] for name in ("a run", "other")] == [3, 4]
    from_where = [[entry.get("goes_on_from") for entry in starts], *_starts(base / "other", "goes_on_from")]
    assert from_where == [[None, "a run"], "a run"]


def test_a_run_starts_from_the_policy_of_another(base, here, fails):
    start = ["train", "task.yaml", *ON, "--episodes", "0", *ARGUMENTS, "--iterations", "1"]
    assert here(base, *start, "--out", "first")[0] == 0
    code, _, error = here(base, *start, "--init", "first", "--out", "second")
    assert code == 0, error
    assert _starts(base / "second", "starts_from") == ["first/policy.pt"]
    assert "found both --init and --resume" in fails(*start, "--init", "first", "--resume", "first")


def _starts(folder, name):
    return [entry[name] for entry in json.loads((folder / "run.json").read_text())["starts"]]


def test_changed_seeds_and_sensors_are_printed_but_not_new_keys(base, here):
    start = ["train", "task.yaml", "--device", "cpu", "--episodes", "0"]
    assert here(base, *start, "--envs", "3", "--iterations", "1", "-o", "a run", *ARGUMENTS)[0] == 0
    run_content = json.loads((base / "a run" / "run.json").read_text())
    del run_content["starts"][0]["spec"]["goal_tolerance"]
    (base / "a run" / "run.json").write_text(json.dumps(run_content))
    (base / "sensors.yaml").write_text((base / "sensors.yaml").read_text() + "# the same\n")
    code, out, error = here(base, *start, "--iterations", "2", "--resume", "a run", "--seed", "5")
    assert code == 0, error
    assert [line for line in out.splitlines() if "changed" in line] == ["changed since the run began: seed: 0, now 5"]
    code, out, error = here(base, *start, "--iterations", "3", "--resume", "a run", "--set", "touch=none")
    assert code == 0, error
    prefix = "changed since the run began: "
    assert [line.removeprefix(prefix) for line in out.splitlines() if prefix in line] == [
        'touch: "bool", now "none"',
        "the compiled module of the sensors' document",
    ]


def test_two_documents_with_one_name_are_both_kept(base, here):
    (base / "sub").mkdir()
    task = (base / "task.yaml").read_text().replace("document: sensors.yaml", "document: ../sensors.yaml")
    (base / "sub" / "sensors.yaml").write_text(task)
    code, _, error = here(
        base, "train", "sub/sensors.yaml", *ON, "--episodes", "0", "--iterations", "1", "-o", "run", *ARGUMENTS
    )
    assert code == 0, error
    assert (base / "run" / "sub_sensors.yaml").read_text() == task
    assert (base / "run" / f"{base.name}_sensors.yaml").read_text() == (base / "sensors.yaml").read_text()


def test_rates_set_for_a_resumed_run_apply(base, here):
    start = ["train", "task.yaml", *ON, "--episodes", "0", *ARGUMENTS]
    assert here(base, *start, "--iterations", "1")[0] == 0
    set_ = ["--set", "train.adaptive=false", "--set", "train.learning_rate=5e-4", "--set", "train.networks.initial_std=0.5"]
    code, out, error = here(base, *start, "--iterations", "2", "--resume", "out/task", *set_)
    assert code == 0, error
    assert "train.networks.initial_std: 1.0, now 0.5; a run that goes on keeps its deviations" in out
    rows = [line.split(",") for line in (base / "out" / "task" / "curve.csv").read_text().splitlines()]
    assert rows[2][rows[0].index("Loss/learning_rate")] == "0.0005"


def test_minutes_limit_learning(base, here):
    """`--minutes 0` runs no iteration, also when a run resumes; more runs at least one."""
    start = ["train", "task.yaml", *ON, "--episodes", "0", *ARGUMENTS]
    for minutes, more, iterations in (
        ("0.0", (), 0),
        ("1e-6", ("--resume", "out/task"), 1),
        ("0", ("--resume", "out/task"), 1),
    ):
        code, out, error = here(base, *start, "--minutes", minutes, *more)
        assert code == 0, error
        assert f"after {iterations} iterations" in out


@pytest.mark.parametrize("words", [("evaluate", "--episodes", "2"), ("play", "--seconds", "0.1", "--no-video")])
def test_a_policy_is_read_before_environments_are_made(base, here, monkeypatch, words):
    """Later changes of its file have no effect."""
    assert here(base, "train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS)[0] == 0
    file, original = base / "out" / "task" / "policy.pt", TouchEnv.__init__

    def replaced(self, *arguments, **options):
        file.write_bytes(b"another one, half written")
        original(self, *arguments, **options)

    monkeypatch.setattr(TouchEnv, "__init__", replaced)
    command, *options = words
    code, _, error = here(base, command, "task.yaml", "--policy", str(file), "--envs", "2", *options)
    assert code == 0, error
    message = here(base, command, "task.yaml", "--policy", str(file), "--envs", "2", *options)[2]
    assert message.startswith(f"tgdsl: {file}: this is no TorchScript file, as rsl_rl's `export_policy_to_jit` writes it")


def test_without_rsl_rl_the_error_names_what_to_install(fails, monkeypatch):
    monkeypatch.setitem(sys.modules, "rsl_rl.utils", None)
    monkeypatch.delitem(sys.modules, "tgdsl.rl.train.learner")
    assert 'to learn needs rsl-rl-lib, and what that needs: pip install "tgdsl[rl]" (' in fails("train", "task.yaml", *ON)


def test_an_evaluation_names_variants_that_it_leaves_out(base, here):
    sensors = base / "sensors.yaml"
    varied = "{body: item, variants: [{type: box, size: [2 cm, 2 cm, 2 cm]}, {type: sphere, size: [2 cm]}]}"
    sensors.write_text(sensors.read_text().replace("{body: item}", varied))
    for envs, says in ((1, ['of the 2 variants of "item" 1 is played: there are no more environments']), (2, [])):
        code, out, error = here(base, "evaluate", "task.yaml", "--episodes", "2", "--envs", str(envs))
        assert code == 0, error
        assert out.partition("score ")[0].splitlines() == says


def test_wrong_arguments_are_refused(fails, here, base):
    assert "there is no run to go on with: run.json is missing or empty" in fails("train", "task.yaml", *ON, "--resume", "none")
    assert "train.clip: -1 is out of range, expected more than 0" in fails("train", "task.yaml", *ON, "--set", "train.clip=-1")
    assert "--envs 0: expected at least 1" in fails("train", "task.yaml", "--device", "cpu", "--envs", "0")
    assert "--minutes nan: expected at least 0" in fails("train", "task.yaml", *ON, "--minutes", "nan")
    assert "task.yaml is a file, expected a folder" in fails("train", "task.yaml", *ON, "--out", "task.yaml/run")
    assert 'no group of observations "gaol"' in fails("train", "task.yaml", *ON, "--set", "train.actor=[gaol]")
    assert "none.pt: cannot read this file: No such file or directory" in fails("evaluate", "task.yaml", "--policy", "none.pt")
    if not torch.cuda.is_available():
        assert 'there is no device "cuda": ' in (message := fails("train", "task.yaml")) and "--device cpu" in message
    assert "--episodes 0: expected at least 1" in fails("evaluate", "task.yaml", "--episodes", "0")
    assert here(base, "train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS)[0] == 0
    message = fails("train", "task.yaml", *ON)
    assert message == "tgdsl: out/task: this folder holds a run; go on with --resume out/task, or give another --out\n"


def test_a_run_killed_before_its_first_checkpoint_starts_again(base, here):
    train = ("train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS)
    assert here(base, *train)[0] == 0
    folder = base / "out" / "task"
    for name in ("checkpoint.pt", "curve.csv"):
        (folder / name).unlink()
    code, _, error = here(base, *train)
    assert code == 0, error
    assert len(json.loads((folder / "run.json").read_text())["starts"]) == 1
    assert "this folder holds a run" in here(base, *train)[2]


def test_a_truncated_checkpoint_is_refused_and_all_files_stay(base, here, fails):
    assert here(base, "train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS)[0] == 0
    file = base / "out" / "task" / "checkpoint.pt"
    file.write_bytes(file.read_bytes()[:999])
    contents = {path: path.read_bytes() for path in (base / "out").rglob("*") if path.is_file()}
    for out in ("out/task", "other"):
        message = fails("train", "task.yaml", *ON, "--resume", "out/task", "--out", out)
        assert message.startswith(
            "tgdsl: out/task/checkpoint.pt: found 999 bytes that are cut off, or of something else, expected"
        )
    assert {path: path.read_bytes() for path in (base / "out").rglob("*") if path.is_file()} == contents


def test_a_repeated_override_replaces_keys_below_it(base, here):
    """The speed is that of iterations since, with the current number of environments."""
    train = ("train", "task.yaml", "--device", "cpu", "--episodes", "0", *ARGUMENTS)
    first = ("--envs", "64", "--iterations", "1", "--set", "randomise={}", "--set", "randomise.friction=[0.5, 1.5]")
    assert here(base, *train, *first)[0] == 0
    resume = ("--envs", "2", "--iterations", "2", "--resume", "out/task", "--set", "randomise={}")
    code, _, error = here(base, *train, *resume)
    assert code == 0, error
    starts = json.loads((base / "out" / "task" / "run.json").read_text())["starts"]
    assert [start["spec"]["randomise"]["friction"] for start in starts] == [[0.5, 1.5], [1.0, 1.0]]
    rows = (base / "out" / "task" / "curve.csv").read_text().splitlines()
    names = rows[0].split(",")
    curve = [dict(zip(names, row.split(","), strict=True)) for row in rows[1:]]
    new_steps = float(curve[1]["samples"]) - float(curve[0]["samples"])
    assert new_steps < 0.1 * float(curve[0]["samples"])
    assert float(curve[1]["steps_per_second"]) <= 1.01 * new_steps / (float(curve[1]["rollout"]) + float(curve[1]["update"]))


def test_an_evaluation_is_written_into_a_new_folder(base, here, fails):
    code, _, error = here(base, "evaluate", "task.yaml", "--episodes", "2", "--envs", "2", "--out", "no/such/found.json")
    assert code == 0, error
    assert json.loads((base / "no" / "such" / "found.json").read_text())["episodes"] == 2
    assert "--groups belong to a policy" in fails("evaluate", "task.yaml", "--groups", "proprio")


def test_an_interrupted_evaluation_leaves_no_old_score(base, here, monkeypatch):
    """The evaluation file is gone, and the new policy has no score."""
    train = ("train", "task.yaml", "--device", "cpu", "--episodes", "2", *ARGUMENTS)
    assert here(base, *train, "--envs", "4", "--iterations", "1")[0] == 0
    folder = base / "out" / "task"
    assert (folder / "evaluation.json").is_file()

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("tgdsl.rl.playing.evaluation.evaluate", interrupted)
    assert here(base, *train, "--iterations", "2", "--resume", "out/task")[0] == 130
    card = json.loads((folder / "policy.json").read_text())
    assert (card["iterations"], card["score"]) == (2, None) and not (folder / "evaluation.json").exists()


@pytest.mark.parametrize(
    "command", [("train",), ("distill", "--teacher", "out/task/policy.pt", "--types", "none", "--envs", "3")]
)
def test_a_folder_in_use_by_another_process_is_left_alone(base, here, fails, command):
    """Its checkpoint is not read, as the other process may replace it; folders without a run count too."""
    train = ("train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS)
    assert here(base, *train)[0] == 0
    name, *options = command
    with RunFolder(base / "other" / "run").lock():
        message = fails(name, "task.yaml", "--device", "cpu", *options, "--out", "other/run")
        assert (
            message == "tgdsl: other/run: another process runs in this folder; wait until it has ended, or give another --out\n"
        )
    (base / "out" / "task" / "checkpoint.pt").write_bytes(b"half written")
    with RunFolder(base / "out" / "task").lock():
        assert "another process runs in this folder" in fails("train", "task.yaml", *ON, "--resume", "out/task")


def test_an_interrupted_run_leaves_its_policy_and_prints_how_to_resume(base, here, monkeypatch):
    iterate = Learner.iterate

    def interrupted(self, share=0.0):
        if self.iteration == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return iterate(self, share)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "iterate", interrupted)
        code, out, error = here(base, "train", "task.yaml", *ON, "--iterations", "5", "--episodes", "6", *ARGUMENTS)
    assert (code, error.splitlines()[-1]) == (
        130,
        "stopped by SIGINT after iteration 2; to go on: tgdsl train task.yaml --device cpu --resume out/task",
    )
    assert "policy: out/task/policy.pt, after 2 iterations" in out and not (base / "out/task/evaluation.json").exists()
    code, out, error = here(base, *shlex.split(error.splitlines()[-1])[-6:], "--iterations", "3", "--episodes", "0")
    assert code == 0, error
    assert "after 3 iterations" in out


def test_an_unwritable_policy_leaves_the_checkpoint_and_prints_how_to_resume(base, here, monkeypatch):
    def no_space(_policy, _card, file):
        raise FileError(file, "No space left on device")

    monkeypatch.setattr("tgdsl.rl.train.learner.write_policy", no_space)
    code, _, error = here(base, "train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS)
    message = "out/task/checkpoint.pt is whole, of iteration 1; to go on: tgdsl train task.yaml --device cpu --resume out/task"
    assert (code, error.splitlines()[-1]) == (2, f"tgdsl: out/task/policy.pt: No space left on device; {message}")


def test_the_stage_of_a_learner_shows_each_control_step_without_effects(tmp_path):
    bare, _ = small_learner(tmp_path)
    viewed, _ = small_learner(tmp_path)
    stage, frames = LearnerStage(viewed.env), []

    def keep(moment):
        stage.keep(moment)
        frames.append((stage.time, stage.notes(1), moment))

    viewed.on_step = keep
    for learner in (bare, viewed):
        torch.manual_seed(0)
        learner.iterate()
        learner.iterate()
    assert len(frames) == 8  # four control steps per iteration
    for i, (now, notes, moment) in enumerate(frames):
        assert now == pytest.approx((i + 1) * viewed.env.control_step)
        rewards = sum(value for name, value in notes.items() if not name.startswith("score"))
        assert rewards * viewed.env.control_step == pytest.approx(float(moment.step.reward[1]), abs=1e-6)
    for name, value in bare.algorithm.actor.state_dict().items():
        assert torch.equal(value, viewed.algorithm.actor.state_dict()[name])


@pytest.mark.slow
def test_a_viewed_learner_continues_when_the_page_opens_closes_or_dies(tmp_path, capsys):
    bare, _ = small_learner(tmp_path)
    viewed, _ = small_learner(tmp_path)
    torch.manual_seed(0)
    with learner_page(viewed) as page:
        assert capsys.readouterr().out == f"view: {page.url}\n" and page.url.startswith("http://localhost:")
        viewed.iterate()
        for _ in range(2):
            with silent_browser(page.url):
                started, num_before = time.monotonic(), page.num_frames
                while page.num_frames == num_before and time.monotonic() - started < 60:
                    viewed.iterate()
                    time.sleep(0.2)  # give the page's low-priority process time to start
                assert page.num_frames > num_before
        page._process.kill()
        viewed.iterate()
    torch.manual_seed(0)
    while bare.iteration < viewed.iteration:
        bare.iterate()
    for name, value in bare.algorithm.actor.state_dict().items():
        assert torch.equal(value, viewed.algorithm.actor.state_dict()[name])


def test_view_opens_the_page_of_the_learner(base, here, monkeypatch):
    viewed = []
    monkeypatch.setattr("tgdsl.commands.train.learner_page", lambda learner: viewed.append(learner) or nullcontext())
    code, _, error = here(base, "train", "task.yaml", *ON, "--iterations", "1", "--episodes", "0", *ARGUMENTS, "--view")
    assert code == 0, error
    assert [learner.iteration for learner in viewed] == [1]
