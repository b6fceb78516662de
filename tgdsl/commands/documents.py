"""Commands on a document: compile, explain, run, listen, export, verify, bring its schema, and the cache of compilations."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import ArtifactError, TgdslError, did_you_mean, listed
from tgdsl.files.write import check_writable, with_folder

if TYPE_CHECKING:
    from torch import Tensor

    from tgdsl.module.module import TactileModule
    from tgdsl.plan.sensors import PlannedSensor
    from tgdsl.runtime.batch.simulation import BatchSimulation
    from tgdsl.runtime.rollout import Controls, Recorder
    from tgdsl.view.sound import Sound

Seconds = Annotated[float, tyro.conf.arg(help="Duration of each hold, and of each move between keyframes [s].")]


@dataclass(frozen=True)
class Compile:
    """Compile a document to an artefact, which `tgdsl.load` and `tgdsl run` read."""

    document: args.Document
    out: args.OptionalOut = None
    """The artefact; default: the document's name with .safetensors, in the working folder."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.module.artifact import save_plan
        from tgdsl.tuning.compile import compile_plan

        start = time.perf_counter()
        out = check_writable(self.out or args.in_working_folder(self.document, ".safetensors"))
        with StatusLine() as progress:
            plan = compile_plan(self.document, args.parsed_overrides(self.set), progress=progress)
        size = save_plan(plan, with_folder(out))
        print(f"{plan.layout.num_taxels} taxels on {len(plan.layout.links)} links{plan.origin.at_resolution}")
        print("sensors: " + ", ".join(f"{s.name} ({s.kind}, {s.rows[1] - s.rows[0]})" for s in plan.sensors))
        print(f"{out}: {size} bytes in {time.perf_counter() - start:.1f} s")


@dataclass(frozen=True)
class Explain:
    """Print what a document or an artefact computes, what it leaves out and why, and its cost."""

    document: args.DocumentOrArtefact
    set: args.Overrides = ()

    def run(self) -> None:
        with StatusLine() as progress:
            text = args.module_of(self.document, self.set, progress).explain()
        print(text)


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of documents and layouts, or of tasks, for completion and checks in editors."""

    tasks: bool = False
    """Write the schema of tasks instead of the one of documents and layouts."""
    out: args.OptionalOut = None
    """The file to write; default: tgdsl.schema.json, or tgdsl.task.schema.json."""

    def run(self) -> None:
        from tgdsl.rl.load import task_schema
        from tgdsl.schema.document import json_schema

        out = self.out or Path("tgdsl.task.schema.json" if self.tasks else "tgdsl.schema.json")
        args.write_json(out, task_schema() if self.tasks else json_schema())
        print(out)


@dataclass(frozen=True)
class Run:
    """Step a document's scene on the CPU and show the readings; write them and a picture."""

    document: args.DocumentOrArtefact
    keyframes: Annotated[tuple[str, ...] | None, args.optional("NAME [NAME ...]")] = None
    """Keyframes of the scene; their controls are applied in turn, with moves between them, and the first one is the start.
    Default: rest and squeeze, if the scene has both, else the hand closes on the first object that fits between its fingers."""
    seconds: Seconds = 1.0
    controls: args.OptionalFile = None
    """An .npz file with recorded controls, an array `ctrl` (step, actuator) or (step, env, actuator); default: keyframes."""
    num_envs: Annotated[int, tyro.conf.arg(aliases=["--envs"])] = 1
    """Number of environments; they differ by their controls alone. The table and the picture show the first."""
    substeps: args.OptionalInt = None
    """Physics steps per control step; default: the `substeps` of sensors that read blocks, or 5."""
    out: args.OutFolder = Path("out")
    """Folder for readings.npz, picture.png and, if there are several readings, overview.png."""
    compiled: args.Compiled = False
    view: Annotated[str | None, args.optional("VIEW")] = None
    """Viewpoint of the pictures: front (the side that taxels face), back, left, right, top (from beyond the fingertips),
    bottom, iso, or AZIMUTH,ELEVATION [degrees; front is about 0,0]. Default: the view with most loaded taxels."""
    temperatures: Annotated[tuple[float, float] | None, args.optional("LOW HIGH")] = None
    """Range of the colour scale of temperatures [°C]; default: the lowest and the highest reading."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.runtime.rollout import Recorder, missed_loads, silent_readings, touching_bodies
        from tgdsl.view.cameras import ViewError, angles_of

        if self.temperatures is not None and not self.temperatures[0] < self.temperatures[1]:
            low, high = self.temperatures
            raise ViewError(f"--temperatures {low:g} {high:g}: expected the lower one first")
        if self.view is not None:
            angles_of(self.view)
        record, *pictures = (check_writable(self.out / name) for name in ("readings.npz", "picture.png", "overview.png"))
        with StatusLine() as progress:
            touch = args.module_of(self.document, self.set, progress)
            if self.compiled:
                touch.compile()
            progress(f"starting {self.num_envs} environments" if self.num_envs > 1 else "starting the simulation")
            sim, controls = self.start(touch, progress)
            recorder = Recorder(touch, len(controls), self.num_envs)
        readings = self._steps(touch, sim, controls, recorder)
        touching = touching_bodies(touch, sim)
        if touch.plan.objects and not touching:
            print("at the end nothing touches an object")
        for name, bodies in silent_readings(touch, sim, readings, touching).items():
            problem = f'an object touches {listed(bodies)}, and "{name}" is 0 on all taxels'
            print(f"at the end {problem}: do they face it? A grid along [0, 0, -1] is on the side that faces +z")
        for name, problem in missed_loads(touch, readings).items():
            print(f"at the end {problem}: see {name}")
        names = [sim.model.actuator(i).name for i in range(sim.model.nu)]
        recorder.write(with_folder(record), controls, self.document, names)
        print(f"readings: {record}")
        self._draw(touch, sim, readings, *pictures)

    def start(self, touch: TactileModule, progress: StatusLine) -> tuple[BatchSimulation, Controls]:
        """Return the scene at its start, and the controls that it is stepped through."""
        from tgdsl.runtime.connect import simulate
        from tgdsl.runtime.rollout import recorded_controls, script_of, substeps_of

        substeps = substeps_of(touch, 5) if self.substeps is None else self.substeps
        if self.controls is not None:
            return simulate(touch, self.num_envs, substeps=substeps), recorded_controls(self.controls)
        script = script_of(touch, self.keyframes, progress)
        if script.note:
            held = "" if script.closing else f": its initial state is held for {self.seconds:g} s"
            print(f"{script.note}{held}")
        return script.begin(touch, self.num_envs, substeps, self.seconds)

    def _steps(self, touch: TactileModule, sim: BatchSimulation, controls: Controls, recorder: Recorder) -> dict[str, Tensor]:
        """Make all steps, and return the last readings."""
        from tgdsl.console.progress import LiveTable
        from tgdsl.runtime.rollout import rollout
        from tgdsl.view.table import table

        live, readings = LiveTable(), {}
        with args.progress_bar("compiling kernels" if self.compiled else "stepping", len(controls)) as bar:
            for step in rollout(touch, sim, controls):
                recorder.add(step)
                readings = step.readings
                bar.set_description("stepping", refresh=False)
                bar.update()
                with bar.external_write_mode():
                    live.show([f"t = {step.time:.2f} s", *table(touch, readings)], is_last=step.index == len(controls) - 1)
        return readings

    def _draw(
        self, touch: TactileModule, sim: BatchSimulation, readings: dict[str, Tensor], taxels: Path, everything: Path
    ) -> None:
        from tgdsl.view.overview import drawn_outputs, overview
        from tgdsl.view.picture import picture

        drawn = []
        with StatusLine() as progress:
            rows = [output.rows for output in drawn_outputs(touch)]
            if "taxel" in rows:
                progress("drawing the picture")
                drawn.append(f"picture:  {picture(touch, sim, readings, taxels, view=self.view)}")
            if len(rows) > 1 or (rows and "taxel" not in rows):
                progress("drawing the overview")
                options = {"title": self.document.stem, "view": self.view, "temperatures": self.temperatures}
                drawn.append(f"overview: {overview(touch, sim, readings, everything, **options)}")
        print("\n".join(drawn or ["nothing is drawn: no reading is of taxels, of the bodies that carry them, or of cells"]))


@dataclass(frozen=True)
class Listen:
    """Step a document's scene as `tgdsl run` does, and write the sound of its sensors: WAV files and a spectrogram."""

    document: args.DocumentOrArtefact
    sensors: args.Names = ()
    """Sensors to listen to; default: all sound kinds. A file has the sum over a sensor's rows."""
    keyframes: Annotated[tuple[str, ...] | None, args.optional("NAME [NAME ...]")] = None
    """Keyframes of the scene; default: as for `tgdsl run`."""
    seconds: Seconds = 1.0
    controls: args.OptionalFile = None
    """An .npz file with recorded controls, an array `ctrl` (step, actuator); default: keyframes."""
    out: args.OutFolder = Path("out")
    """Folder for one SENSOR.wav per sensor, and spectrogram.png."""
    compiled: args.Compiled = False
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.view.sound import check_soundfile, draw, write_wav

        check_soundfile()
        picture = check_writable(self.out / "spectrogram.png")
        with StatusLine() as progress:
            touch = args.module_of(self.document, self.set, progress)
            sensors = self._audio_sensors(touch)
            files = {sensor.name: check_writable(self.out / f"{sensor.name}.wav") for sensor in sensors}
            if self.compiled:
                touch.compile()
        sounds = self._sounds(touch, sensors)
        for sound in sounds:
            gain = write_wav(sound, files[sound.name])
            level = "silent" if not sound.samples.any() else f"full scale is {1 / gain:.3g} {sound.unit}"
            print(f"{sound.name}: {files[sound.name]}, {round(sound.rate)} Hz, {level}")
        print(f"spectrogram: {draw(sounds, picture, self.document.stem)}")

    def _audio_sensors(self, touch: TactileModule) -> list[PlannedSensor]:
        """Return the sensors to listen to."""
        from tgdsl.view.sound import sounding

        able = {sensor.name: sensor for sensor in sounding(touch.plan)}
        if not able:
            kinds = "contact_audio (`outputs: samples`), actuation_audio and microphone do"
            raise TgdslError(f"{self.document}: none of its sensors makes or hears sound; {kinds}")
        for name in self.sensors:
            if name not in able:
                raise TgdslError(f"--sensors {name}: it makes no sound; {did_you_mean(name, able, 'sensors that do')}")
        return [able[name] for name in self.sensors] or list(able.values())

    def _sounds(self, touch: TactileModule, chosen: list[PlannedSensor]) -> list[Sound]:
        """Make all steps, and return the sound."""
        import numpy as np

        from tgdsl.runtime.rollout import rollout
        from tgdsl.view.sound import Sound

        with StatusLine() as progress:
            sim, controls = Run(self.document, self.keyframes, self.seconds, self.controls).start(touch, progress)
        blocks: dict[str, list[np.ndarray]] = {sensor.name: [] for sensor in chosen}
        with args.progress_bar("listening", len(controls)) as bar:
            for step in rollout(touch, sim, controls):
                for name, result in blocks.items():
                    result.append(step.readings[name][0, :, :, 0].double().sum(dim=1).numpy())
                bar.update()
        units = {sensor.name: sensor.readings[0].units[0] for sensor in chosen}
        rates = {name: len(result[0]) / sim.control_step for name, result in blocks.items()}
        return [Sound(name, units[name], rates[name], np.concatenate(result)) for name, result in blocks.items()]


@dataclass(frozen=True)
class Export:
    """Export the sensors and observations of a document or an artefact as a program that runs without tgdsl."""

    document: args.DocumentOrArtefact
    to: Annotated[Literal["pt2", "aoti", "onnx"] | None, args.optional("pt2|aoti|onnx")] = None
    """Format: pt2 (torch.export, for Python with torch), aoti (AOTInductor, for C++ and Python with torch), or onnx (ONNX
    Runtime). Default: by the ending of --out, or pt2."""
    out: args.OptionalOut = None
    """The file; default: the document's name with .pt2, .aoti.pt2 or .onnx, in the working folder."""
    dt: args.OptionalFloat = None
    """Time between two calls [s]; default: the document's time step."""
    state_dtype: Literal["float32", "float64"] = "float32"
    """Dtype of floating-point inputs."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.module.export.program import ENDINGS, format_of

        out = check_writable(self.out or args.in_working_folder(self.document, ENDINGS[self.to or "pt2"]))
        to = format_of(out, self.to)
        with StatusLine() as progress:
            touch = args.module_of(self.document, self.set, progress)
            progress(f"exporting to {to}")
            source = {"source": str(self.document.absolute()), "overrides": self.set}
            signature = touch.export(with_folder(out), to, dt=self.dt, state_dtype=self.state_dtype, **source)
        for way, ports in (("in", signature.inputs), ("out", signature.outputs)):
            for i, port in enumerate(ports):
                print(f"{way:<4}{i:>3}  {port.name:<34}{port.dtype:<9}(env{''.join(f', {n}' for n in port.shape)})")
        print(f"{out}: {out.stat().st_size} bytes; compare it with the module by `tgdsl verify {out}`")


@dataclass(frozen=True)
class Verify:
    """Compare an exported file with the module on random states; the file runs in a process without tgdsl.

    The exit code is 1 if they differ.
    """

    file: tyro.conf.Positional[args.File]
    """The file that `tgdsl export` wrote."""
    of: args.OptionalFile = None
    """The document or artefact; default: the path from which the file was exported."""
    calls: int = 100
    """Calls in a row for each batch size; state carries over from call to call."""

    def run(self) -> None:
        from tgdsl.module.export.program import read_signature
        from tgdsl.module.export.verify import TOLERANCE, verify

        signature = read_signature(self.file)
        if self.of is None and not signature.source:
            raise ArtifactError(f"{self.file}: does not say what it was exported from; name it with --of")
        with StatusLine() as progress:
            touch = args.module_of(self.of or Path(signature.source), () if self.of else signature.overrides, progress)
            verdict = verify(self.file, touch, self.calls, progress)
        for num_envs, differences in verdict.differences.items():
            print(f"{num_envs} environments, {self.calls} calls")
            for name, value in differences.items():
                print(f"  {name:<40}{value:.1e}")
        print(f"largest difference {verdict.worst:.1e} of full scale (at most {TOLERANCE:g})")
        print(f"inputs of a wrong dtype are {'refused' if verdict.refuses_other_dtypes else 'NOT refused'}")
        if not verdict.is_equal:
            sys.exit(1)


@dataclass(frozen=True)
class Cache:
    """Show folder, number and size of cached distance fields, moments and modes, or remove them."""

    clear: bool = False
    """Remove all entries; the compiler computes them again when needed."""

    def run(self) -> None:
        from tgdsl.files import cache

        entries = cache.evict(-1) if self.clear else cache.entries()
        size = f"{len(entries)} {'entry' if len(entries) == 1 else 'entries'}, {sum(entry.size for entry in entries)} bytes"
        print(f"{cache.folder()}: {f'removed {size}' if self.clear else f'{size}, of at most {cache.max_bytes()} bytes'}")
