"""The command line: all commands, and `main`."""

from __future__ import annotations

import os
import sys
import warnings
from importlib.metadata import version
from typing import Annotated

import tyro

from tgdsl.commands.cache import Cache
from tgdsl.commands.calibrate.calibrate import Calibrate
from tgdsl.commands.compile import Compile
from tgdsl.commands.explain import Explain
from tgdsl.commands.export import Export
from tgdsl.commands.export_dataset import ExportDataset
from tgdsl.commands.export_usd import ExportUsd
from tgdsl.commands.grasps import Grasps
from tgdsl.commands.hand.hand import Hand
from tgdsl.commands.import_ import Import
from tgdsl.commands.layout.layout import Layout
from tgdsl.commands.learning.deploy import Deploy
from tgdsl.commands.learning.distill import Distill
from tgdsl.commands.learning.evaluate import Evaluate
from tgdsl.commands.learning.sweep import Sweep
from tgdsl.commands.learning.train import Train
from tgdsl.commands.links import Links
from tgdsl.commands.listen import Listen
from tgdsl.commands.play import Play
from tgdsl.commands.render import Render
from tgdsl.commands.report.bench import Bench
from tgdsl.commands.report.doctor import Doctor
from tgdsl.commands.run import Run
from tgdsl.commands.schema import Schema
from tgdsl.commands.verify import Verify
from tgdsl.commands.view import View
from tgdsl.errors import SpecError, TgdslError

Command = (
    Annotated[Compile, tyro.conf.subcommand("compile")]
    | Annotated[Explain, tyro.conf.subcommand("explain")]
    | Annotated[Schema, tyro.conf.subcommand("schema")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Listen, tyro.conf.subcommand("listen")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Distill, tyro.conf.subcommand("distill")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Deploy, tyro.conf.subcommand("deploy")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Links, tyro.conf.subcommand("links")]
    | Annotated[Layout, tyro.conf.subcommand("layout")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[ExportUsd, tyro.conf.subcommand("export-usd")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[ExportDataset, tyro.conf.subcommand("export-dataset")]
    | Annotated[Verify, tyro.conf.subcommand("verify")]
    | Annotated[Cache, tyro.conf.subcommand("cache")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Grasps, tyro.conf.subcommand("grasps")]
    | Annotated[Hand, tyro.conf.subcommand("hand")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
)
"""Every command by its name. What a command needs it imports when it runs, so that `tgdsl --help` imports no torch."""


def _warn(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
    print(f"tgdsl: warning: {message}", file=sys.stderr)


def main() -> None:
    """Run one command; a mistake of the user's ends in its message and exit code 2, never in a traceback."""
    warnings.showwarning = _warn
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
        _forget_output()  # the reader has gone; say nothing at exit either
        sys.exit(1)
    except OSError as error:
        if error.filename is None:
            _forget_output()
        print(f"tgdsl: {error.filename or 'standard output'}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)


def _run() -> None:
    if sys.argv[1:] == ["--version"]:
        print(f"tgdsl {version('tgdsl')}")
        return
    if wrong := [word for word in sys.argv[1:] if word.partition("=")[0] == "--resolution"]:
        raise TgdslError(f"{wrong[0]}: there is no such option; write --set resolution=high")
    about = "Touch for robot learning. `tgdsl --version` prints the version."
    tyro.cli(Command, prog="tgdsl", description=about).run()  # type: ignore[arg-type]


def _forget_output() -> None:
    """Discard further output."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
