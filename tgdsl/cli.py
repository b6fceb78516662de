"""The command line: what to do with documents and artefacts, and `main`.

Commands on robots are in `robot_commands`, on real hands in `hand_commands` and `calibrate_commands`.
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.calibrate_commands import Calibrate
from tgdsl.errors import SpecError, TgdslError, did_you_mean
from tgdsl.hand_commands import Hand
from tgdsl.robot_commands import ExportUsd, Import, LayoutNew, Links

if TYPE_CHECKING:
    import mujoco

    from tgdsl.layout import Layout
    from tgdsl.module import TactileModule

Overrides = Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="KEY=VALUE"), tyro.conf.UseAppendAction]
Document = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]


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
        from tgdsl.artifact import save_plan
        from tgdsl.compiler.pipeline import compile_plan

        start = time.perf_counter()
        plan = compile_plan(self.document, parsed_overrides(self.set))
        out = self.out or Path(self.document.with_suffix(".safetensors").name)
        out.parent.mkdir(parents=True, exist_ok=True)
        size = save_plan(plan, out)
        layout = plan.layout()
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
        print(_module(self.document, self.set).explain())


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of documents and layouts, with which editors complete and check them."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("tgdsl.schema.json")
    """The file to write."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.schema.document import json_schema

        self.out.write_text(json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        print(self.out)


@dataclass(frozen=True)
class Run:
    """Step a document's scene on the CPU, show what is felt, and write readings and a picture."""

    document: Document
    """The YAML document, or an artefact (.safetensors)."""
    keyframes: tuple[str, ...] | None = None
    """Keyframes of the scene whose controls are held and moved between, in turn; the first is the start. Default: rest and
    squeeze if the scene has them, else its initial state is held."""
    seconds: float = 1.0
    """Duration of each hold and of each move between keyframes [s]."""
    controls: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Recorded controls instead: an .npz file with an array `ctrl` (step, actuator) or (step, env, actuator)."""
    num_envs: int = 1
    """Environments; the table and the picture show the first."""
    substeps: int = 5
    """Physics steps per control step."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("out")
    """Folder for readings.npz, picture.png and, where there are several readings, overview.png."""
    compiled: bool = False
    """Fuse the module with torch.compile first."""
    set: Overrides = ()
    """Override a value of the document, as in `--set resolution=high`; may be repeated."""

    def run(self) -> None:
        """Step through the controls, show the table, write the files."""
        from tqdm import tqdm

        from tgdsl.runtime.batch import simulate
        from tgdsl.runtime.overview import overview
        from tgdsl.runtime.rollout import (
            Recorder,
            default_keyframes,
            held_controls,
            recorded_controls,
            rollout,
            scripted_controls,
        )
        from tgdsl.runtime.table import LiveTable, table
        from tgdsl.runtime.view import picture

        touch = _module(self.document, self.set)
        if self.compiled:
            touch.compile()
        sim = simulate(touch, self.num_envs, substeps=self.substeps)
        keyframes = default_keyframes(sim.model) if self.keyframes is None else self.keyframes
        if self.controls is not None:
            controls = recorded_controls(self.controls)
        elif self.keyframes is None and not keyframes:
            controls = held_controls(sim.model, self.seconds, sim.control_step)
            print(f"the scene has no keyframes rest and squeeze: its initial state is held for {self.seconds:g} s")
        else:
            controls = scripted_controls(sim.model, keyframes, self.seconds, sim.control_step)
            sim.close()
            sim = simulate(touch, self.num_envs, substeps=self.substeps, keyframe=keyframes[0])
        self.out.mkdir(parents=True, exist_ok=True)
        recorder, live = Recorder(touch, len(controls), self.num_envs), LiveTable()
        readings = {}
        bar = tqdm(total=len(controls), unit="step", disable=None, leave=False)
        for step in rollout(touch, sim, controls):
            recorder.add(step)
            readings = step.readings
            bar.update()
            with bar.external_write_mode():
                live.show([f"t = {step.time:.2f} s", *table(touch, readings)], is_last=step.index == len(controls) - 1)
        bar.close()
        recorder.write(self.out / "readings.npz", controls)
        print(f"readings: {self.out / 'readings.npz'}")
        sensed = [output.rows for output in touch.outputs if output.rows in ("taxel", "body")]
        if "taxel" in sensed:
            print(f"picture:  {picture(touch, sim, readings, self.out / 'picture.png')}")
        if len(sensed) > 1 or "taxel" not in sensed:
            print(f"overview: {overview(touch, sim, readings, self.out / 'overview.png', title=self.document.stem)}")


@dataclass(frozen=True)
class Render:
    """Draw a hand and its taxels: a panel per resolution, coloured by link group. Nothing is simulated."""

    hand: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HAND")]
    """A YAML document, an artefact (.safetensors), the name of a robot, such as `xhand1`, or a robot's file."""
    layout: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Layout of a robot; default: its own, which lies beside it."""
    resolutions: tuple[str, ...] = ()
    """Resolutions to draw; default: the document's own, or all of the layout."""
    keyframe: str | None = None
    """Keyframe that gives the pose; default: the model's own initial state."""
    view: str = "front"
    """From where: front (what the taxels face), back, left, right or iso."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Pixels of the picture; default: 750 rows, and as many columns as the hand needs."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """The picture; default: the hand's name with the ending .png, in the working folder."""
    set: Overrides = ()
    """Override a value of the document, as in `--set resolution=high`; may be repeated."""

    def run(self) -> None:
        """Draw, write and say how many taxels there are."""
        from tgdsl.runtime.render import render

        model, layouts = self._layouts()
        out = self.out or Path(Path(self.hand).with_suffix(".png").name)
        path = render(model, layouts, out, keyframe=self.keyframe, view=self.view, size=self.size)
        print(", ".join(f"{name}: {layout.num_taxels} taxels" for name, layout in layouts.items()))
        print(f"picture: {path}")

    def _layouts(self) -> tuple[mujoco.MjModel, dict[str, Layout]]:
        """Return the model and the layouts to draw by resolution: an artefact's own, or those that its document would have."""
        if not self.hand.endswith(".safetensors"):
            from tgdsl.compiler.pipeline import layouts

            return layouts(_document(self.hand, self.layout), parsed_overrides(self.set), self.resolutions)
        from tgdsl.artifact import load_plan
        from tgdsl.scene import scene_model

        plan = load_plan(self.hand)
        resolution = plan.origin.resolution
        if self.set or self.layout or set(self.resolutions) - {resolution}:
            raise TgdslError(f'an artefact has the layout and resolution it was compiled with, "{resolution}", and no other')
        return scene_model(plan.scene), {resolution: plan.layout()}


def _document(hand: str, layout: Path | None) -> Path | dict[str, object]:
    """Return the document that an argument names, or one of just a robot and its layout.

    Raises:
        TgdslError: If it names nothing, or a robot that comes without a layout.
    """
    from tgdsl.schema.files import is_file, layout_file, robot_names

    path, names = Path(hand), robot_names()
    if path.suffix in (".yaml", ".yml"):
        if layout is not None:
            raise TgdslError(f"--layout {layout}: a document names its layout itself; try --set robot.layout={layout}")
        return path
    if hand not in names and not is_file(path):
        raise TgdslError(f'there is no document, artefact or robot "{hand}"; {did_you_mean(hand, names, "robots")}')
    own = layout or layout_file(names.get(hand, path))
    if own is None:
        raise TgdslError(f"{hand}: there is no layout.yaml beside this robot; name its layout with --layout")
    return {"tgdsl": 1, "robot": {"model": hand, "layout": str(own)}}


def parsed_overrides(pairs: tuple[str, ...]) -> dict[str, str]:
    """Return `KEY=VALUE` arguments as a mapping.

    Raises:
        TgdslError: If one has no equals sign.
    """
    for pair in pairs:
        if "=" not in pair:
            raise TgdslError(f'--set {pair}: expected KEY=VALUE, such as "resolution=high"')
    return {key: value for key, _, value in (pair.partition("=") for pair in pairs)}


def _module(document: Path, overrides: tuple[str, ...]) -> TactileModule:
    import tgdsl

    if document.suffix == ".safetensors":
        if overrides:
            raise TgdslError("an artefact cannot be overridden; compile the document with --set instead")
        return tgdsl.load(document)
    return tgdsl.compile(document, overrides=parsed_overrides(overrides))


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
    | Annotated[Hand, tyro.conf.subcommand("hand")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
)


def _warn(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
    print(f"tgdsl: warning: {message}", file=sys.stderr)


def main() -> None:
    """Run one command; a mistake of the user's ends in its message and exit code 2, never in a traceback."""
    warnings.showwarning = _warn
    command = tyro.cli(Command, prog="tgdsl", description="Touch for robot learning.")  # type: ignore[arg-type]
    try:
        command.run()
    except SpecError as error:
        count = len(error.problems)
        print(f"{error}\n{count} mistake{'s' if count > 1 else ''}", file=sys.stderr)
        sys.exit(2)
    except TgdslError as error:
        print(f"tgdsl: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has gone; say nothing at exit either
        sys.exit(1)
    except OSError as error:
        print(f"tgdsl: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
