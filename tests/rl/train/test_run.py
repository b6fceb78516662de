"""Runs: their files, resuming after a kill, and files that cannot be written."""

import csv
import errno
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import small_tasks
import torch
from small_runs import small_learner

from tgdsl.errors import FileError, TgdslError
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.policy import differences
from tgdsl.rl.train.folder import CheckpointError, RunFolder, documents, read_checkpoint, run_origin, write_checkpoint
from tgdsl.rl.train.run import DivergedError, Run, restore

EVERY = 1e-9
"""A checkpoint after each iteration."""
RESUME = "tgdsl train task.yaml --resume run"


def started_run(base, name="run", every=EVERY, **overrides):
    """Return a started run and its learner."""
    learner, loaded = small_learner(base, **overrides)
    folder = RunFolder(base / name)
    folder.check(is_resumed=False)
    folder.begin(run_origin(loaded, learner.env, 0, {}, 1), loaded, learner.env)
    return Run(learner, folder, every, RESUME), learner


def networks(learner):
    algorithm = learner.algorithm
    models = (algorithm.actor, algorithm.critic, algorithm.rnd.predictor, algorithm.rnd.state_normalizer)
    return [value.clone() for model in models for value in model.state_dict().values()]


def test_a_checkpoint_restores_everything_that_learning_needs(tmp_path):
    """Networks, optimisers, rate, random numbers; environments resume without repeating draws."""
    run, learner = started_run(tmp_path)
    run.learn(3, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    assert (state["iteration"], state["samples"]) == (3, 3 * 4 * 4)
    other, _ = small_learner(tmp_path, seed=5)
    restore(other, state, run._folder.checkpoint)
    assert all(torch.equal(one, two) for one, two in zip(networks(learner), networks(other), strict=True))
    assert (other.iteration, other.samples) == (3, 48)
    assert other.algorithm.learning_rate == learner.algorithm.learning_rate
    moments = [each.algorithm.optimizer.state_dict()["state"] for each in (learner, other)]
    for i, moments_of_one in moments[0].items():
        assert all(torch.equal(value, moments[1][i][name]) for name, value in moments_of_one.items())
    assert torch.equal(torch.get_rng_state(), state["processes"][0]["cpu"])
    assert torch.equal(other.env.resets, learner.env.resets + 1)
    assert torch.equal(other.env.steps, learner.env.steps)
    assert other.algorithm.rnd.update_counter == learner.algorithm.rnd.update_counter == 12
    other.iterate()
    assert other.iteration == 4


def test_a_gpu_checkpoint_resumes_on_a_cpu(tmp_path, monkeypatch):
    """The GPU's random state is ignored: torch would defer it until there is a GPU."""
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda *_: pytest.fail("there is no GPU"))
    run, _ = started_run(tmp_path)
    run.learn(1, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    state["processes"][0]["cuda"] = torch.zeros(16, dtype=torch.uint8)
    other, _ = small_learner(tmp_path, seed=5)
    restore(other, state, run._folder.checkpoint)
    assert torch.equal(torch.get_rng_state(), state["processes"][0]["cpu"])


def test_a_learner_is_passed_the_finished_share_of_its_run(tmp_path, monkeypatch):
    """The larger share, of iterations or of time; both include the run before it was resumed."""
    run, learner = started_run(tmp_path)
    shares, iterate = [], learner.iterate
    learner.iterate = lambda share: shares.append(share) or iterate(share)
    run.learn(2, float("inf"))
    run.learn(4, float("inf"))
    assert shares == [0.0, 1 / 2, 2 / 4, 3 / 4]
    seconds = itertools.count()  # each look at the clock takes a second
    monkeypatch.setattr("tgdsl.rl.train.run.time", SimpleNamespace(monotonic=lambda: float(next(seconds))))
    run.seconds = 0.0
    run.learn(10**9, 10.0)
    assert shares[4:] == [0.1, 0.3, 0.5, 0.7, 0.9]
    run.seconds = 30.0  # a killed run of 40 s resumes at three quarters
    run.learn(10**9, 10.0)
    assert shares[9:] == [31 / 40, 33 / 40, 35 / 40, 37 / 40, 39 / 40]
    run.seconds = 0.0
    run.learn(15, 10.0)
    assert shares[14:] == [14 / 15]  # iterations, not 0.1 of the time


@pytest.mark.parametrize(("before", "now"), [({}, {"train__rnd": "off"}), ({"train__rnd": "off"}, {})])
def test_distillation_can_be_switched_when_a_run_resumes(tmp_path, before, now):
    """Actor and critic continue; a new RND starts with fresh weights."""
    run, learner = started_run(tmp_path, **before)
    run.learn(2, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    other, _ = small_learner(tmp_path, seed=5, **now)
    restore(other, state, run._folder.checkpoint)
    for model in ("actor", "critic"):
        one, two = (getattr(each.algorithm, model).state_dict() for each in (learner, other))
        assert all(torch.equal(one[name], two[name]) for name in one)
    rnd = other.algorithm.rnd
    assert rnd is None if now else rnd.update_counter == 0
    metrics = other.iterate().metrics
    assert metrics["Loss/value"] > 0 and (metrics["Loss/rnd"] > 0) == (not now)


def test_a_resumed_run_does_not_repeat_noise(tmp_path, monkeypatch):
    """Noise follows from the module's counters, which continue; older checkpoints lack them."""
    loose = small_tasks.SENSORS.replace("threshold: 0.1 mm, release_threshold: 0.05 mm", "threshold: 1 mm")
    monkeypatch.setattr(small_tasks, "SENSORS", loose)
    run, learner = started_run(tmp_path, noise="noisy")
    run.learn(3, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    old_clock = learner.env.touch.memory.clock
    other, _ = small_learner(tmp_path, seed=5, noise="noisy")
    restore(other, state, run._folder.checkpoint)
    clock = other.env.touch.memory.clock
    assert torch.equal(clock.episode, old_clock.episode + 1) and torch.equal(clock.step, old_clock.step + 1)
    assert torch.equal(clock.reset_step, old_clock.step)
    fewer, _ = small_learner(tmp_path, num_envs=2, noise="noisy")
    restore(fewer, state, run._folder.checkpoint)
    assert torch.equal(torch.get_rng_state(), state["processes"][0]["cpu"])
    fewer.iterate()
    clock = fewer.env.touch.memory.clock
    for new, old in ((clock.episode, old_clock.episode), (clock.step, old_clock.step), (fewer.env.resets, learner.env.resets)):
        assert new.min() > old.max() > 1
    del state["processes"][0]["touch"]
    restore(other, state, run._folder.checkpoint)


@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        ({}, 4e-4),
        ({"train__learning_rate": 2e-3}, 2e-3),
        ({"train__adaptive": False}, 1e-3),
    ],
)
def test_learning_rates_of_a_resumed_run(tmp_path, rates, expected):
    """An adaptive rate continues, unless the document's rate has changed."""
    run, learner = started_run(tmp_path)
    learner.algorithm.learning_rate = 4e-4
    run.save()
    other, _ = small_learner(tmp_path, train__rnd__learning_rate=3e-3, **rates)
    restore(other, read_checkpoint(run._folder.checkpoint), run._folder.checkpoint)
    other.change_rates(run._folder.last_start()["spec"]["train"])
    assert other.algorithm.learning_rate == pytest.approx(expected)
    assert other.algorithm.optimizer.param_groups[0]["lr"] is other.algorithm.rate
    assert other.algorithm.rnd.optimizer.param_groups[0]["lr"] == 3e-3
    other.iterate()


def test_other_groups_and_networks_are_refused_by_name(tmp_path):
    run, _ = started_run(tmp_path)
    file = run._folder.checkpoint
    state = read_checkpoint(file)
    other, _ = small_learner(tmp_path, train__actor="[proprio]")
    with pytest.raises(CheckpointError, match=r"learned from the groups .*priv_proprio.*, not .*'proprio'"):
        restore(other, state, file)
    other, _ = small_learner(tmp_path, train__networks__hidden="[9]")
    with pytest.raises(CheckpointError, match=r"its networks are of other sizes: .*mlp"):
        restore(other, state, file)
    more, _ = small_learner(tmp_path, num_envs=5)
    restore(more, state, file)  # another number of environments: episodes restart
    assert int(more.env.steps.sum()) == 0


def test_invalid_checkpoints_are_reported(tmp_path):
    """The message has the file's content and a remedy, without torch's advice to run the file's code."""
    file, other = tmp_path / "whole.pt", tmp_path / "other.pt"
    run, _ = started_run(tmp_path)
    state = read_checkpoint(run._folder.checkpoint)
    write_checkpoint(state, file)
    content = file.read_bytes()

    def reported_content():
        with pytest.raises(CheckpointError) as raised:
            read_checkpoint(other)
        prefix, separator = f"{other}: found ", ", expected a checkpoint of `tgdsl train` or `tgdsl distill`; "
        assert str(raised.value).startswith(prefix)
        content_found, hint = str(raised.value).removeprefix(prefix).split(separator)
        assert hint == "put back a copy of one, or begin again with another --out"
        return content_found

    for part in (b"", b"no checkpoint", content[:1000], content[: len(content) // 2], content[:-1]):
        other.write_bytes(part)
        assert reported_content() == f"{len(part):,} bytes that are cut off, or of something else"
    for value in ({"actor": 1}, [1], Path("a")):  # the last is never loaded: that might run its code
        torch.save(value, other)
        assert reported_content() == "a file of something else"
    write_checkpoint(state | {"format": 2}, other)
    assert reported_content() == "a checkpoint of format 2, not 1, of another version of tgdsl"
    with pytest.raises(CheckpointError, match=r"none\.pt: there is no checkpoint"):
        read_checkpoint(tmp_path / "none.pt")


def test_files_of_a_run(tmp_path):
    run, learner = started_run(tmp_path)
    run.learn(3, float("inf"))
    folder = run._folder
    starts = json.loads(folder.run.read_text())["starts"]
    assert len(starts) == 1
    assert starts[0]["spec"]["train"]["networks"]["hidden"] == [8] and starts[0]["spec"]["rewards"]["success"] == 150
    assert starts[0]["taxels"] == learner.env.touch.taxels_id and len(starts[0]["module"]) == 64
    assert {"python", "torch", "rsl-rl-lib", "tgdsl"} <= starts[0]["versions"].keys()
    assert (folder.path / "task.yaml").read_bytes() == (tmp_path / "task.yaml").read_bytes()
    assert (folder.path / "sensors.yaml").read_bytes() == (tmp_path / "sensors.yaml").read_bytes()
    with (folder.path / "taxels.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = learner.env.touch.taxels["bit"]
    bit_rows = [row for row in rows if row["sensor"] == "bit"]
    assert [float(row["pos_0"]) for row in bit_rows] == table["pos"][:, 0].tolist()
    curve = folder.rows()
    assert [row["iteration"] for row in curve] == ["1", "2", "3"]
    assert [int(row["samples"]) for row in curve] == [16, 32, 48]
    assert all(float(row["Loss/value"]) > 0 for row in curve)


@pytest.mark.parametrize(
    ("group", "value"), [("goal", torch.inf), ("priv_obj_props", torch.inf), ("priv_obj_props", torch.nan)]
)
def test_observations_that_are_not_finite_end_a_run_before_its_checkpoint(tmp_path, group, value):
    """One number of one observation in the last iteration suffices; the message names its group."""
    run, learner = started_run(tmp_path)
    run.learn(1, float("inf"))
    content, observe = run._folder.checkpoint.read_bytes(), learner._seen

    def faulty_observe(obs):
        return observe({**obs, group: torch.where(torch.arange(obs[group].shape[1]) == 1, value, obs[group])})

    learner._seen = faulty_observe
    with pytest.raises(DivergedError, match=r"iteration 2: ") as raised:
        run.learn(2, float("inf"))
    assert run._folder.checkpoint.read_bytes() == content
    if value == torch.inf:  # NaN is in the losses at once
        network = "actor" if group == "goal" else "critic"
        assert f"{network}_state_dict.obs_normalizer._mean, which observes {group}, is not finite" in str(raised.value)


def test_the_first_rows_of_a_curve_may_have_no_episodes(tmp_path):
    """With episodes of 8 steps and iterations of 4, only every second iteration has any."""
    run, _ = started_run(tmp_path, train__desynchronise=False)
    run.learn(3, float("inf"))
    rows = [(row["episodes"], row["Episode/steps"], row["Reward/spin"] == "nan") for row in run._folder.rows()]
    assert rows == [("0", "nan", True), ("4", "8", False), ("0", "nan", True)]


def test_a_user_defined_task_is_copied_with_its_documents(tmp_path):
    file = small_tasks.small_task(tmp_path)
    assert sorted(documents(load_task(file))) == ["sensors.yaml", "task.yaml"]
    code = tmp_path / "own.py"
    code.write_text("from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\nclass Own(InPalmRotate):\n    pass\n")
    file.write_text(file.read_text().replace("task: in_palm_rotate", "task: own.py:Own"))
    files = documents(load_task(file))
    assert sorted(files) == ["own.py", "sensors.yaml", "task.yaml"] and files["own.py"].samefile(code)


def test_differences_of_documents():
    old = {"a": {"b": 1, "c": [1, 2]}, "d": 2.0}
    assert differences(old, {"a": {"b": 3, "c": [1, 2]}, "e": 4}) == ["a.b: 1, now 3", "d: 2.0, now null", "e: null, now 4"]


def test_nan_losses_end_a_run_before_its_checkpoint(tmp_path):
    run, learner = started_run(tmp_path)
    run.learn(1, float("inf"))
    with torch.no_grad():
        next(learner.algorithm.critic.parameters()).fill_(torch.nan)
    with pytest.raises(DivergedError, match=r"iteration 2: Loss/value is nan.*checkpoint\.pt is from before"):
        run.learn(3, float("inf"))
    assert read_checkpoint(run._folder.checkpoint)["iteration"] == 1


def test_runs_and_checkpoints_keep_their_time_limits(tmp_path, monkeypatch):
    """Each iteration takes 3 s; a checkpoint is written before another iteration would exceed 10 s."""
    run, learner = started_run(tmp_path, every=10.0)
    now, iterate = [0.0], learner.iterate
    monkeypatch.setattr("tgdsl.rl.train.run.time.monotonic", lambda: now[0])

    def slow(share):
        now[0] += 3.0
        return iterate(share)

    monkeypatch.setattr(learner, "iterate", slow)
    saved, save = [], run.save
    monkeypatch.setattr(run, "save", lambda: saved.append(learner.iteration) or save())
    run.learn(1000, 26.0)
    assert (learner.iteration, saved) == (9, [3, 6, 9])
    assert run.seconds == 27.0


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from small_runs import small_learner
from tgdsl.rl.train.folder import RunFolder, run_origin
from tgdsl.rl.train.run import Run

def train(base, place):
    base.mkdir()
    learner, loaded = small_learner(base)
    folder = RunFolder(base / "run")
    folder.begin(run_origin(loaded, learner.env, 0, {}, 1), loaded, learner.env)
    run = Run(learner, folder, 1e-9, "")
    run.learn(2, float("inf"))
    owner, name = {
        "update": (learner.algorithm, "_take_step"),
        "curve": (folder.__class__, "add_row"),
        "writing": (os, "fsync"),
        "replacing": (os, "replace"),
    }[place]
    before = getattr(owner, name)

    def killed(*arguments, **named):
        if place != "writing":
            before(*arguments, **named)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(owner, name, killed)
    run.learn(100, float("inf"))

for place in sys.argv[3:]:
    if not (child := os.fork()):
        train(Path(sys.argv[2]) / place, place)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL, place
"""
KILLS = {"update": 2, "curve": 2, "writing": 2, "replacing": 3}
"""Where a run is killed in its third iteration, and the iteration of its checkpoint."""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """Return the folder of forked runs, each killed at another place."""
    base = tmp_path_factory.mktemp("killed")
    arguments = [sys.executable, "-c", KILLED, str(Path(__file__).parents[2] / "helpers"), str(base), *KILLS]
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    process = subprocess.run(arguments, capture_output=True, text=True, env=environ)
    assert process.returncode == 0, process.stderr
    return base


@pytest.mark.slow
@pytest.mark.parametrize("place", KILLS)
def test_a_killed_run_resumes(killed, place):
    """SIGKILL in the third iteration: during its update, after its row, and around its checkpoint."""
    learner, loaded = small_learner(killed / place)
    folder = RunFolder(killed / place / "run")
    folder.check(is_resumed=True)
    state = read_checkpoint(folder.checkpoint)
    assert state["iteration"] == KILLS[place]
    assert len([file for file in folder.path.iterdir() if file.name.startswith(".")]) == (place == "writing")
    restore(learner, state, folder.checkpoint)
    folder.begin(run_origin(loaded, learner.env, 0, {}, 1), loaded, learner.env)
    assert not [file for file in folder.path.iterdir() if file.name.startswith(".")]
    Run(learner, folder, EVERY, RESUME, state["seconds"]).learn(5, float("inf"))
    assert [row["iteration"] for row in folder.rows()] == ["1", "2", "3", "4", "5"]
    assert read_checkpoint(folder.checkpoint)["iteration"] == 5
    assert len(json.loads(folder.run.read_text())["starts"]) == 2


def test_a_folder_that_cannot_be_written_is_named_before_a_run_begins(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match=r"file/run/checkpoint\.pt: .*file is a file, expected a folder"):
        RunFolder(tmp_path / "file" / "run").check(is_resumed=False)
    (tmp_path / "run" / "checkpoint.pt").mkdir(parents=True)
    with pytest.raises(TgdslError, match="this folder holds a run"):
        RunFolder(tmp_path / "run").check(is_resumed=False)
    with pytest.raises(TgdslError, match=r"there is no checkpoint\.pt to go on with"):
        RunFolder(tmp_path).check(is_resumed=True)


def test_a_full_disk_is_reported_before_a_run_begins(tmp_path):
    learner, loaded = small_learner(tmp_path)
    folder = RunFolder(tmp_path / "run")
    folder.begin(run_origin(loaded, learner.env, 0, {}, 1), loaded, learner.env)
    old_handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(FileError, match=r"run/checkpoint\.pt: File too large"):
            Run(learner, folder, EVERY, RESUME)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, old_handler)
    assert not folder.checkpoint.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_after_its_iteration(tmp_path, monkeypatch, number):
    """It writes a checkpoint and restores the signal handlers."""
    run, learner = started_run(tmp_path, every=1e9)
    old_handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    iterate = learner.iterate

    def iterate_with_signal(share):
        if learner.iteration == 1:
            os.kill(os.getpid(), number)
        return iterate(share)

    monkeypatch.setattr(learner, "iterate", iterate_with_signal)
    run.learn(5, float("inf"))
    assert (learner.iteration, run.stopped_by) == (2, number)
    assert read_checkpoint(run._folder.checkpoint)["iteration"] == 2
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == old_handlers


def test_a_second_interrupt_stops_at_once(tmp_path, monkeypatch):
    run, learner = started_run(tmp_path, every=1e9)

    def iterate_with_signals(share):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("the second one was not heard")

    monkeypatch.setattr(learner, "iterate", iterate_with_signals)
    old_handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # the test runner may have set another
    try:
        with pytest.raises(KeyboardInterrupt):
            run.learn(5, float("inf"))
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, old_handler)


def test_a_disk_that_fills_up_keeps_the_checkpoint_and_explains_resuming(tmp_path, monkeypatch):
    run, learner = started_run(tmp_path)
    iterate = learner.iterate

    def iterate_on_full_disk(share):
        if learner.iteration == 1:
            monkeypatch.setattr("tgdsl.rl.train.run.write_checkpoint", no_space)
        return iterate(share)

    def no_space(state, file):
        raise FileError(file, "No space left on device")

    monkeypatch.setattr(learner, "iterate", iterate_on_full_disk)
    message = rf"No space left on device; .*checkpoint\.pt is whole, of iteration 1; to go on: {RESUME}$"
    with pytest.raises(FileError, match=message):
        run.learn(5, float("inf"))
    assert read_checkpoint(run._folder.checkpoint)["iteration"] == 1


@pytest.mark.parametrize("name", ["add_scalar", "close"])
def test_write_errors_of_tensorboard_are_reported(tmp_path, monkeypatch, name):
    """Its writer thread raises at the next call, without a file's name."""
    run, _ = started_run(tmp_path)
    close = run.board.close

    def raise_no_space(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(run.board, name, raise_no_space)
    message = rf"events\.out\.tfevents: No space left on device; .*checkpoint\.pt is whole, .*to go on: {RESUME}$"
    with pytest.raises(FileError, match=message):
        run.learn(1, float("inf"))
    close()
