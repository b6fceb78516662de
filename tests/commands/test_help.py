"""The help of every command: a valid example and readable defaults."""

import shlex
import sys
import typing
from pathlib import Path

import pytest
import tyro

from tgdsl.commands.cli import EXAMPLES, Command

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "_ext"))

from tgdsl_docs.commands import command_names, help_of

NAMES = [" ".join(words) for words in command_names(Command)]
GROUPS = {"examples", "layout", "hand", "calibrate"}
"""Commands that only have subcommands."""


def test_every_command_has_an_example():
    assert EXAMPLES.keys() == set(NAMES) - GROUPS and len(typing.get_args(Command)) == len({name.split()[0] for name in NAMES})


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_a_command_is_valid(name):
    action = tyro.cli(Command, prog="tgdsl", args=[*name.split(), *shlex.split(EXAMPLES[name])])
    assert callable(action.run)


@pytest.mark.parametrize("name", NAMES)
def test_defaults_are_readable(name):
    text = help_of(tuple(name.split()))
    assert text.startswith(f"usage: tgdsl {name}") and "None" not in text and "default: ()" not in text


def test_the_help_ends_with_the_example(here, tmp_path):
    code, out, _ = here(tmp_path, "layout", "new", "--help")
    assert code == 0 and out.endswith("\nexample: tgdsl layout new hand.urdf --density 4/cm2 -o layout.yaml\n")
    code, out, _ = here(tmp_path, "compile", "--nothing")
    assert code == 2 and "example:" not in out
