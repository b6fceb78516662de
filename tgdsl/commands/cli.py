"""The command line: what to do with documents and artefacts, and `main`.

Those that draw are in `run_commands`, on robots in `robot_commands`, on real hands in `hand_commands` and `calibrate_commands`.
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import Document, Overrides, module_of, parsed_overrides
from tgdsl.commands.cache import Cache
from tgdsl.commands.calibrate import Calibrate
from tgdsl.commands.hand import Hand
from tgdsl.commands.robot import ExportUsd, Import, LayoutNew, Links
from tgdsl.commands.run import Render, Run
from tgdsl.console.progress import StatusLine
from tgdsl.errors import SpecError, TgdslError


@dataclass(frozen=True)
class Compile:
    """Compile a document to an artefact that `tgdsl.load` and `tgdsl run` take."""

    document: Document
    """The YAML document."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """The artefact; default: the document's name with the ending .safetensors, in the working folder."""
    set: Overrides = ()
    """Override a value, as in `--set resolution=high`; may be repeated."""

    def run(self) -> None:
        """Compile, write and say what came of it."""
        from tgdsl.compiler.pipeline import compile_plan
        from tgdsl.files.files import with_folder, writable
        from tgdsl.module.artifact import save_plan

        start = time.perf_counter()
        out = writable(self.out or Path(self.document.with_suffix(".safetensors").name))
        with StatusLine() as progress:
            plan = compile_plan(self.document, parsed_overrides(self.set), progress=progress)
        size = save_plan(plan, with_folder(out))
        layout = plan.layout
        sensors = ", ".join(f"{s.name} ({s.kind}, {s.rows[1] - s.rows[0]})" for s in plan.sensors)
        print(f"{layout.num_taxels} taxels on {len(layout.links)} links at resolution {plan.origin.resolution}")
        print(f"sensors: {sensors}")
        print(f"{out}: {size} bytes in {time.perf_counter() - start:.1f} s")


@dataclass(frozen=True)
class Explain:
    """Say what a document or an artefact computes, what it leaves out and why, and what it costs."""

    document: Document
    """The YAML document, or an artefact (.safetensors)."""
    set: Overrides = ()
    """Override a value of the document, as in `--set resolution=high`; may be repeated."""

    def run(self) -> None:
        """Print the account."""
        with StatusLine() as progress:
            text = module_of(self.document, self.set, progress).explain()
        print(text)


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of documents and layouts, with which editors complete and check them."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("tgdsl.schema.json")
    """The file to write."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.files import write_whole
        from tgdsl.schema.document import json_schema

        write_whole(self.out, (json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n").encode())
        print(self.out)


Command = (
    Annotated[Compile, tyro.conf.subcommand("compile")]
    | Annotated[Explain, tyro.conf.subcommand("explain")]
    | Annotated[Schema, tyro.conf.subcommand("schema")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Links, tyro.conf.subcommand("links")]
    | Annotated[LayoutNew, tyro.conf.subcommand("layout")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[ExportUsd, tyro.conf.subcommand("export-usd")]
    | Annotated[Cache, tyro.conf.subcommand("cache")]
    | Annotated[Hand, tyro.conf.subcommand("hand")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
)


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
    about = "Touch for robot learning. `tgdsl --version` prints the version."
    tyro.cli(Command, prog="tgdsl", description=about).run()  # type: ignore[arg-type]


def _forget_output() -> None:
    """Have what is still to be printed go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
