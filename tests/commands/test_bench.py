"""`tgdsl bench`: output, files and error messages."""

import io
import sys

import pytest
from benched_pads import bench_document

from tgdsl.commands.report import Bench
from tgdsl.report.bench.bench import Bench as Work
from tgdsl.report.bench.bench import Options

FEW = ("--steps", "6", "--state-envs", "2", "--repeats", "1", "--envs", "2,3", "--sensors", "depth")


@pytest.mark.slow
def test_bench_prints_a_table_and_writes_three_files(here, tmp_path):
    bench_document(tmp_path)
    code, output, error = here(tmp_path, "bench", "pad.yaml", "-o", "out", "--save-states", "states.npz", *FEW)
    assert code == 0, error
    assert "depth (contact_depth), against as written, float64\n" in output
    assert "ms, 2 envs" in output and "ms, 3 envs" in output and "now" in output and "●" in output
    assert output.endswith("out/bench.csv\nout/bench.json\nout/bench.html\n")
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"bench.csv", "bench.json", "bench.html"}
    code, output, error = here(tmp_path, "bench", "pad.yaml", "-o", "again", "--states", "states.npz", *FEW)
    assert code == 0, error
    assert output.startswith("pad.yaml: states.npz: 6 steps in 2 environments\n")


def test_the_command_has_the_defaults_of_the_function():
    work, options = Work({}), Options()
    expected = (work.state_envs, work.steps, work.substeps, options.repeats, options.compiled, options.seed)
    command = Bench()
    assert (command.state_envs, command.steps, command.substeps, command.repeats, command.compiled, command.seed) == expected
    assert tuple(map(int, command.envs.split(","))) == options.num_envs


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--envs", "many"), "tgdsl: --envs many: expected whole numbers joined by commas, such as 1024,4096\n"),
        (("--envs", "0"), "tgdsl: environments that are timed: found 0, expected numbers of at least 1\n"),
        (("--sensors", "dept", "--envs", "1", "--repeats", "1"), 'tgdsl: there is no sensor "dept"; did you mean "depth"?\n'),
        (("--device", "abacus"), None),
        (("--states", "none.npz"), "tgdsl: none.npz: expected an .npz file of states: "),
        (("--out", "pad.yaml"), "tgdsl: pad.yaml/bench.csv: "),
        (("--set", "sensors.depth.gate=open"), None),
    ],
)
def test_wrong_arguments_are_refused(here, tmp_path, arguments, message):
    bench_document(tmp_path)
    code, output, error = here(tmp_path, "bench", "pad.yaml", *arguments)
    assert code == 2 and not output
    assert message is None or error.startswith(message)
    assert not (tmp_path / "report").exists()


def test_oracles_and_hard_cases_need_no_document(here, tmp_path, monkeypatch):
    from oracles import filters, report

    for name, function in (("CASES", "filters.maxwell_step()"), ("HARD", "contacts.first_reading()")):
        monkeypatch.setattr(report, name, [case for case in getattr(report, name) if case.name == function])
    code, output, error = here(tmp_path, "bench", "--oracles", "--hard", "-o", "out")
    assert code == 0, error
    assert (
        "Maxwell branch: after a step" in output
        and "the first reading of filters" in output
        and output.count("1 of 1 hold") == 2
    )
    names = {f"{stem}.{suffix}" for stem in ("oracles", "hard") for suffix in ("csv", "json", "html")}
    assert {file.name for file in (tmp_path / "out").iterdir()} == names
    monkeypatch.setattr(filters, "STRENGTH", 0.6)  # only in the closed form
    code, output, error = here(tmp_path, "bench", "--oracles", "-o", "out")
    assert code == 2 and error == "tgdsl: 1 results are not as they should be; they are marked in out\n" and "✗" in output


def test_oracles_count_their_cases_on_a_terminal(here, tmp_path, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    from oracles import report

    monkeypatch.setattr(report, "CASES", [case for case in report.CASES if case.name == "filters.maxwell_step()"] * 2)
    monkeypatch.setattr("oracles.sheet.write_sheet", lambda sheet, out: [])
    monkeypatch.setattr(sys, "stderr", screen := Terminal())
    code, output, _ = here(tmp_path, "bench", "--oracles", "-o", "out")
    assert code == 0 and "2 of 2 hold" in output
    counts = [line.partition(" ")[0] for line in screen.getvalue().split("\r") if "oracles: " in line]
    assert list(dict.fromkeys(counts)) == ["0/2", "1/2", "2/2"]


def test_an_installed_package_says_that_oracles_need_a_clone(here, tmp_path, monkeypatch):
    from tgdsl.commands import report

    monkeypatch.setattr(report, "__file__", str(tmp_path / "site-packages" / "tgdsl" / "commands" / "report.py"))
    for option in ("--oracles", "--hard"):
        code, output, error = here(tmp_path, "bench", option)
        assert code == 2 and not output
        assert error == (
            "tgdsl: bench --oracles and --hard run tgdsl's tests, which an installed package does not contain: in a clone of the "
            "repository, run `pip install -e .` and then the command again\n"
        )
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "tgdsl: bench: found no document, expected one, --oracles or --hard\n"),
        (("pad.yaml", "--hard"), "tgdsl: bench pad.yaml: --oracles and --hard need no document, expected one or the other\n"),
    ],
)
def test_a_document_excludes_oracles_and_hard_cases(here, tmp_path, arguments, message):
    bench_document(tmp_path)
    code, output, error = here(tmp_path, "bench", *arguments)
    assert (code, output, error) == (2, "", message)
