"""The help of every command."""

from __future__ import annotations

import io
import os
import textwrap
import typing
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from typing import Any

import tyro

from tgdsl.commands.cli import Command, example_of

WIDTH = 90
"""Columns of the help: as many as a block of code has in a page."""


def command_pages() -> dict[str, str]:
    """Return one page with the help of all commands."""
    os.environ["COLUMNS"] = str(WIDTH)
    text = ["# Command line\n\nWhat `tgdsl COMMAND --help` prints.\n"]
    for words in command_names(Command):
        lines = help_of(words).strip().splitlines()  # tyro breaks none of its first lines
        lines = [line if line.startswith((" ", "usage:", "example:")) else textwrap.fill(line, WIDTH) for line in lines]
        text.append(f"\n## `tgdsl {' '.join(words)}`\n\n```text\n{chr(10).join(lines)}\n```\n")
    return {"commands.md": "".join(text)}


def command_names(union: Any, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the words of every command; a group comes before its commands."""
    for choice in typing.get_args(union):
        (name,) = (part.name for part in choice.__metadata__ if hasattr(part, "prefix_name"))
        words = (*before, name)
        yield words
        for hint in typing.get_type_hints(choice.__origin__, include_extras=True).values():
            for part in (hint, *typing.get_args(hint)):
                parts = typing.get_args(part)
                if parts and all(any(hasattr(m, "prefix_name") for m in getattr(p, "__metadata__", ())) for p in parts):
                    yield from command_names(part, words)


def help_of(words: tuple[str, ...]) -> str:
    """Return the help of a command."""
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        tyro.cli(Command, prog="tgdsl", args=[*words, "--help"])  # type: ignore[arg-type]
    lines = [*printed.getvalue().splitlines(), example_of([*words, "--help"])]
    return "\n".join(line.rstrip() for line in lines)
