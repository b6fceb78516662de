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
    *(Examples, Compile, Explain, Schema, Run, Listen, Play, Train, Distill, Sweep, Evaluate, Deploy),
    *(View, Render, Links, Layout),
    *(Import, ExportUsd, Export, ExportDataset, Verify, Cache, Bench, Doctor, Grasps, Hand, Calibrate),
)

EXAMPLES = {
    "examples list": "",
    "examples copy": "xhand1_palm tasks/find_ridge",
    "compile": "hand.yaml -o hand.safetensors --set resolution=high",
    "explain": "hand.yaml",
    "schema": "-o tgdsl.schema.json",
    "run": "hand.yaml --keyframes rest squeeze --view left",
    "listen": "examples/materials_audio.yaml",
    "play": "examples/tasks/find_ridge.yaml --policy policies/find_ridge.pt",
    "train": "examples/tasks/find_ridge.yaml --device cpu --envs 128 --minutes 2",
    "distill": "examples/tasks/in_palm_rotate_cube.yaml --teacher policies/in_palm_rotate_cube.pt --minutes 4",
    "sweep": "examples/tasks/sweep.yaml",
    "evaluate": "examples/tasks/find_ridge.yaml --policy policies/find_ridge.pt --episodes 256",
    "deploy": "examples/tasks/grip_force.yaml --policy policies/grip_force_agg_force.pt --episodes 16",
    "view": "hand.yaml",
    "render": "xhand1 --resolutions low high --view back",
    "links": "xhand1",
    "layout new": "hand.urdf --density 4/cm2 -o layout.yaml",
    "layout freeze": "hand.yaml -o frozen.yaml",
    "layout from-gates": "out/students/default/students/depth-hand-clean-s0.pt --taxels 40 -o layout_40.yaml",
    "import": "hand.usd -o hand.xml",
    "export-usd": "hand.xml -o hand.usda",
    "export": "hand.yaml --to onnx",
    "export-dataset": "examples/tasks/find_ridge.yaml --policy policies/find_ridge.pt --episodes 100",
    "verify": "hand.onnx",
    "cache": "--clear",
    "bench": "hand.yaml --sensors skin --envs 1024,4096 --device cuda",
    "doctor": "",
    "grasps": "examples/tasks/screwdriver.yaml --num 512",
    "hand probe": "",
    "hand monitor": "--port emulator",
    "hand tare": "-o hand.calibration.yaml",
    "hand record": "press.npz --seconds 20 --calibration hand.calibration.yaml",
    "hand replay": "press.npz --speed 2",
    "calibrate sensor": 'skin.yaml press.npz --fit skin.thickness="1 mm:9 mm" --hold-out blocks -o fitted.yaml',
    "calibrate hand": "--log press.npz --loads loads.yaml",
}
"""Arguments of each command that its help shows."""


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
    about = (
        "Simulate tactile sensors of robot hands, and train policies with them. Start with `tgdsl examples list`. "
        "`tgdsl COMMAND --help` has the options of a command and an example; `tgdsl --version` prints the version."
    )
    try:
        command = tyro.cli(Command, prog="tgdsl", description=about)
    except SystemExit:
        if example := example_of(sys.argv[1:]):
            print(example)
        raise
    command.run()


def example_of(words: list[str]) -> str:
    """Return the last line of a command's help; empty if the words do not ask for it."""
    *command, last = words or [""]
    name = " ".join(command)
    full = next((each for each in EXAMPLES if f"{each} ".startswith(f"{name} ")), None)
    return f"example: tgdsl {full} {EXAMPLES[full]}".rstrip() if full and last in ("-h", "--help") else ""


def _discard_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
