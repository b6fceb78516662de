"""`tgdsl distill`, as users run it."""

import csv
import json
import shutil
import sys

import numpy as np
import pytest
import torch
from felt_tasks import felt_task
from written_teachers import teacher

from tgdsl.commands.distill import _warn_unlike
from tgdsl.commands.sweep import run_trial
from tgdsl.commands.sweep_document import Trial
from tgdsl.errors import FileError
from tgdsl.layout.layout import Link
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import compile_sensors
from tgdsl.rl.students.results import Row
from tgdsl.rl.train.folder import read_checkpoint
from tgdsl.rl.train.run import Run

pytestmark = [pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"), pytest.mark.usefixtures("no_onnx")]
SMALL = [
    *("--set", "distill.steps=4"),
    *("--set", "distill.networks.encoder.hidden=[8]"),
    *("--set", "distill.networks.touch_encoder.hidden=[8]"),
    *("--set", "distill.networks.hidden=[8]"),
    *("--set", "distill.epochs=2"),
]
TEACHER = ("--teacher", "teacher.pt", "--device", "cpu")
FIVE = ("--types", "depth,bool,none", "--placements", "ends,all", "--seeds", "1")


def rows_of(file):
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a folder with a task of two resolutions and a teacher."""
    folder = tmp_path_factory.mktemp("task")
    task = felt_task(folder)
    sensors = (folder / "sensors.yaml").read_text()
    dense = "      high:\n        tip: {method: grid, rows: 3, columns: 3, direction: [0, 0, 1], radius: 8 mm}\n"
    dense += "        finger: {method: grid, rows: 3, columns: 2, direction: [0, -1, 0], radius: 8 mm}\nobjects:"
    (folder / "sensors.yaml").write_text(sensors.replace("objects:", dense, 1))
    teacher(folder / "teacher.pt", load_task(task), ["priv_proprio", "priv_obj_state"])
    return folder


@pytest.fixture
def base(written, tmp_path):
    return shutil.copytree(written, tmp_path, dirs_exist_ok=True)


@pytest.fixture
def fails(here, base):
    """Return a function that runs a wrong command and returns its message; it must write nothing."""

    def run(*arguments):
        files_before = sorted(base.rglob("*"))
        code, out, message = here(base, "distill", "task.yaml", *arguments)
        assert (code, out) == (2, ""), message
        assert sorted(base.rglob("*")) == files_before
        return message

    return run


def test_from_a_teacher_to_students_that_play(base, here):
    """A student's file can be evaluated in its task; a resumed run has the same students, with their gates."""
    arguments = ("--envs", "10", "--iterations", "2", "--episodes", "2", "--set", "distill.gates={taxels: 3}", *SMALL)
    code, out, error = here(base, "distill", "task.yaml", *TEACHER, *FIVE, *arguments)
    assert code == 0, error
    assert out.splitlines()[0] == "5 students in 3 stacks, 10 environments: out/task_students/default"
    folder = base / "out" / "task_students"
    rows = rows_of(folder / "table.csv")
    kinds = [("depth", "ends"), ("bool", "ends"), ("depth", "all"), ("bool", "all"), ("none", "")]
    assert out.splitlines()[-1] == "table: out/task_students/table.csv"
    assert [line.split()[0] for line in out.splitlines()[-6:-1]] == [kind for kind, _ in kinds]
    assert [(row["type"], row["placement"]) for row in rows] == kinds
    assert all(row["samples"] == "16" and row["episodes"] == "2" for row in rows)
    evaluation = json.loads((folder / "default" / "evaluation.json").read_text())
    assert float(rows[0]["score"]) == evaluation["depth-ends-clean-s0"]["score"]
    card = json.loads((folder / "default" / "students" / "depth-all-clean-s0.json").read_text())
    assert card["groups"] == {"proprio": 6, "tactile_sensors": 10, "goal": 7} and card["teacher"] == "teacher.pt"
    assert len(card["gates"]) == 10 and all(1.0 < value < 2.5 for value in card["gates"]) and len(set(card["gates"])) > 1
    assert "gates" not in json.loads((folder / "default" / "students" / "none-s0.json").read_text())
    names = [{file.stem for file in (folder / "default" / "students").glob(f"*.{ending}")} for ending in ("pt", "onnx")]
    assert names[0] == names[1] and len(names[0]) == 5
    student = ("--policy", "out/task_students/default/students/depth-all-clean-s0.pt", "--episodes", "2", "--envs", "2")
    code, out, error = here(base, "evaluate", "task.yaml", *student, "--set", "touch=depth", "--set", "placement=all")
    assert code == 0 and out.startswith("score "), error
    code, out, error = here(base, "layout", "from-gates", student[1])
    assert (code, out) == (0, "layout_gates.yaml\nlayout_gates.low.csv\n"), error
    code, out, error = here(base, "evaluate", "task.yaml", *student, "--set", "touch=depth", "--set", "placement=tip")
    assert code == 2 and "this policy feels with other taxels" in error
    code, out, error = here(
        base, "distill", "task.yaml", "--resume", str(folder), "--device", "cpu", "--iterations", "3", "--episodes", "2"
    )
    assert code == 0, error
    assert read_checkpoint(folder / "default" / "checkpoint.pt")["iteration"] == 3
    curve = rows_of(folder / "default" / "curve.csv")
    assert [row["iteration"] for row in curve] == ["1", "2", "3"] and float(curve[2]["Loss/none-s0"]) > 0
    starts = json.loads((folder / "default" / "run.json").read_text())["starts"]
    assert [start["iteration"] for start in starts] == [0, 2]
    code, out, error = here(base, "distill", "task.yaml", "--resume", str(folder), "--types", "none", "--device", "cpu")
    assert code == 2 and "--types none: this run began with depth,bool,none; begin another one" in error


def test_the_layout_of_a_student_has_the_taxels_of_its_widest_gates(base, here):
    """A task with that layout sees just these taxels at `chosen`; its other groups of observations keep their sizes."""
    gates = [-1.0, 2.0, -4.0, -0.5, 5.0, 0.3, -3.0, -3.5, -5.0, -6.0]  # log α of six taxels on the finger, four on its tip
    overrides = {"touch": "depth", "placement": "all"}
    task, seen = load_task(base / "task.yaml", overrides), ["proprio", "tactile_sensors"]
    student = teacher(base / "student.pt", task, seen, gates=gates, overrides=overrides, task=str(base / "task.yaml"))
    sensors = (base / "sensors.yaml").read_text()
    head, tail = sensors.index("  layout:"), sensors.index("objects:")
    (base / "chosen.yaml").write_text(f"{sensors[:head]}  layout: new/chosen.yaml\n{sensors[tail:]}")
    before = compile_sensors(task, "cpu").groups["tactile_sensors"].layout
    for options, rows in (((), [0, 1, 3, 4, 5]), (("--taxels", "3"), [1, 4, 5])):
        code, out, error = here(base, "layout", "from-gates", str(student), "-o", "new/chosen.yaml", "--force", *options)
        assert (code, out) == (0, "new/chosen.yaml\nnew/chosen.low.csv\n"), error
        chosen = load_task(base / "task.yaml", {"touch": "depth", "placement": "chosen", "document": "chosen.yaml"})
        after = compile_sensors(chosen, "cpu").groups["tactile_sensors"].layout
        assert after.links == (Link("finger", "finger"),)
        for name in ("pos", "normal", "tangent", "radius", "area", "cell"):
            assert np.array_equal(getattr(after, name), getattr(before, name)[rows]), name
    envs = [TouchEnv(each, 2, threads=1) for each in (task, chosen)]
    assert envs[0].groups | {"tactile_sensors": 3} == envs[1].groups
    for env in envs:
        env.close()
    refused = [
        (("--taxels", "11"), "11 of its 10 taxels; give --taxels from 1 to 10"),
        (("--taxels", "0"), "--taxels 0: expected at least 1"),
        (("-o", "new/chosen.yaml"), "new/chosen.yaml: this file is there already; give --force to replace it"),
    ]
    for options, message in refused:
        code, _, error = here(base, "layout", "from-gates", str(student), *options)
        assert code == 2 and message in error
    elsewhere = teacher(base / "moved.pt", task, seen, gates=gates, overrides=overrides, task="gone/task.yaml")
    code, _, error = here(base, "layout", "from-gates", str(elsewhere))
    assert code == 2 and "moved.pt: its task, gone/task.yaml, is not here; run this in the folder where" in error
    (base / "sensors.yaml").write_text(sensors.replace("rows: 3, columns: 2", "rows: 2, columns: 3"))
    code, _, error = here(base, "layout", "from-gates", str(student))
    assert code == 2 and "student.pt: this policy feels with other taxels" in error
    code, _, error = here(base, "layout", "from-gates", "teacher.pt")
    assert code == 2 and "teacher.pt: this policy has no gates; teach a student with distill.gates" in error
    assert not (base / "layout_gates.yaml").exists()


def test_a_resumed_run_keeps_its_settings_and_prints_changes(base, here, monkeypatch):
    """It keeps the number of environments; sensing cannot change; old scores are removed."""
    arguments = (
        *TEACHER,
        "--types",
        "none",
        "--seeds",
        "1",
        "--episodes",
        "2",
        "--iterations",
        "1",
        *SMALL,
        "-o",
        "run",
        "--set",
        "placement=ends",
    )
    monkeypatch.setattr("tgdsl.commands.distill.ENVS", 6)
    assert here(base, "distill", "task.yaml", *arguments)[0] == 0
    assert json.loads((base / "run" / "distill.json").read_text())["envs"] == 6
    monkeypatch.setattr("tgdsl.commands.distill.ENVS", 8)
    resume = ("--resume", "run", "--device", "cpu", "--iterations", "2", "--episodes", "0")
    for key in ("resolution=high", "placement=all", "noise=noisy"):
        code, out, error = here(base, "distill", "task.yaml", *resume, "--set", key)
        assert (code, out) == (2, "") and f"--set {key}: what students feel stays as it is in a run that goes on" in error
    teacher(base / "teacher.pt", load_task(base / "task.yaml"), ["priv_proprio"])
    code, out, error = here(base, "distill", "task.yaml", *resume, "--set", "rewards.spin=3", "--set", "placement=ends")
    assert code == 0, error
    changes = [line for line in out.splitlines() if line.startswith("changed since the run began")]
    assert changes == [
        "changed since the run began: rewards.spin: 2.0, now 3.0",
        "changed since the run began: the teacher's file",
    ]
    assert [start["envs"] for start in json.loads((base / "run" / "default" / "run.json").read_text())["starts"]] == [6, 6]
    assert not (base / "run" / "table.csv").exists() and not (base / "run" / "default" / "evaluation.json").exists()
    for text in ("[]", '{"types": ["none"]}'):
        (base / "run" / "distill.json").write_text(text)
        code, _, error = here(base, "distill", "task.yaml", *resume)
        assert code == 2 and "distill.json: it has no teacher: this is not what tgdsl distill writes" in error


def test_a_resumed_run_accepts_a_moved_teacher(base, here):
    """Its bytes identify it."""
    arguments = (*TEACHER, "--types", "none", "--seeds", "1", "--envs", "2", "--episodes", "0", *SMALL)
    assert here(base, "distill", "task.yaml", *arguments, "--iterations", "1", "-o", "run")[0] == 0
    (base / "sub").mkdir()
    (base / "teacher.pt").rename(base / "sub" / "moved.pt")
    resume = ("--resume", str(base / "run"), "--device", "cpu", "--episodes", "0", "--iterations")
    code, _, error = here(base, "distill", "task.yaml", *resume, "2")
    assert code == 2 and "teacher.pt: cannot read this file" in error
    code, _, error = here(base / "sub", "distill", "../task.yaml", *resume, "2", "--teacher", "moved.pt")
    assert code == 0, error
    assert json.loads((base / "run" / "distill.json").read_text())["teacher"] == "moved.pt"
    teacher(base / "teacher.pt", load_task(base / "task.yaml"), ["priv_proprio"])
    code, _, error = here(base, "distill", "task.yaml", *resume, "3", "--teacher", "teacher.pt")
    assert code == 2 and "--teacher teacher.pt: this run began with sub/moved.pt; begin another one" in error


def test_a_full_disk_prints_the_command_to_resume(base, here, monkeypatch):
    """It names the folder of the run, not of a resolution."""
    files = []

    def filled(state, file):
        files.append(file)
        if len(files) == 2:
            raise FileError(file, "No space left on device")

    monkeypatch.setattr("tgdsl.rl.train.run.write_checkpoint", filled)
    arguments = (*TEACHER, "--types", "none", "--seeds", "1", "--envs", "2", "--episodes", "0", *SMALL)
    code, _, error = here(base, "distill", "task.yaml", *arguments, "--iterations", "1", "-o", "run")
    message = "run/default/checkpoint.pt is whole, of iteration 0; to go on: tgdsl distill task.yaml --device cpu --resume run"
    assert (code, error.splitlines()[-1]) == (2, f"tgdsl: run/default/checkpoint.pt: No space left on device; {message}")


def test_minutes_limit_each_start_and_are_summed(base, here, monkeypatch):
    """Fake learning takes 90 s per start; names with umlauts stay readable."""
    calls = []

    def learned(run, iterations, seconds, shown):
        calls.append((iterations, run.seconds, seconds))
        run.seconds += 90.0
        run.save()

    monkeypatch.setattr(Run, "learn", learned)
    (base / "teacher.pt").rename(base / "Lehrer für alle.pt")
    arguments = ("--teacher", "Lehrer für alle.pt", "--types", "none", "--seeds", "1", "--envs", "2", *SMALL, "-o", "run")
    assert here(base, "distill", "task.yaml", *arguments, "--device", "cpu", "--episodes", "0", "--minutes", "2")[0] == 0
    assert '"Lehrer für alle.pt"' in (base / "run" / "distill.json").read_text()
    resume = ("--resume", "run", "--device", "cpu", "--episodes", "2", "--minutes", "3", "--iterations", "7")
    code, _, error = here(base, "distill", "task.yaml", *resume)
    assert code == 0, error
    assert calls == [(6000, 0.0, 120.0), (7, 90.0, 180.0)]
    (row,) = rows_of(base / "run" / "table.csv")
    assert float(row["minutes"]) == 3.0


def test_changes_since_the_teacher_are_printed_once(base, here):
    """Sensing of students is no change; a changed sensor and the scene are, before the first resolution begins."""
    for name, before, now in (
        ("sensors.yaml", "max_range: 10 cm", "max_range: 11 cm"),
        ("scene.xml", 'mass=".1"', 'mass=".2"'),
    ):
        text = (base / name).read_text()
        assert text.count(before) == 1
        (base / name).write_text(text.replace(before, now))
    arguments = (*TEACHER, "--types", "none", "--seeds", "1", "--envs", "2", "--episodes", "0", "--iterations", "1", *SMALL)
    other = ("--set", "rewards.spin=3", "--set", "placement=all", "--resolutions", "low,high")
    code, out, error = here(base, "distill", "task.yaml", *arguments, *other)
    assert code == 0, error
    lines = ["rewards.spin: 2.0, now 3.0", "sensors.yaml: sensors.gap.max_range: 0.1, now 0.11", "the scene's bodies"]
    changes = [f"changed since the teacher was learned: {line}" for line in lines]
    assert out.splitlines()[:3] == changes and out.count("changed") == 3


def test_refused_arguments_leave_a_run_unchanged(base, here):
    """Wrong overrides are not kept; a folder holds one run; a run killed early starts again."""
    arguments = (*TEACHER, "--types", "none", "--seeds", "1", "--envs", "2", "--episodes", "2", *SMALL)
    code, _, error = here(base, "distill", "task.yaml", *arguments, "--set", "distill.decoders={size: {}}", "-o", "run")
    assert code == 2 and 'no privileged number "size"' in error and not (base / "run").exists()
    code, _, error = here(base, "distill", "task.yaml", *arguments, "--iterations", "1", "-o", "run")
    assert code == 0, error
    contents = {file: file.read_bytes() for file in (base / "run").rglob("*") if file.is_file()}
    resume = ("--resume", "run", "--device", "cpu", "--episodes", "0", "--iterations", "2")
    code, _, error = here(base, "distill", "task.yaml", *resume, "--set", "distill.networks.hidden=[9]")
    assert code == 2 and "its networks are of other sizes" in error
    for more in ((), ("--resolutions", "low")):
        code, _, error = here(base, "distill", "task.yaml", *arguments, *more, "-o", "run")
        assert code == 2 and "run: this folder holds a run; go on with --resume run, or give another --out" in error
    assert contents == {file: file.read_bytes() for file in (base / "run").rglob("*") if file.is_file()}
    code, _, error = here(base, "distill", "task.yaml", *resume, "--set", "distill.learning_rate=1e-5")
    assert code == 0, error
    assert json.loads((base / "run" / "distill.json").read_text())["overrides"]["distill.learning_rate"] == "1e-5"
    (base / "run" / "default" / "checkpoint.pt").unlink()
    contents = {file: file.read_bytes() for file in (base / "run").rglob("*") if file.is_file()}
    code, _, error = here(base, "distill", "task.yaml", *resume)
    assert code == 2 and "run/default: there is no checkpoint.pt to go on with" in error
    assert contents == {file: file.read_bytes() for file in (base / "run").rglob("*") if file.is_file()}
    (base / "run" / "default" / "curve.csv").unlink()  # like a run killed before its first checkpoint
    code, _, error = here(base, "distill", "task.yaml", *resume)
    assert code == 0, error
    assert [row["iteration"] for row in rows_of(base / "run" / "default" / "curve.csv")] == ["1", "2"]
    (base / "other").mkdir()
    (base / "other" / "default").write_text("")
    code, _, error = here(base, "distill", "task.yaml", *arguments, "--iterations", "1", "-o", "other")
    assert code == 2 and "other/default is a file, expected a folder" in error
    assert [file.name for file in (base / "other").iterdir()] == ["default"]
    (base / "run" / "distill.json").unlink()
    code, _, error = here(base, "distill", "task.yaml", *arguments, "-o", "run")
    assert code == 2 and "run: this folder holds default/run.json of a run; give another --out" in error


def test_resolutions_are_simulated_one_after_another(base, here, monkeypatch):
    """Unknown resolutions, and ones that cannot resume, are named before any starts."""
    compared = []
    monkeypatch.setattr("tgdsl.commands.distill._warn_unlike", compared.extend)
    arguments = (*TEACHER, "--types", "depth", "--placements", "ends", "--seeds", "2", "--envs", "4", "--iterations", "1")
    code, _, error = here(base, "distill", "task.yaml", *arguments, "--resolutions", "low,med", *SMALL)
    assert code == 2 and '"med"' in error and not (base / "out").exists()
    code, _, error = here(base, "distill", "task.yaml", *arguments, "--resolutions", "default", *SMALL)
    assert code == 2 and "--resolutions default: that is what a run calls the document's own; leave it out" in error
    code, _, error = here(
        base, "distill", "task.yaml", *arguments, "--resolutions", "low,high", "--episodes", "2", *SMALL, "-o", "both"
    )
    assert code == 0, error
    rows = rows_of(base / "both" / "table.csv")
    assert [(row["resolution"], row["seeds"]) for row in rows] == [("low", "2"), ("high", "2")]
    assert [row.resolution for row in compared] == ["low", "high"]
    cards = [
        json.loads((base / "both" / name / "students" / "depth-ends-clean-s1.json").read_text()) for name in ("low", "high")
    ]
    assert [card["groups"]["tactile_sensors"] for card in cards] == [4, 9]
    file = base / "both" / "high" / "checkpoint.pt"
    file.write_bytes(file.read_bytes()[:-1])
    contents = {file: file.read_bytes() for file in (base / "both").rglob("*") if file.is_file()}
    code, out, error = here(base, "distill", "task.yaml", "--resume", "both", "--device", "cpu", "--iterations", "2")
    assert (code, out) == (2, "") and f"both/high/checkpoint.pt: found {len(contents[file]):,} bytes that are cut off" in error
    assert contents == {file: file.read_bytes() for file in (base / "both").rglob("*") if file.is_file()}


def test_differing_numbers_of_control_steps_warn():
    """If they differ by more than a tenth."""
    rows = [
        Row("depth", "tips", name, "clean", 3, 0.5, 0.4, 0.6, 1.0, 9, samples, 1.0)
        for name, samples in (("low", 1100), ("med", 1000))
    ]
    _warn_unlike(rows)
    with pytest.warns(UserWarning, match="students had unlike numbers of control steps, low 1,100, med 999: `--iterations`"):
        _warn_unlike([rows[0], rows[1]._replace(samples=999)])


def test_mistakes_are_named_before_anything_runs(base, fails):
    assert "11 environments do not divide among 5 students: expected 10 or 15" in fails(*TEACHER, *FIVE, "--envs", "11")
    assert 'has no sensor of kind "elastomer", expected one' in fails(*TEACHER, "--types", "elastomer")
    assert 'there is no type "forces"; did you mean "force"' in fails(*TEACHER, "--types", "forces")
    assert "types bool, bool: one is named twice" in fails(*TEACHER, "--types", "bool,bool")
    assert "--resolutions low,low: one is named twice" in fails(*TEACHER, "--resolutions", "low,low")
    assert "--resolutions: expected one at least" in fails(*TEACHER, "--resolutions", ",")
    message = fails(*TEACHER, "--types", "depth", "--placements", "fing*,fing_", "--seeds", "1")
    assert "two students would have the name depth-fing_-clean-s0" in message
    assert "--teacher FILE is missing" in fails("--device", "cpu")
    assert "groups names a group twice" in fails(*TEACHER, "--set", "distill.groups=[proprio, proprio]")
    arguments = ("--types", "none,depth", "--placements", "all", "--set", "distill.groups=[tactile_sensors/depth/all/clean]")
    assert 'there is no group of observations "tactile_sensors/depth/all/clean"' in fails(*TEACHER, *arguments)
    resolution_twice = (*TEACHER, "--resolutions", "low", "--set", "resolution=high")
    assert "--set resolution=high: --resolutions says it of students" in fails(*resolution_twice)
    assert "--set touch=depth: --types says it of students" in fails(*TEACHER, "--set", "touch=depth")
    assert "--seeds 0: expected at least 1" in fails(*TEACHER, "--seeds", "0")
    assert "there is no run of tgdsl distill to go on with" in fails("--resume", "nothing")
    assert 'no link matches "palm"' in fails(*TEACHER, "--types", "bool", "--placements", "palm", "--resolutions", "low,high")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "screwdriver"}, 'this teacher was learned in the task "screwdriver", not "in_palm_rotate"'),
        ({"action": {"mode": "absolute"}}, 'this teacher was learned with other actions: {"mode": "absolute", "scale": '),
        ({"physics": {"timestep": 0.005, "substeps": 4}}, "learned with other control steps [s]: 0.02, here 0.025"),
    ],
)
def test_a_teacher_of_another_task_is_refused(base, fails, change, message):
    task = load_task(base / "task.yaml")
    spec = task.spec.model_dump(mode="json") | change
    teacher(base / "teacher.pt", task, ["priv_proprio"], spec=spec)
    assert message in fails(*TEACHER, *FIVE, "--envs", "10")


def test_a_teacher_of_other_taxels_or_without_a_card_is_refused(base, fails):
    task = load_task(base / "task.yaml")
    teacher(base / "teacher.pt", task, ["proprio", "tactile_sensors"], taxels="0")
    extra = {"card.json": "", "taxels.csv": ""}
    module = torch.jit.load(base / "teacher.pt", _extra_files=extra)
    lines = extra["taxels.csv"].decode().splitlines(keepends=True)
    extra["taxels.csv"] = "".join([lines[0], *lines[2:], lines[1]])  # move the first taxel to the end
    torch.jit.save(module, base / "teacher.pt", _extra_files=extra)
    assert "teacher.pt: this policy feels with other taxels" in fails(*TEACHER, *FIVE, "--envs", "10")
    stacked = task.spec.model_dump(mode="json") | {"temporal": "stack"}
    teacher(base / "teacher.pt", task, ["proprio", "tactile_sensors"], spec=stacked)
    assert "this teacher feels other readings of a control step: temporal stack, here last" in fails(*TEACHER, *FIVE)
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), base / "teacher.pt")
    assert "this policy has no card that says how it was learned" in fails(*TEACHER, *FIVE, "--envs", "10")
    teacher(base / "teacher.pt", task, ["proprio"])
    divided = ("--set", "distill.loss=inverse_variance")
    assert "its card has no deviations of actions, `std`" in fails(*TEACHER, *FIVE, "--envs", "10", *divided)


def test_students_of_a_sweep_are_resumed(base, here, monkeypatch):
    """A trial whose worker died after a checkpoint resumes in its folder."""
    arguments = (*TEACHER, "--types", "none", "--seeds", "1", "--envs", "2", "--episodes", "2", *SMALL)
    assert here(base, "distill", "task.yaml", *arguments, "--iterations", "1", "-o", "x")[0] == 0
    (base / "x" / "table.csv").unlink()
    for name in ("argv", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, getattr(sys, name))
    trial = Trial("x", {}, ("distill", "task.yaml", *arguments, "--iterations", "3"))
    assert run_trial(trial, str(base / "x")) == "done", (base / "x" / "log.txt").read_text()
    with (base / "x" / "default" / "curve.csv").open(newline="") as file:
        assert [row["iteration"] for row in csv.DictReader(file)] == ["1", "2", "3"]
    assert (base / "x" / "table.csv").is_file()
