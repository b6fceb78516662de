"""`benchmarks/turns.py`: small scripts with the same options take turns."""

import argparse
import fcntl
import sys
import time
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import turns
from gpu_scenes import CASES, document, state_of

import tgdsl

SCRIPT = f"""
import sys, time
sys.path.insert(0, {sys.path[0]!r})
import argparse, pathlib, turns
parser = argparse.ArgumentParser()
parser.add_argument("--case")
parser.add_argument("--out", type=pathlib.Path)
turns.add_options(parser)
options = parser.parse_args()
assert options.child
print(options.case)
if options.case == "broken":
    sys.exit("no such thing")
turns.Turn(options.turn).take()
start = time.monotonic()
time.sleep(1.0)
options.out.write_text(f"{{start}} {{time.monotonic()}}")
"""


def run_cases(folder, cases, *arguments):
    """Run the script for each case; return case, output and written file, in the order in which processes ended."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    parser = argparse.ArgumentParser()
    turns.add_options(parser)
    options = parser.parse_args([*arguments], argparse.Namespace(arguments=[str(script), *arguments]))
    results = turns.children(options, ["--case"], [(case,) for case in cases])
    return [(case, output, out.read_text() if out.exists() else None) for (case,), output, out in results]


def is_free(path):
    """Return whether another process could take its turn at once."""
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


@pytest.mark.slow
def test_parallel_processes_hold_the_turn_until_they_end(tmp_path):
    results = run_cases(tmp_path, ["a", "b"], "--jobs", "2", "--turn", str(tmp_path / "turn"))
    assert sorted((case, output) for case, output, _ in results) == [("a", "a\n"), ("b", "b\n")]
    (_, end), (start, _) = sorted(tuple(map(float, written.split())) for _, _, written in results)
    assert end <= start
    assert (tmp_path / "turn").exists() and is_free(tmp_path / "turn")


@pytest.mark.slow
def test_a_failure_is_reported_and_the_others_go_on(tmp_path):
    (broken, output, written), (other, _, _) = run_cases(tmp_path, ["broken", "a"])
    assert (broken, output, written) == ("broken", "broken\nbroken: FAILED, exit status 1\nno such thing\n", None)
    assert other == "a"


def test_no_case_starts_after_the_time_limit(tmp_path):
    start = time.perf_counter()
    assert run_cases(tmp_path, ["a", "b"], "--minutes", "-1") == [("a", None, None), ("b", None, None)]
    assert time.perf_counter() - start < 1.0


@pytest.mark.slow
def test_the_turn_is_free_while_compiling_and_taken_to_run(tmp_path, monkeypatch):
    from torch._inductor import compile_fx

    touch, reference = (tgdsl.compile(document(CASES["depth"], tmp_path)) for _ in range(2))
    path, compiled = tmp_path / "turn", []
    original = compile_fx.compile_fx

    def watched(*arguments, config_patches=None, **options):
        call = original(*arguments, config_patches=config_patches, **options)
        if config_patches:
            compiled.append((is_free(path), config_patches))
        return call

    monkeypatch.setattr(compile_fx, "compile_fx", watched)
    state = state_of(touch, 8, 0)
    turn = turns.Turn(path)
    turn.take()
    assert not is_free(path)
    turn.give_back()
    turn.compile(touch)
    with torch.no_grad():
        assert is_free(path)
        readings = touch(state)
        assert not is_free(path)
        expected = reference.compile()(state)
    (was_free, options), (_, expected_options) = compiled
    assert was_free and options == expected_options
    assert all(torch.equal(readings[name], expected[name]) for name in expected)
