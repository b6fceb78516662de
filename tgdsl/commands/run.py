"""Commands that draw: `tgdsl run` and `tgdsl render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import Document, Overrides, module_of, parsed_overrides, robot_document
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    import mujoco
    from torch import Tensor

    from tgdsl.layout.layout import Layout
    from tgdsl.module.module import TactileModule
    from tgdsl.runtime.rollout import Controls, Recorder
    from tgdsl.runtime.source import Simulator

_FILES = {"readings": "npz", "picture": "png", "overview": "png"}


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
    view: str | None = None
    """From where the pictures are seen: front (what the taxels face), back, left, right, top (from beyond the fingertips),
    bottom, iso, or AZIMUTH,ELEVATION in degrees, front being about 0,0; default: the one that shows most of what is touched."""
    set: Overrides = ()
    """Override a value of the document, as in `--set resolution=high`; may be repeated."""

    def run(self) -> None:
        """Step through the controls, show the table, write the files."""
        from tgdsl.files.files import with_folder, writable
        from tgdsl.runtime.rollout import Recorder
        from tgdsl.view.cameras import angles_of

        if self.view is not None:
            angles_of(self.view)
        files = {name: writable(self.out / f"{name}.{ending}") for name, ending in _FILES.items()}
        with StatusLine() as progress:
            touch = module_of(self.document, self.set, progress)
            if self.compiled:
                touch.compile()
            progress(f"starting {self.num_envs} environments" if self.num_envs > 1 else "starting the simulation")
            sim, controls = self._start(touch)
            recorder = Recorder(touch, len(controls), self.num_envs)
        readings = self._steps(touch, sim, controls, recorder)
        recorder.write(with_folder(files["readings"]), controls)
        print(f"readings: {files['readings']}")
        self._draw(touch, sim, readings, files)

    def _start(self, touch: TactileModule) -> tuple[Simulator, Controls]:
        """Return the scene at its start, and the controls that it is stepped through."""
        from tgdsl.runtime.rollout import default_keyframes, held_controls, recorded_controls, scripted_controls
        from tgdsl.runtime.simulate import simulate

        sim = simulate(touch, self.num_envs, substeps=self.substeps)
        keyframes = default_keyframes(sim.model) if self.keyframes is None else self.keyframes
        if self.controls is not None:
            return sim, recorded_controls(self.controls)
        if self.keyframes is None and not keyframes:
            print(f"the scene has no keyframes rest and squeeze: its initial state is held for {self.seconds:g} s")
            return sim, held_controls(sim.model, self.seconds, sim.control_step)
        controls = scripted_controls(sim.model, keyframes, self.seconds, sim.control_step)
        sim.close()
        return simulate(touch, self.num_envs, substeps=self.substeps, keyframe=keyframes[0]), controls

    def _steps(self, touch: TactileModule, sim: Simulator, controls: Controls, recorder: Recorder) -> dict[str, Tensor]:
        """Make all steps, and return the last readings."""
        from tqdm import tqdm

        from tgdsl.runtime.rollout import rollout
        from tgdsl.view.table import LiveTable, table

        live, readings = LiveTable(), {}
        what = "compiling kernels" if self.compiled else "stepping"
        with tqdm(total=len(controls), desc=what, unit="step", disable=None, leave=False) as bar:
            for step in rollout(touch, sim, controls):
                recorder.add(step)
                readings = step.readings
                bar.set_description("stepping", refresh=False)
                bar.update()
                with bar.external_write_mode():
                    live.show([f"t = {step.time:.2f} s", *table(touch, readings)], is_last=step.index == len(controls) - 1)
        return readings

    def _draw(self, touch: TactileModule, sim: Simulator, readings: dict[str, Tensor], files: dict[str, Path]) -> None:
        from tgdsl.view.overview import overview
        from tgdsl.view.view import picture

        drawn = []
        with StatusLine() as progress:
            rows = [output.rows for output in touch.outputs if output.rows in ("taxel", "body")]
            if "taxel" in rows:
                progress("drawing the picture")
                drawn.append(f"picture:  {picture(touch, sim, readings, files['picture'], view=self.view)}")
            if len(rows) > 1 or "taxel" not in rows:
                progress("drawing the overview")
                path = overview(touch, sim, readings, files["overview"], title=self.document.stem, view=self.view)
                drawn.append(f"overview: {path}")
        print("\n".join(drawn))


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
    """From where: front (what the taxels face), back, left, right, top, bottom, iso, or AZIMUTH,ELEVATION in degrees."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Pixels of the picture; default: 750 rows, and as many columns as the hand needs."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """The picture; default: the hand's name with the ending .png, in the working folder."""
    set: Overrides = ()
    """Override a value of the document, as in `--set resolution=high`; may be repeated."""

    def run(self) -> None:
        """Draw, write and say how many taxels there are."""
        from tgdsl.view.render import render

        out = self.out or Path(Path(self.hand).with_suffix(".png").name)
        model, layouts = self._layouts()
        path = render(model, layouts, out, keyframe=self.keyframe, view=self.view, size=self.size)
        print(", ".join(f"{name}: {layout.num_taxels} taxels" for name, layout in layouts.items()))
        print(f"picture: {path}")

    def _layouts(self) -> tuple[mujoco.MjModel, dict[str, Layout]]:
        """Return the model and the layouts to draw by resolution: an artefact's own, or those that its document would have."""
        if not self.hand.endswith(".safetensors"):
            from tgdsl.compiler.pipeline import layouts

            return layouts(robot_document(self.hand, self.layout), parsed_overrides(self.set), self.resolutions)
        from tgdsl.module.artifact import load_plan
        from tgdsl.scene.scene import scene_model

        plan = load_plan(self.hand)
        resolution = plan.origin.resolution
        if self.set or self.layout or set(self.resolutions) - {resolution}:
            raise TgdslError(f'an artefact has the layout and resolution it was compiled with, "{resolution}", and no other')
        return scene_model(plan.scene), {resolution: plan.layout}
