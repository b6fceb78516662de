"""`tgdsl listen`: the sound of a document's scene, as files to hear and a spectrogram to see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import DocumentOrArtefact, OptionalFile, Overrides, module_of
from tgdsl.commands.run import Run
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError, did_you_mean

if TYPE_CHECKING:
    from tgdsl.module.module import TactileModule
    from tgdsl.plan.sensors import PlannedSensor
    from tgdsl.view.sound import Sound


@dataclass(frozen=True)
class Listen:
    """Step a document's scene as `run` does, and write what its sensors make or hear of sound: WAV files and a spectrogram."""

    document: DocumentOrArtefact
    sensors: tuple[str, ...] = ()
    """Sensors to listen to; default: all that make or hear sound. Of several rows the sum is heard."""
    keyframes: tuple[str, ...] | None = None
    """Keyframes of the scene whose controls are held and moved between, in turn, as of `run`."""
    seconds: float = 1.0
    """Duration of each hold and of each move between keyframes [s]."""
    controls: OptionalFile = None
    """Recorded controls instead: an .npz file with an array `ctrl` (step, actuator)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("out")
    """Folder for a `<sensor>.wav` each, and spectrogram.png."""
    compiled: bool = False
    """Fuse the module with torch.compile first."""
    set: Overrides = ()

    def run(self) -> None:
        """Step through the controls, write the files, say by what each was multiplied."""
        from tgdsl.files.write import check_writable
        from tgdsl.view.sound import check_soundfile, draw, write_wav

        check_soundfile()
        picture = check_writable(self.out / "spectrogram.png")
        with StatusLine() as progress:
            touch = module_of(self.document, self.set, progress)
            chosen = self._chosen(touch)
            files = {sensor.name: check_writable(self.out / f"{sensor.name}.wav") for sensor in chosen}
            if self.compiled:
                touch.compile()
        sounds = self._sounds(touch, chosen)
        for sound in sounds:
            gain = write_wav(sound, files[sound.name])
            said = "silent" if not sound.samples.any() else f"full scale is {1 / gain:.3g} {sound.unit}"
            print(f"{sound.name}: {files[sound.name]}, {round(sound.rate)} Hz, {said}")
        print(f"spectrogram: {draw(sounds, picture, self.document.stem)}")

    def _chosen(self, touch: TactileModule) -> list[PlannedSensor]:
        """Return the sensors to listen to.

        Raises:
            TgdslError: If the document has none, or lacks a named one.
        """
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
        from tqdm import tqdm

        from tgdsl.runtime.rollout import rollout
        from tgdsl.view.sound import Sound

        run = Run(self.document, self.keyframes, self.seconds, self.controls)
        with StatusLine() as progress:
            sim, controls = run.start(touch, progress)
        blocks: dict[str, list[np.ndarray]] = {sensor.name: [] for sensor in chosen}
        with tqdm(total=len(controls), desc="listening", unit="step", disable=None, leave=False) as bar:
            for step in rollout(touch, sim, controls):
                for name, result in blocks.items():
                    result.append(step.readings[name][0, :, :, 0].double().sum(dim=1).numpy())
                bar.update()
        units = {sensor.name: sensor.readings[0].units[0] for sensor in chosen}
        rates = {name: len(result[0]) / sim.control_step for name, result in blocks.items()}
        return [Sound(name, units[name], rates[name], np.concatenate(result)) for name, result in blocks.items()]
