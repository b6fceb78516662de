"""Draw the pictures of docs/background/sound.md: errors of a microphone's interpolation, Doppler shifts, and spectrograms.

python benchmarks/sound_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import tgdsl
from tgdsl.runtime.rollout import rollout, script_of
from tgdsl.sensors.microphone import TAPS, age_of_sound, coefficients
from tgdsl.view.sound import Sound, draw, sounding

EXAMPLE = Path(__file__).parents[1] / "examples" / "materials_audio.yaml"
SPEED, TONE, STEP, SAMPLES = 343.0, 3000.0, 1e-3, 20


def interpolation_errors(frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest errors of level [1] and delay [samples] over all fractions, by frequency / sample rate."""
    fraction, taps = np.linspace(0, 1, 101), np.arange(TAPS) - (TAPS // 2 - 1)
    powers = (fraction[:, None] - 0.5) ** np.arange(len(coefficients()))
    omega = 2 * np.pi * frequency
    response = np.exp(1j * np.outer(omega, taps)) @ (powers @ coefficients()).T / np.exp(1j * np.outer(omega, fraction))
    return np.abs(np.abs(response) - 1).max(axis=1), np.abs(np.angle(response) / omega[:, None]).max(axis=1)


def shifted_frequency(speed: float, is_source: bool) -> float:
    """Return the frequency at the microphone of a tone whose source, or else the microphone, moves away [Hz]."""
    ages = []
    for now in (0, 1):
        node = torch.arange(40, dtype=torch.float64)
        source = speed * STEP * (now - node) if is_source else torch.zeros(40, dtype=torch.float64)
        listener = -3.0 - (0.0 if is_source else speed * STEP * now)
        distance = (listener - source)[None, :, None]
        age = age_of_sound((distance, 0 * distance, 0 * distance), torch.tensor(SPEED * STEP, dtype=torch.float64))
        ages.append(float(age))
    return TONE * (1 - (ages[1] - ages[0]))


def draw_microphone(path: Path) -> None:
    """Draw errors over frequency, and shifts over speed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    frequency = np.linspace(0.005, 0.495, 300)
    level, delay = interpolation_errors(frequency)
    left.semilogy(frequency, level, label="level [1]")
    left.semilogy(frequency, delay, label="delay [samples]")
    left.axvline(0.4, color="grey", lw=0.8, ls=":")
    left.set(xlabel="frequency [of the sample rate]", ylabel="largest error", ylim=(1e-6, 2))
    left.legend()
    speeds = np.linspace(-40, 40, 17)
    for is_source, name, shift in (
        (True, "source moves", TONE / (1 + speeds / SPEED)),
        (False, "microphone moves", TONE * (1 - speeds / SPEED)),
    ):
        (line,) = right.plot(speeds, shift - TONE, lw=1)
        measured = [shifted_frequency(float(speed), is_source) - TONE for speed in speeds]
        right.plot(speeds, measured, "o", ms=3, color=line.get_color(), label=name)
    right.set(xlabel="speed away [m/s]", ylabel="f′ − f [Hz]")
    right.legend()
    figure.savefig(path)


def draw_materials(path: Path) -> None:
    """Draw the spectrograms of the example, and mark the modes of its boxes."""
    touch = tgdsl.compile(EXAMPLE)
    sim, controls = script_of(touch).begin(touch, 1, 1, 0.9)
    sensors = sounding(touch.plan)
    blocks: dict[str, list[np.ndarray]] = {sensor.name: [] for sensor in sensors}
    for step in rollout(touch, sim, controls):
        for name, signal in blocks.items():
            signal.append(step.readings[name][0, :, :, 0].sum(dim=1).numpy())
    rate = len(blocks["ear"][0]) / sim.control_step
    sounds = [Sound(sensor.name, sensor.readings[0].units[0], rate, np.concatenate(blocks[sensor.name])) for sensor in sensors]
    draw(
        sounds,
        path,
        marks={sensor.name: sensor.constants["frequency"][0].tolist() for sensor in sensors if not sensor.upstream},
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    draw_microphone(out / "microphone.png")
    draw_materials(out / "materials_audio.png")


if __name__ == "__main__":
    main()
