"""`benchmarks/turns.py`: processes that take turns, by what small scripts of the same options do and print."""

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


def ended(folder, cases, *arguments):
    """Run the script for each case; return what was printed and what was written, in the order in which processes ended."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    parser = argparse.ArgumentParser()
    turns.add_options(parser)
    options = parser.parse_args([*arguments], argparse.Namespace(arguments=[str(script), *arguments]))
    found = turns.children(options, ["--case"], [(case,) for case in cases])
    return [(case, said, out.read_text() if out.exists() else None) for (case,), said, out in found]


def is_free(path):
    """Return whether another one could take its turn at once."""
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


@pytest.mark.slow
def test_of_processes_at_once_each_has_the_turn_until_it_ends(tmp_path):
    found = ended(tmp_path, ["a", "b"], "--jobs", "2", "--turn", str(tmp_path / "turn"))
    assert sorted((case, said) for case, said, _ in found) == [("a", "a\n"), ("b", "b\n")]
    (_, end), (start, _) = sorted(tuple(map(float, written.split())) for _, _, written in found)
    assert end <= start
    assert (tmp_path / "turn").exists() and is_free(tmp_path / "turn")


@pytest.mark.slow
def test_one_that_fails_is_said_and_the_others_go_on(tmp_path):
    (broken, said, written), (other, _, _) = ended(tmp_path, ["broken", "a"])
    assert (broken, said, written) == ("broken", "broken\nbroken: FAILED, exit status 1\nno such thing\n", None)
    assert other == "a"


def test_when_the_time_is_up_nothing_begins(tmp_path):
    start = time.perf_counter()
    assert ended(tmp_path, ["a", "b"], "--minutes", "-1") == [("a", None, None), ("b", None, None)]
    assert time.perf_counter() - start < 1.0


@pytest.mark.slow
def test_the_turn_is_given_back_to_compile_and_taken_when_code_that_is_that_of_compile_runs(tmp_path, monkeypatch):
    from torch._inductor import compile_fx

    touch, own = (tgdsl.compile(document(CASES["depth"], tmp_path)) for _ in range(2))
    path, compiled = tmp_path / "turn", []
    whole = compile_fx.compile_fx

    def watched(*arguments, config_patches=None, **options):
        call = whole(*arguments, config_patches=config_patches, **options)
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
        found = touch(state)
        assert not is_free(path)
        expected = own.compile()(state)
    (was_free, options), (_, expected_options) = compiled
    assert was_free and options == expected_options
    assert all(torch.equal(found[name], expected[name]) for name in expected)
