"""The command line: all commands, and `main`."""

from __future__ import annotations

import os
import sys
import warnings
from importlib.metadata import version

import tyro

from tgdsl.commands.arguments import subcommands
from tgdsl.commands.calibrate import Calibrate
from tgdsl.commands.distill import Distill
from tgdsl.commands.documents import Cache, Compile, Explain, Export, Listen, Run, Schema, Verify
from tgdsl.commands.examples import Examples
from tgdsl.commands.export_dataset import ExportDataset
from tgdsl.commands.hand import Hand
from tgdsl.commands.play import Deploy, Evaluate, Grasps, Play
from tgdsl.commands.report import Bench, Doctor
from tgdsl.commands.robots import ExportUsd, Import, Layout, Links, Render
from tgdsl.commands.sweep import Sweep
from tgdsl.commands.train import Train
from tgdsl.commands.view import View
from tgdsl.errors import SpecError, TgdslError

# Every command by its name. A command imports what it needs when it runs, so that `tgdsl --help` imports no torch.
Command = subcommands(
    *(
        Examples,
        Compile,
        Explain,
        Schema,
        Run,
        Listen,
        Play,
        Train,
        Distill,
        Sweep,
        Evaluate,
        Deploy,
        View,
        Render,
        Links,
        Layout,
    ),
    *(Import, ExportUsd, Export, ExportDataset, Verify, Cache, Bench, Doctor, Grasps, Hand, Calibrate),
)


def main() -> None:
    """Run one command; a mistake of the user's ends in its message and exit code 2, never in a traceback."""
    warnings.showwarning = lambda message, *_: print(f"tgdsl: warning: {message}", file=sys.stderr)
    try:
        try:
            _run()
        finally:
            sys.stdout.flush()
    except SpecError as error:
        count = len(error.problems)
        print(f"{error}\n{count} mistake{'s' if count > 1 else ''}", file=sys.stderr)
        sys.exit(2)
    except TgdslError as error:
        print(f"tgdsl: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        _discard_output()  # the reader has gone; say nothing at exit either
        sys.exit(1)
    except OSError as error:
        if error.filename is None:
            _discard_output()
        print(f"tgdsl: {error.filename or 'standard output'}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)


def _run() -> None:
    if sys.argv[1:] == ["--version"]:
        print(f"tgdsl {version('tgdsl')}")
        return
    if wrong := [word for word in sys.argv[1:] if word.partition("=")[0] == "--resolution"]:
        raise TgdslError(f"{wrong[0]}: there is no such option; write --set resolution=high")
    about = "Touch for robot learning. `tgdsl --version` prints the version."
    tyro.cli(Command, prog="tgdsl", description=about).run()


def _discard_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
