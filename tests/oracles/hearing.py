"""Sound of resting and moving sources at a microphone, against closed forms."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from oracles.comparison import Values, field
from oracles.setups.listening import PITCH, RATE, SPEED, away, frequency_of, heard, listening
from oracles.setups.scenes import temporary

oracle = field("sound: microphone", "microphone")


@oracle(
    "Sound falls off by the distance, p = {falloff:g}", "l/r^p", "the paper's law; of p = 1 a point source, Pierce 4.1",
    "amplitude, over 60 periods [Pa]", "distance [m]", is_log=True, rtol=1e-3, each=[1.0, 2.0], also=[0.5],
)  # fmt: skip
def level(falloff: float):
    distances = np.array([0.25, 0.5, 1.0, 2.7, 8.0])
    samples = heard(temporary(listening, {"falloff": falloff}), 50, source=away(distances))[:, -400:]
    return Values(distances**-falloff, np.sqrt(2 * np.mean(samples**2, axis=1)), at=distances)


@oracle(
    "Nearer than `nearest` it gets no louder", "l/max(r, r_min)", "by definition", "amplitude [Pa]", at=["from 25 cm"],
    rtol=1e-3,
)  # fmt: skip
def nearest(least: float = 0.4):
    samples = heard(temporary(listening, {"nearest": least}), 40, source=(0.25, 0, 0))[-400:]
    return 1 / least, np.sqrt(2 * np.mean(samples**2))


@oracle(
    "A tone of {frequency:g} Hz is as late as its way is long", "t = r/c", "speed of sound", "delay, by phase [s]",
    "distance [m]", atol=1 / 20 / RATE, each=[400.0, 7000.0], also=[3000.0],
)  # fmt: skip
def delay(frequency: float):
    distances = np.array([0.31, 0.5, 1.3333, 4.021])
    samples = heard(temporary(listening, tone={"frequency": frequency}), 60, source=away(distances))
    # The first call of an episode is at its start; the tone is 0 up to then.
    late = ((np.arange(samples.shape[1]) + 1) / RATE - 1 / 1000)[-800:]
    basis = np.stack([np.sin(2 * np.pi * frequency * late), np.cos(2 * np.pi * frequency * late)], axis=1)
    same, ahead = np.linalg.lstsq(basis, samples[:, -800:].T, rcond=None)[0]
    exact = distances / SPEED
    off = np.angle(np.exp(1j * (np.arctan2(-ahead, same) - 2 * np.pi * frequency * exact))) / (2 * np.pi * frequency)
    return Values(exact, exact + off, at=distances)


@oracle(
    "A pulse arrives when sound does", "t = r/c", "speed of sound", "delay, of the group [s]", "distance [m]",
    atol=1 / 20 / RATE,
)  # fmt: skip
def pulse():
    distances, ours = np.array([0.25, 0.777, 3.2]), []
    touch = temporary(listening, tone={"pulse": 7})
    arrived, source = heard(touch, 40, source=away(distances), names=("mic", "tone"))
    emitted = int(np.flatnonzero(source[0, :, 0])[0])
    for samples, distance in zip(arrived[..., 0], distances, strict=True):
        spectrum = np.fft.rfft(np.roll(samples, -emitted))
        omega, low = 2 * np.pi * np.arange(len(spectrum)) / len(samples), slice(1, int(0.3 * len(samples)))
        is_silent = not samples[: emitted + int(distance / SPEED * RATE) - 12].any()
        late = -np.polyfit(omega[low], np.unwrap(np.angle(spectrum[low])), 1)[0] / RATE
        ours.append(late if is_silent else np.nan)
    return Values(distances / SPEED, ours, at=distances)


@oracle(
    "Doppler's shift, of a source and of a microphone that move away", "f′ − f = f/(1 + v/c) − f; −f v/c",
    "Pierce 11.5; the paper says nothing of motion", "shift of 3 kHz [Hz]", "speed [m/s]", rtol=0.01,
    series=("the source moves", "the microphone moves"),
)  # fmt: skip
def doppler(speeds: Sequence[float] = (-30.0, -10.0, 10.0, 30.0)):
    speed = np.array(speeds)
    both = np.concatenate([np.outer(speed, [1, 0]), np.outer(speed, [0, -1])])
    start = away(np.tile(np.where(speed > 0, 1.0, 9.0), 2))
    samples = heard(temporary(listening, {"reach": 15.0}), 160, source=start, speeds=both)[:, -2400:]
    exact = np.array([PITCH / (1 + speed / SPEED), PITCH * (1 - speed / SPEED)]) - PITCH
    return Values(exact, np.array([frequency_of(tone) for tone in samples]).reshape(2, -1) - PITCH, at=speed)


@oracle(
    "Doppler's shift where both move", "f′ = f (1 − v_m/c)/(1 + v_s/c)", "Pierce 11.5", "frequency [Hz]", at=["20 and 15 m/s"],
    atol=0.5,
)  # fmt: skip
def doppler_of_both():
    samples = heard(temporary(listening), 160, source=(1.0, 0, 0), speeds=(20.0, -15.0))[-2400:]
    return PITCH * (1 - 15 / SPEED) / (1 + 20 / SPEED), frequency_of(samples)


@oracle("Sounds of two sensors add up", "p = Σ l p_i", "linear acoustics", "pressure [Pa]", "time [s]", atol=1e-12)
def two_sensors():
    place: dict[str, Any] = {"kind": "microphone", "pos": [0.5, 1, 0]}
    alone: dict[str, Any] = {"m1": {**place, "hears": ["tone"]}, "m2": {**place, "hears": ["other"]}}
    other = {"kind": "tone", "links": ["a", "b"], "samples": 20, "frequency": 900.0}
    touch = temporary(listening, {**place, "body": None, "levels": {"other": 0.5}}, other=other, **alone)
    both, one, two = heard(touch, 30, source=(1.0, 0, 0), names=("mic", "m1", "m2"))
    is_loud = min(np.abs(one).max(), np.abs(two).max()) > 0.1
    time = (np.arange(len(both)) + 1) / RATE - 1 / 1000
    return Values((one + 0.5 * two)[:, 0], both[:, 0] if is_loud else np.nan, at=time)
