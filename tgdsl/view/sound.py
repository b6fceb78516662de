"""Sound that a run has made: as files to hear, and as a spectrogram to see.

Shapes: `sample` samples of a run, one after the other.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from scipy import signal

from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.sensors.upstream import SAMPLES
from tgdsl.view.style import new_figure, save_figure

PEAK = 0.7  # largest sample of a file that is normalised, of full scale
_SOUND = matplotlib.colormaps["magma"]
RANGE = 80.0  # levels that a spectrogram tells apart [dB]


class Sound(NamedTuple):
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


class RollingSound:
    """The last seconds of a sensor's sound."""

    def __init__(self, name: str, unit: str, seconds: float):
        self.name, self._unit, self.seconds = name, unit, seconds
        self._blocks: deque[Float[np.ndarray, " sample"]] = deque()
        self._time, self._rate = math.nan, 0.0

    def add(self, block: Float[np.ndarray, " sample"], time: float, duration: float) -> None:
        """Add the samples of the last `duration` up to `time` [s]; begin again where they do not follow the block before."""
        if abs(time - self._time - duration) > 1e-3 * duration or self._rate != len(block) / duration:
            self._blocks.clear()
        self._blocks.append(block)
        self._time, self._rate = time, len(block) / duration
        while len(self._blocks) * duration > self.seconds * (1 + 1e-9):
            self._blocks.popleft()

    def clear(self) -> None:
        """Forget the samples."""
        self._blocks.clear()

    @property
    def sound(self) -> Sound:
        """The samples so far."""
        return Sound(self.name, self._unit, self._rate, np.concatenate(self._blocks) if self._blocks else np.zeros(0))

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "height width 3"]:
        """Return the spectrogram as pixels: time to the right, up to now, frequency upward to half of the rate."""
        sound = self.sound
        level = np.full((height, width), -RANGE)
        if len(sound.samples) > 1:
            time, frequency, values = spectrogram(sound)
            row = np.clip(np.arange(height)[::-1] * len(frequency) // height, 0, len(frequency) - 1)
            missing = self.seconds - len(sound.samples) / sound.rate
            at = self.seconds * (np.arange(width) + 0.5) / width - missing
            column = np.abs(at[:, None] - time).argmin(axis=1)
            level = np.where(at >= 0, values[row[:, None], column], -RANGE)
        return (255 * _SOUND((np.maximum(level, -RANGE) + RANGE) / RANGE)[..., :3]).astype(np.uint8)


def draw(sounds: Sequence[Sound], path: Path, title: str = "", marks: Mapping[str, Sequence[float]] | None = None) -> Path:
    """Draw spectrograms of sounds, one above the other; `marks` are frequencies to mark in each, by its name [Hz]."""
    figure = new_figure(8.0, 0.6 + 1.9 * len(sounds), dpi=150, layout="constrained")
    axes = figure.subplots(len(sounds), 1, sharex=True, squeeze=False)[:, 0]
    for axis, sound in zip(axes, sounds, strict=True):
        time, frequencies, level = spectrogram(sound)
        style = {"vmin": -RANGE, "vmax": 0.0, "cmap": _SOUND, "shading": "nearest"}
        image = axis.pcolormesh(time, frequencies / 1e3, np.maximum(level, -RANGE), **style)
        for frequency in (marks or {}).get(sound.name, ()):
            axis.plot([0.0], [frequency / 1e3], ">", color="tab:green", clip_on=False, markersize=4)
        axis.set_xlim(0.0, len(sound.samples) / sound.rate)
        axis.set_ylabel(f"{sound.name}\n[kHz]")
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title)
    figure.colorbar(image, ax=list(axes), label="power, of the loudest [dB]")
    return save_figure(figure, path)
