"""`benchmarks/students.py profile` on a CPU: all parts, small."""

import json
import sys
from pathlib import Path

import pytest
from tiny_tasks import write_task
from written_teachers import teacher

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import students

from tgdsl.rl.load import load_task

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")]
SMALL = ("distill.steps=4", "distill.networks.encoder.hidden=[8]", "distill.networks.hidden=[8]", "placement=hand")


@pytest.fixture
def options(tmp_path):
    """Return arguments for the tiny task with sensors of all types."""
    task = write_task(tmp_path, more="distill: {decoders: {}}\n")
    teacher_file = teacher(tmp_path / "teacher.pt", load_task(task), ["priv_proprio", "priv_obj_state"])
    small = ("--device", "cpu", "--warm", "1", "--iterations", "2", "--seeds", "3", "--type-seeds", "1")
    return ["profile", str(task), "--teacher", str(teacher_file), *small, "--set", *SMALL]


def test_all_parts_are_measured_and_written(options, tmp_path, capsys):
    students.main([*options, "--envs", "24", "--out", str(tmp_path / "report.json")])
    report = json.loads((tmp_path / "report.json").read_text())
    parts = report["parts"]
    assert {name: (part["students"], part["stacks"]) for name, part in parts.items()} == {
        "one": (1, 1),
        "seeds": (3, 1),
        "types": (8, 5),
        "one_beside": (1, 1),
    }
    for part in parts.values():
        assert part["rollout_ms"] > 0 and part["update_ms"] > 0
        assert part["ratio"] == pytest.approx(part["iteration_ms"] / parts["one"]["iteration_ms"], abs=1e-3)
        assert part["iteration_spread_ms"][0] <= part["iteration_ms"] <= part["iteration_spread_ms"][1]
    assert report["envs"] == 24 and report["steps"] == 4
    text = capsys.readouterr().out
    assert "seeds | 3 | 1 |" in text and "| 1.20" in text and "| 1.40" in text


def test_wrong_arguments_are_refused(options, capsys):
    for arguments, message in (
        (("--envs", "25"), "25 environments do not divide among 3 students: expected 24 or 27"),
        (("--envs", "24", "--types", "forces"), 'there is no type "forces"; did you mean "force"'),
    ):
        with pytest.raises(SystemExit) as error:
            students.main([*options, *arguments])
        assert error.value.code == 2 and message in capsys.readouterr().err
