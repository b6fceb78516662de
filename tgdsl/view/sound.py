"""Sound that a run has made: as files to hear, and as a spectrogram to see.

Shapes: `sample` samples of a run, one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import signal

from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.sensors.upstream import SAMPLES
from tgdsl.view.style import new_figure, save_figure

PEAK = 0.7  # largest sample of a file that is normalised, of full scale
RANGE = 80.0  # levels that a spectrogram tells apart [dB]


@dataclass(frozen=True, eq=False)
class Sound:
    """The samples of a sensor over a run."""

    name: str  # the sensor's name
    unit: str  # unit of the samples
    rate: float  # samples per second [Hz]
    samples: Float[np.ndarray, " sample"]  # the sum over its rows


def sounding(plan: Plan) -> tuple[PlannedSensor, ...]:
    """Return the sensors of a plan that make or hear sound, in the document's order."""
    makers = {sensor.name for sensor in plan.sensors if SAMPLES in sensor.provides}
    return tuple(sensor for sensor in plan.sensors if sensor.name in makers or set(sensor.upstream) & makers)


def write_wav(sound: Sound, path: Path) -> float:
    """Write a sound as 16-bit WAV, its largest sample at `PEAK` of full scale; return the gain, which is 1 of silence."""
    soundfile = check_soundfile()
    largest = float(np.abs(sound.samples).max(initial=0.0))
    gain = PEAK / largest if largest > 0 else 1.0
    with atomic_open(with_folder(path)) as file:
        soundfile.write(file, gain * sound.samples, round(sound.rate), format="WAV", subtype="PCM_16")
    return gain


def check_soundfile() -> Any:
    """Return soundfile; raise an error if it is not installed."""
    try:
        import soundfile
    except ImportError as error:
        raise TgdslError('WAV files want soundfile: pip install "tgdsl[sound]"') from error
    return soundfile


class Spectrogram(NamedTuple):
    """How strong each frequency is at each time."""

    time: Float[np.ndarray, " time"]  # middles of the windows [s]
    frequency: Float[np.ndarray, " frequency"]  # [Hz]
    level: Float[np.ndarray, "frequency time"]  # power over the loudest one's of the sound [dB]; −inf where there is none


def spectrogram(sound: Sound, window: float = 0.02) -> Spectrogram:
    """Return the spectrogram of a sound, by Hann windows [s], at most the sound's length, that overlap by three quarters."""
    num = int(np.clip(round(window * sound.rate), 1, max(len(sound.samples), 1)))
    hop = max(num // 4, 1)
    frequency, time, power = signal.spectrogram(sound.samples, sound.rate, "hann", num, num - hop, detrend=False)  # type: ignore[arg-type]
    largest = power.max(initial=0.0)
    with np.errstate(divide="ignore"):
        level = 10 * np.log10(power / largest) if largest > 0 else np.full(power.shape, -np.inf)
    return Spectrogram(time, frequency, level)


def draw(sounds: Sequence[Sound], path: Path, title: str = "", marks: Mapping[str, Sequence[float]] | None = None) -> Path:
    """Draw the spectrograms of some sounds, one above the other; `marks` are frequencies beside each, by its name [Hz]."""
    figure = new_figure(8.0, 0.6 + 1.9 * len(sounds), dpi=150, layout="constrained")
    axes = figure.subplots(len(sounds), 1, sharex=True, squeeze=False)[:, 0]
    for axis, sound in zip(axes, sounds, strict=True):
        time, frequencies, level = spectrogram(sound)
        style = {"vmin": -RANGE, "vmax": 0.0, "cmap": "magma", "shading": "nearest"}
        image = axis.pcolormesh(time, frequencies / 1e3, np.maximum(level, -RANGE), **style)
        for frequency in (marks or {}).get(sound.name, ()):
            axis.plot([0.0], [frequency / 1e3], ">", color="tab:green", clip_on=False, markersize=4)
        axis.set_xlim(0.0, len(sound.samples) / sound.rate)
        axis.set_ylabel(f"{sound.name}\n[kHz]")
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title)
    figure.colorbar(image, ax=list(axes), label="power, of the loudest [dB]")
    return save_figure(figure, path)
