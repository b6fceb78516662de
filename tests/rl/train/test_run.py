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


def begun(base, name="run", every=EVERY, **overrides):
    """Return a run that has begun, and its learner."""
    learner, loaded = small_learner(base, **overrides)
    folder = RunFolder(base / name)
    folder.check(is_resumed=False)
    folder.begin(run_origin(loaded, learner.env, 0, {}, 1), loaded, learner.env)
    return Run(learner, folder, every, RESUME), learner


def networks(learner):
    algorithm = learner.algorithm
    models = (algorithm.actor, algorithm.critic, algorithm.rnd.predictor, algorithm.rnd.state_normalizer)
    return [value.clone() for model in models for value in model.state_dict().values()]


def test_a_checkpoint_holds_all_that_learning_goes_on_from(tmp_path):
    """Networks, optimisers, rate, random numbers; and environments that go on to draw what they had not drawn."""
    run, learner = begun(tmp_path)
    run.learn(3, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    assert (state["iteration"], state["samples"]) == (3, 3 * 4 * 4)
    other, _ = small_learner(tmp_path, seed=5)
    restore(other, state, run._folder.checkpoint)
    assert all(torch.equal(one, two) for one, two in zip(networks(learner), networks(other), strict=True))
    assert (other.iteration, other.samples) == (3, 48)
    assert other.algorithm.learning_rate == learner.algorithm.learning_rate
    moments = [each.algorithm.optimizer.state_dict()["state"] for each in (learner, other)]
    for i, own in moments[0].items():
        assert all(torch.equal(value, moments[1][i][name]) for name, value in own.items())
    assert torch.equal(torch.get_rng_state(), state["processes"][0]["cpu"])
    assert torch.equal(other.env.resets, learner.env.resets + 1)
    assert torch.equal(other.env.steps, learner.env.steps)
    assert other.algorithm.rnd.update_counter == learner.algorithm.rnd.update_counter == 12
    other.iterate()
    assert other.iteration == 4


def test_a_checkpoint_of_a_gpu_goes_on_on_a_cpu(tmp_path, monkeypatch):
    """Without the GPU's random numbers, which torch would keep until there is a GPU."""
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda *_: pytest.fail("there is no GPU"))
    run, _ = begun(tmp_path)
    run.learn(1, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    state["processes"][0]["cuda"] = torch.zeros(16, dtype=torch.uint8)
    other, _ = small_learner(tmp_path, seed=5)
    restore(other, state, run._folder.checkpoint)
    assert torch.equal(torch.get_rng_state(), state["processes"][0]["cpu"])


def test_a_learner_gets_the_share_of_its_run_that_is_over(tmp_path, monkeypatch):
    """The larger share, of iterations or of time; both include the run before it was resumed."""
    run, learner = begun(tmp_path)
    shares, iterate = [], learner.iterate
    learner.iterate = lambda share: shares.append(share) or iterate(share)
    run.learn(2, float("inf"))
    run.learn(4, float("inf"))
    assert shares == [0.0, 1 / 2, 2 / 4, 3 / 4]
    seconds = itertools.count()  # one passes at each look at the clock
    monkeypatch.setattr("tgdsl.rl.train.run.time", SimpleNamespace(monotonic=lambda: float(next(seconds))))
    run.seconds = 0.0
    run.learn(10**9, 10.0)
    assert shares[4:] == [0.1, 0.3, 0.5, 0.7, 0.9]
    run.seconds = 30.0  # of a run that was killed, of 40 s: it goes on at three quarters
    run.learn(10**9, 10.0)
    assert shares[9:] == [31 / 40, 33 / 40, 35 / 40, 37 / 40, 39 / 40]
    run.seconds = 0.0
    run.learn(15, 10.0)
    assert shares[14:] == [14 / 15]  # iterations, not 0.1 of the time


@pytest.mark.parametrize(("before", "now"), [({}, {"train__rnd": "off"}), ({"train__rnd": "off"}, {})])
def test_distillation_is_turned_on_and_off_where_a_run_goes_on(tmp_path, before, now):
    """The networks that act go on; RND that is new begins with weights of its own."""
    run, learner = begun(tmp_path, **before)
    run.learn(2, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    other, _ = small_learner(tmp_path, seed=5, **now)
    restore(other, state, run._folder.checkpoint)
    for model in ("actor", "critic"):
        one, two = (getattr(each.algorithm, model).state_dict() for each in (learner, other))
        assert all(torch.equal(one[name], two[name]) for name in one)
    rnd = other.algorithm.rnd
    assert rnd is None if now else rnd.update_counter == 0
    found = other.iterate().metrics
    assert found["Loss/value"] > 0 and (found["Loss/rnd"] > 0) == (not now)


def test_noise_of_a_run_that_goes_on_was_not_drawn_before(tmp_path, monkeypatch):
    """The module's counts go on, from which its random numbers follow; an earlier checkpoint has none of them."""
    loose = small_tasks.SENSORS.replace("threshold: 0.1 mm, release_threshold: 0.05 mm", "threshold: 1 mm")
    monkeypatch.setattr(small_tasks, "SENSORS", loose)
    run, learner = begun(tmp_path, noise="noisy")
    run.learn(3, float("inf"))
    state = read_checkpoint(run._folder.checkpoint)
    before = learner.env.touch.memory.clock
    other, _ = small_learner(tmp_path, seed=5, noise="noisy")
    restore(other, state, run._folder.checkpoint)
    clock = other.env.touch.memory.clock
    assert torch.equal(clock.episode, before.episode + 1) and torch.equal(clock.step, before.step + 1)
    fewer, _ = small_learner(tmp_path, num_envs=2, noise="noisy")
    restore(fewer, state, run._folder.checkpoint)
    assert torch.equal(torch.get_rng_state(), state["processes"][0]["cpu"])
    fewer.iterate()
    clock = fewer.env.touch.memory.clock
    for now, drawn in ((clock.episode, before.episode), (clock.step, before.step), (fewer.env.resets, learner.env.resets)):
        assert now.min() > drawn.max() > 1
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
def test_rates_of_a_run_that_goes_on(tmp_path, rates, expected):
    """One that adapts stays where it was, unless the document has another than before."""
    run, learner = begun(tmp_path)
    learner.algorithm.learning_rate = 4e-4
    run.save()
    other, _ = small_learner(tmp_path, train__rnd__learning_rate=3e-3, **rates)
    restore(other, read_checkpoint(run._folder.checkpoint), run._folder.checkpoint)
    other.change_rates(run._folder.last_start()["spec"]["train"])
    assert other.algorithm.learning_rate == pytest.approx(expected)
    assert other.algorithm.optimizer.param_groups[0]["lr"] is other.algorithm.rate
    assert other.algorithm.rnd.optimizer.param_groups[0]["lr"] == 3e-3
    other.iterate()


def test_other_groups_networks_and_files_are_refused_by_name(tmp_path):
    run, _ = begun(tmp_path)
    file = run._folder.checkpoint
    state = read_checkpoint(file)
    other, _ = small_learner(tmp_path, train__actor="[proprio]")
    with pytest.raises(CheckpointError, match=r"learned from the groups .*priv_proprio.*, not .*'proprio'"):
        restore(other, state, file)
    other, _ = small_learner(tmp_path, train__networks__hidden="[9]")
    with pytest.raises(CheckpointError, match=r"its networks are of other sizes: .*mlp"):
        restore(other, state, file)
    more, _ = small_learner(tmp_path, num_envs=5)
    restore(more, state, file)  # of another number of environments: these begin again
    assert int(more.env.steps.sum()) == 0


def test_files_that_are_no_checkpoint_are_named(tmp_path):
    """The message says what the file holds and what to do; it leaves out torch's advice to run the file's code."""
    file, other = tmp_path / "whole.pt", tmp_path / "other.pt"
    run, _ = begun(tmp_path)
    state = read_checkpoint(run._folder.checkpoint)
    write_checkpoint(state, file)
    content = file.read_bytes()

    def found():
        with pytest.raises(CheckpointError) as raised:
            read_checkpoint(other)
        before, after = f"{other}: found ", ", expected a checkpoint of `tgdsl train` or `tgdsl distill`; "
        assert str(raised.value).startswith(before)
        said, hint = str(raised.value).removeprefix(before).split(after)
        assert hint == "put back a copy of one, or begin again with another --out"
        return said

    for part in (b"", b"no checkpoint", content[:1000], content[: len(content) // 2], content[:-1]):
        other.write_bytes(part)
        assert found() == f"{len(part):,} bytes that are cut off, or of something else"
    for value in ({"actor": 1}, [1], Path("a")):  # of which the last is not read: to do so might run it
        torch.save(value, other)
        assert found() == "a file of something else"
    write_checkpoint(state | {"format": 2}, other)
    assert found() == "a checkpoint of format 2, not 1, of another version of tgdsl"
    with pytest.raises(CheckpointError, match=r"none\.pt: there is no checkpoint"):
        read_checkpoint(tmp_path / "none.pt")


def test_files_of_a_run(tmp_path):
    run, learner = begun(tmp_path)
    run.learn(3, float("inf"))
    folder = run._folder
    said = json.loads(folder.run.read_text())["starts"]
    assert len(said) == 1
    assert said[0]["spec"]["train"]["networks"]["hidden"] == [8] and said[0]["spec"]["rewards"]["success"] == 150
    assert said[0]["taxels"] == learner.env.touch.taxels_id and len(said[0]["module"]) == 64
    assert {"python", "torch", "rsl-rl-lib", "tgdsl"} <= said[0]["versions"].keys()
    assert (folder.path / "task.yaml").read_bytes() == (tmp_path / "task.yaml").read_bytes()
    assert (folder.path / "sensors.yaml").read_bytes() == (tmp_path / "sensors.yaml").read_bytes()
    with (folder.path / "taxels.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = learner.env.touch.taxels["bit"]
    own = [row for row in rows if row["sensor"] == "bit"]
    assert [float(row["pos_0"]) for row in own] == table["pos"][:, 0].tolist()
    curve = folder.rows()
    assert [row["iteration"] for row in curve] == ["1", "2", "3"]
    assert [int(row["samples"]) for row in curve] == [16, 32, 48]
    assert all(float(row["Loss/value"]) > 0 for row in curve)


@pytest.mark.parametrize(
    ("group", "value"), [("goal", torch.inf), ("priv_obj_props", torch.inf), ("priv_obj_props", torch.nan)]
)
def test_numbers_that_are_not_finite_end_a_run_before_its_checkpoint(tmp_path, group, value):
    """One number of one observation in the last iteration; its group is named."""
    run, learner = begun(tmp_path)
    run.learn(1, float("inf"))
    content, observe = run._folder.checkpoint.read_bytes(), learner._seen

    def seen(obs):
        return observe({**obs, group: torch.where(torch.arange(obs[group].shape[1]) == 1, value, obs[group])})

    learner._seen = seen
    with pytest.raises(DivergedError, match=r"iteration 2: ") as raised:
        run.learn(2, float("inf"))
    assert run._folder.checkpoint.read_bytes() == content
    if value == torch.inf:  # not a number is in losses at once
        network = "actor" if group == "goal" else "critic"
        assert f"{network}_state_dict.obs_normalizer._mean, which observes {group}, is not finite" in str(raised.value)


def test_the_first_rows_of_a_curve_may_have_no_episodes(tmp_path):
    """Episodes of 8 steps, iterations of 4: the second one is the first that has any."""
    run, _ = begun(tmp_path, train__desynchronise=False)
    run.learn(3, float("inf"))
    found = [(row["episodes"], row["Episode/steps"], row["Reward/spin"] == "nan") for row in run._folder.rows()]
    assert found == [("0", "nan", True), ("4", "8", False), ("0", "nan", True)]


def test_a_task_of_ones_own_is_kept_with_its_documents(tmp_path):
    file = small_tasks.small_task(tmp_path)
    assert sorted(documents(load_task(file))) == ["sensors.yaml", "task.yaml"]
    own = tmp_path / "own.py"
    own.write_text("from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\nclass Own(InPalmRotate):\n    pass\n")
    file.write_text(file.read_text().replace("task: in_palm_rotate", "task: own.py:Own"))
    found = documents(load_task(file))
    assert sorted(found) == ["own.py", "sensors.yaml", "task.yaml"] and found["own.py"].samefile(own)


def test_how_documents_differ():
    before = {"a": {"b": 1, "c": [1, 2]}, "d": 2.0}
    assert differences(before, {"a": {"b": 3, "c": [1, 2]}, "e": 4}) == ["a.b: 1, now 3", "d: 2.0, now null", "e: null, now 4"]


def test_losses_that_are_no_numbers_end_a_run_before_its_checkpoint(tmp_path):
    run, learner = begun(tmp_path)
    run.learn(1, float("inf"))
    with torch.no_grad():
        next(learner.algorithm.critic.parameters()).fill_(torch.nan)
    with pytest.raises(DivergedError, match=r"iteration 2: Loss/value is nan.*checkpoint\.pt is from before"):
        run.learn(3, float("inf"))
    assert read_checkpoint(run._folder.checkpoint)["iteration"] == 1


def test_a_run_ends_in_time_and_checkpoints_come_in_time(tmp_path, monkeypatch):
    """By a clock that each iteration moves on by 3 s: a checkpoint before another one would make it more than 10 s."""
    run, learner = begun(tmp_path, every=10.0)
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
"""Where a run is killed in its third iteration, and the iteration of its checkpoint then."""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """The folder of runs that one process has forked, each killed at another place."""
    base = tmp_path_factory.mktemp("killed")
    arguments = [sys.executable, "-c", KILLED, str(Path(__file__).parents[2] / "helpers"), str(base), *KILLS]
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(arguments, capture_output=True, text=True, env=environ)
    assert done.returncode == 0, done.stderr
    return base


@pytest.mark.slow
@pytest.mark.parametrize("place", KILLS)
def test_a_run_that_is_killed_goes_on(killed, place):
    """SIGKILL in the third iteration: in its update, after its row was written, and around its checkpoint."""
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


def test_a_disk_that_is_full_is_named_before_a_run_begins(tmp_path):
    learner, loaded = small_learner(tmp_path)
    folder = RunFolder(tmp_path / "run")
    folder.begin(run_origin(loaded, learner.env, 0, {}, 1), loaded, learner.env)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(FileError, match=r"run/checkpoint\.pt: File too large"):
            Run(learner, folder, EVERY, RESUME)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert not folder.checkpoint.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_after_its_iteration(tmp_path, monkeypatch, number):
    """With a checkpoint, and with the handlers that were there."""
    run, learner = begun(tmp_path, every=1e9)
    before = [signal.getsignal(own) for own in (signal.SIGINT, signal.SIGTERM)]
    iterate = learner.iterate

    def signalled(share):
        if learner.iteration == 1:
            os.kill(os.getpid(), number)
        return iterate(share)

    monkeypatch.setattr(learner, "iterate", signalled)
    run.learn(5, float("inf"))
    assert (learner.iteration, run.stopped_by) == (2, number)
    assert read_checkpoint(run._folder.checkpoint)["iteration"] == 2
    assert [signal.getsignal(own) for own in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_second_interrupt_does_not_wait(tmp_path, monkeypatch):
    run, learner = begun(tmp_path, every=1e9)

    def signalled(share):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("the second one was not heard")

    monkeypatch.setattr(learner, "iterate", signalled)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may have another
    try:
        with pytest.raises(KeyboardInterrupt):
            run.learn(5, float("inf"))
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_disk_that_fills_up_leaves_a_whole_checkpoint_and_says_how_to_go_on(tmp_path, monkeypatch):
    run, learner = begun(tmp_path)
    iterate = learner.iterate

    def full(share):
        if learner.iteration == 1:
            monkeypatch.setattr("tgdsl.rl.train.run.write_checkpoint", no_space)
        return iterate(share)

    def no_space(state, file):
        raise FileError(file, "No space left on device")

    monkeypatch.setattr(learner, "iterate", full)
    goes_on = rf"No space left on device; .*checkpoint\.pt is whole, of iteration 1; to go on: {RESUME}$"
    with pytest.raises(FileError, match=goes_on):
        run.learn(5, float("inf"))
    assert read_checkpoint(run._folder.checkpoint)["iteration"] == 1


@pytest.mark.parametrize("name", ["add_scalar", "close"])
def test_what_tensorboard_cannot_write_is_named(tmp_path, monkeypatch, name):
    """It writes in a thread of its own, and raises what that has met where it is called next, without a file's name."""
    run, _ = begun(tmp_path)
    close = run.board.close

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(run.board, name, full)
    goes_on = rf"events\.out\.tfevents: No space left on device; .*checkpoint\.pt is whole, .*to go on: {RESUME}$"
    with pytest.raises(FileError, match=goes_on):
        run.learn(1, float("inf"))
    close()
