"""`tgdsl run`: a document's scene, stepped and shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import DocumentOrArtefact, OptionalFile, Overrides, module_of
from tgdsl.console.progress import StatusLine

if TYPE_CHECKING:
    from torch import Tensor

    from tgdsl.module.module import TactileModule
    from tgdsl.runtime.batch.simulation import BatchSimulation
    from tgdsl.runtime.rollout import Controls, Recorder

_FILES = {"readings": "npz", "picture": "png", "overview": "png"}


@dataclass(frozen=True)
class Run:
    """Step a document's scene on the CPU, show the readings, and write them and a picture."""

    document: DocumentOrArtefact
    keyframes: tuple[str, ...] | None = None
    """Keyframes of the scene whose controls are held and moved between, in turn; the first is the start. Default: rest and
    squeeze if the scene has them; else the hand closes on the first object that fits between its fingers."""
    seconds: float = 1.0
    """Duration of each hold and of each move between keyframes [s]."""
    controls: OptionalFile = None
    """Recorded controls instead: an .npz file with an array `ctrl` (step, actuator) or (step, env, actuator)."""
    num_envs: int = 1
    """Environments; the table and the picture show the first."""
    substeps: int | None = None
    """Physics steps per control step; default: as many as sensors that read blocks want, else 5."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("out")
    """Folder for readings.npz, picture.png and, where there are several readings, overview.png."""
    compiled: bool = False
    """Fuse the module with torch.compile first."""
    view: str | None = None
    """Viewpoint of the pictures: front (what the taxels face), back, left, right, top (from beyond the fingertips),
    bottom, iso, or AZIMUTH,ELEVATION in degrees, front being about 0,0; default: the one that shows most of the touch."""
    temperatures: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Ends of the colours of temperatures [°C]; default: the lowest and the highest that are read."""
    set: Overrides = ()

    def run(self) -> None:
        """Step through the controls, show the table, write the files."""
        from tgdsl.errors import listed
        from tgdsl.files.write import check_writable, with_folder
        from tgdsl.runtime.rollout import Recorder, missed_loads, silent_readings, touching_bodies
        from tgdsl.view.cameras import ViewError, angles_of

        if self.temperatures is not None and not self.temperatures[0] < self.temperatures[1]:
            low, high = self.temperatures
            raise ViewError(f"--temperatures {low:g} {high:g}: expected the lower one first")
        if self.view is not None:
            angles_of(self.view)
        files = {name: check_writable(self.out / f"{name}.{ending}") for name, ending in _FILES.items()}
        with StatusLine() as progress:
            touch = module_of(self.document, self.set, progress)
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
        print("".join(f"at the end {problem}: see {name}\n" for name, problem in missed_loads(touch, readings).items()), end="")
        recorder.write(with_folder(files["readings"]), controls, self.document)
        print(f"readings: {files['readings']}")
        self._draw(touch, sim, readings, files)

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
        from tqdm import tqdm

        from tgdsl.console.progress import LiveTable
        from tgdsl.runtime.rollout import rollout
        from tgdsl.view.table import table

        live, readings = LiveTable(), {}
        task = "compiling kernels" if self.compiled else "stepping"
        with tqdm(total=len(controls), desc=task, unit="step", disable=None, leave=False) as bar:
            for step in rollout(touch, sim, controls):
                recorder.add(step)
                readings = step.readings
                bar.set_description("stepping", refresh=False)
                bar.update()
                with bar.external_write_mode():
                    live.show([f"t = {step.time:.2f} s", *table(touch, readings)], is_last=step.index == len(controls) - 1)
        return readings

    def _draw(self, touch: TactileModule, sim: BatchSimulation, readings: dict[str, Tensor], files: dict[str, Path]) -> None:
        from tgdsl.view.overview import drawn_outputs, overview
        from tgdsl.view.picture import picture

        drawn = []
        with StatusLine() as progress:
            rows = [output.rows for output in drawn_outputs(touch)]
            if "taxel" in rows:
                progress("drawing the picture")
                drawn.append(f"picture:  {picture(touch, sim, readings, files['picture'], view=self.view)}")
            if len(rows) > 1 or (rows and "taxel" not in rows):
                progress("drawing the overview")
                options = {"title": self.document.stem, "view": self.view, "temperatures": self.temperatures}
                path = overview(touch, sim, readings, files["overview"], **options)
                drawn.append(f"overview: {path}")
        print("\n".join(drawn or ["nothing is drawn: no reading is of taxels, of the bodies that carry them, or of cells"]))
