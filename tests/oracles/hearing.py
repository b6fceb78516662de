"""What a microphone hears of sources at rest and in motion, against closed forms."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.listening import PITCH, RATE, SPEED, away, frequency_of, heard, listening
from oracles.setups.scenes import folder

KINDS = ("microphone",)


def level(falloff: float = 1.0) -> Comparison:
    """Return how loud a tone is from 25 cm to 8 m."""
    distances = np.array([0.25, 0.5, 1.0, 2.7, 8.0])
    with folder() as where:
        samples = heard(listening(where, {"falloff": falloff}), 50, source=away(distances))[:, -400:]
    return Comparison(
        f"Sound falls off by the distance, p = {falloff:g}",
        "the paper's law; of p = 1 a point source, Pierce 4.1",
        "l/r^p",
        KINDS,
        "amplitude, over 60 periods",
        "Pa",
        along("distance", "m", distances, is_log=True),
        distances**-falloff,
        np.sqrt(2 * np.mean(samples**2, axis=1)),
        rtol=1e-3,
    )


def nearest(least: float = 0.4) -> Comparison:
    """Return how loud a tone is from nearer than where it gets no louder."""
    with folder() as where:
        samples = heard(listening(where, {"nearest": least}), 40, source=(0.25, 0, 0))[-400:]
    return Comparison(
        "Nearer than `nearest` it gets no louder",
        "by definition",
        "l/max(r, r_min)",
        KINDS,
        "amplitude",
        "Pa",
        cases(["from 25 cm"]),
        array(1 / least),
        array(np.sqrt(2 * np.mean(samples**2))),
        rtol=1e-3,
    )


def delay(frequency: float) -> Comparison:
    """Return how late a tone is by its phase, at distances of no whole number of samples: to 1/20 of a sample."""
    distances = np.array([0.31, 0.5, 1.3333, 4.021])
    with folder() as where:
        samples = heard(listening(where, tone={"frequency": frequency}), 60, source=away(distances))
    # The first call of an episode is at its start; the tone is 0 up to then.
    late = ((np.arange(samples.shape[1]) + 1) / RATE - 1 / 1000)[-800:]
    basis = np.stack([np.sin(2 * np.pi * frequency * late), np.cos(2 * np.pi * frequency * late)], axis=1)
    same, ahead = np.linalg.lstsq(basis, samples[:, -800:].T, rcond=None)[0]
    exact = distances / SPEED
    off = np.angle(np.exp(1j * (np.arctan2(-ahead, same) - 2 * np.pi * frequency * exact))) / (2 * np.pi * frequency)
    return Comparison(
        f"A tone of {frequency:g} Hz is as late as its way is long",
        "speed of sound",
        "t = r/c",
        KINDS,
        "delay, by phase",
        "s",
        along("distance", "m", distances),
        exact,
        exact + off,
        atol=1 / 20 / RATE,
    )


def pulse() -> Comparison:
    """Return when a pulse arrives, by its group delay up to 0.3 of the band: to 1/20 of a sample, and not heard long before."""
    distances, ours = np.array([0.25, 0.777, 3.2]), []
    with folder() as where:
        found, made = heard(listening(where, tone={"pulse": 7}), 40, source=away(distances), names=("mic", "tone"))
    emitted = int(np.flatnonzero(made[0, :, 0])[0])
    for samples, distance in zip(found[..., 0], distances, strict=True):
        spectrum = np.fft.rfft(np.roll(samples, -emitted))
        omega, low = 2 * np.pi * np.arange(len(spectrum)) / len(samples), slice(1, int(0.3 * len(samples)))
        is_silent = not samples[: emitted + int(distance / SPEED * RATE) - 12].any()
        late = -np.polyfit(omega[low], np.unwrap(np.angle(spectrum[low])), 1)[0] / RATE
        ours.append(late if is_silent else np.nan)
    return Comparison(
        "A pulse arrives when sound does",
        "speed of sound",
        "t = r/c",
        KINDS,
        "delay, of the group",
        "s",
        along("distance", "m", distances),
        distances / SPEED,
        array(ours),
        atol=1 / 20 / RATE,
    )


def doppler(speeds: Sequence[float] = (-30.0, -10.0, 10.0, 30.0)) -> Comparison:
    """Return by how much a tone is shifted whose source moves away, and that of a microphone that does."""
    speed = np.array(speeds)
    both = np.concatenate([np.outer(speed, [1, 0]), np.outer(speed, [0, -1])])
    begun = away(np.tile(np.where(speed > 0, 1.0, 9.0), 2))
    with folder() as where:
        samples = heard(listening(where, {"reach": 15.0}), 160, source=begun, speeds=both)[:, -2400:]
    return Comparison(
        "Doppler's shift, of a source and of a microphone that move away",
        "Pierce 11.5; the paper says nothing of motion",
        "f′ − f = f/(1 + v/c) − f; −f v/c",
        KINDS,
        "shift of 3 kHz",
        "Hz",
        along("speed", "m/s", speed),
        np.array([PITCH / (1 + speed / SPEED), PITCH * (1 - speed / SPEED)]) - PITCH,
        np.array([frequency_of(own) for own in samples]).reshape(2, -1) - PITCH,
        rtol=0.01,
        series=("the source moves", "the microphone moves"),
    )


def doppler_of_both() -> Comparison:
    """Return the frequency of a tone whose source moves away with 20 m/s from a microphone that does with 15 m/s."""
    with folder() as where:
        samples = heard(listening(where), 160, source=(1.0, 0, 0), speeds=(20.0, -15.0))[-2400:]
    return Comparison(
        "Doppler's shift where both move",
        "Pierce 11.5",
        "f′ = f (1 − v_m/c)/(1 + v_s/c)",
        KINDS,
        "frequency",
        "Hz",
        cases(["20 and 15 m/s"]),
        array(PITCH * (1 - 15 / SPEED) / (1 + 20 / SPEED)),
        array(frequency_of(samples)),
        atol=0.5,
    )


def two_sensors() -> Comparison:
    """Return what is heard of two sensors, one of two rows, with levels: the sum of what is heard of each."""
    place: dict[str, Any] = {"kind": "microphone", "pos": [0.5, 1, 0]}
    alone: dict[str, Any] = {"m1": {**place, "hears": ["tone"]}, "m2": {**place, "hears": ["other"]}}
    other = {"kind": "tone", "links": ["a", "b"], "samples": 20, "frequency": 900.0}
    with folder() as where:
        touch = listening(where, {**place, "body": None, "levels": {"other": 0.5}}, other=other, **alone)
        every, one, two = heard(touch, 30, source=(1.0, 0, 0), names=("mic", "m1", "m2"))
    is_loud = min(np.abs(one).max(), np.abs(two).max()) > 0.1
    return Comparison(
        "Sounds of two sensors add up",
        "linear acoustics",
        "p = Σ l p_i",
        KINDS,
        "pressure",
        "Pa",
        along("time", "s", (np.arange(len(every)) + 1) / RATE - 1 / 1000),
        (one + 0.5 * two)[:, 0],
        every[:, 0] if is_loud else np.full(len(every), np.nan),
        atol=1e-12,
    )


ORACLES: tuple[Oracle, ...] = (
    *(partial(level, falloff) for falloff in (1.0, 2.0)),
    nearest,
    *(partial(delay, frequency) for frequency in (400.0, 7000.0)),
    pulse,
    doppler,
    doppler_of_both,
    two_sensors,
)
