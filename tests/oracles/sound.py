"""Sound of contacts and of motors, against closed forms.

"The paper" is `model: paper` of contact audio on the same states: its two-pole resonators as they are printed, each struck by a
rise of the force ΔF with ΔF Δt, of which the paper gives no formula.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.drops import dropped, loudest
from oracles.setups.scenes import folder
from oracles.setups.sounds import (
    MODES,
    STEP,
    amplitudes,
    driven,
    half_sine,
    motor,
    plate,
    pressed,
    ringing,
    sound,
    struck,
)

CONTACT, MOTORS = ("contact_audio",), ("actuation_audio",)
STRIKE = [0.0, 0.0, 3.0, 0.0]
"""A collision of one step, 3 N over 1 ms, whose impulse strikes at the start of the next one [N]."""
IMPULSE = 3e-3
"""Its impulse [N·s]."""
PAPER: dict[str, Any] = {"model": "paper"}


def times(samples: int, num_steps: int) -> np.ndarray:
    """Return when samples are [s]."""
    return np.arange(1, samples * num_steps + 1) * STEP / samples


def ring_down(dtype: torch.dtype = torch.float64) -> Comparison:
    """Return what an impulse sounds like: damped sines from the impulse on, and nothing at all before."""
    is_double = dtype == torch.float64
    with folder() as where:
        found = sound(plate(where, dtype, samples=16), [*STRIKE, *[0.0] * 60])[0]
    time = times(16, 64) - 3 * STEP
    exact = ringing(IMPULSE, time)
    return Comparison(
        f"Three modes ring down after an impulse{'' if is_double else ', float32'}",
        "impulse response of damped oscillators",
        "s = J Σ g e^(−dt) sin 2πft",
        CONTACT,
        "velocity of the surface",
        "m/s",
        along("time", "s", time),
        exact,
        found if not found[: 3 * 16].any() else np.full_like(found, np.nan),
        atol=(1e-12 if is_double else 2e-6) * float(abs(exact).max()),
    )


def million_samples(dtype: torch.dtype = torch.float64, num_blocks: int = 400) -> Comparison:
    """Return two modes that ring for blocks of 2500 samples, a million of them in all, through the module."""
    modes, step = [{"frequency": 437.1, "decay": 1.0, "gain": 1.0}, {"frequency": 12345.6, "decay": 0.4, "gain": 0.5}], 0.05
    with folder() as where, torch.no_grad():
        touch = plate(where, dtype, modes=modes, samples=2500, scrape=0, timestep=step, settling=0.1)
        for force in (0.0, 2.0):
            touch(pressed(touch, [force], step=step))
        silent = pressed(touch, [0.0], step=step)
        found = torch.cat([touch(silent)["s"][0, :, 0, 0] for _ in range(num_blocks)]).double().numpy()
    time = np.arange(1, len(found) + 1) * step / 2500
    exact, is_double = ringing(0.1, time, modes), dtype == torch.float64
    return Comparison(
        f"Two modes ring for {len(found):,} samples{'' if is_double else ', float32'}",
        "impulse response of damped oscillators",
        "s = J Σ g e^(−dt) sin 2πft",
        CONTACT,
        "velocity of the surface",
        "m/s",
        along("time", "s", time),
        exact,
        found,
        atol=(1e-5 if is_double else 1e-4) * float(abs(exact).max()),
    )


def two_pole(mode: dict[str, float], samples: int = 10, num_steps: int = 21) -> Comparison:
    """Return the paper's response, which `model: paper` computes as it is printed, to a force that rises and stays."""
    with folder() as where:
        touch = plate(where, modes=[mode], samples=samples, scrape=0, **PAPER)
        found = sound(touch, [0.0, *[3.0] * num_steps])[0]
    theta, k = 2 * math.pi * mode["frequency"] * STEP / samples, np.arange(num_steps * samples)
    exact = IMPULSE * np.exp(-mode["decay"] * STEP / samples) ** k * np.sin((k + 1) * theta) / math.sin(theta)
    return Comparison(
        "The paper's two-pole response is as it is printed",
        "the paper's equation, as a sum of powers",
        "y[k] = J r^k sin((k+1)θ)/sin θ",
        CONTACT,
        "response",
        "N·s",
        along("time", "s", k * STEP / samples),
        exact,
        found[samples:] if not found[:samples].any() else np.full_like(exact, np.nan),
        atol=1e-12 * float(abs(exact).max()),
    )


def response_by_frequency(rates: tuple[int, ...] = (10, 40)) -> Comparison:
    """Return how loud a mode is over the impulse that strikes it: at all frequencies and rates the same, unlike the paper's."""
    frequency = np.array([50.0, 100.0, 200.0, 500.0, 1000.0, 1500.0, 2000.0, 2500.0, 3000.0, 3500.0, 4000.0, 4450.0])
    modes, ours, paper = [{"frequency": f, "decay": 1.0, "gain": 1.0} for f in frequency.tolist()], [], []
    with folder() as where:
        for samples in rates:
            given: dict[str, Any] = {"modes": modes, "samples": samples, "scrape": 0}
            ours.append(amplitudes(plate(where, **given), STRIKE)[3] * math.exp(STEP) / IMPULSE)
            late = STEP * (1 - 1 / samples)  # the paper's strikes at the first sample
            paper.append(amplitudes(plate(where, **given, **PAPER), STRIKE)[2] * math.exp(late) / IMPULSE)
    return Comparison(
        "A mode is as loud as the impulse, at every frequency and sample rate",
        "impulse response of a damped oscillator; the paper's resonator has 1/sin θ, θ = 2πf Δt/K",
        "|z| = J",
        CONTACT,
        "amplitude over impulse",
        "1",
        along("frequency", "Hz", frequency, is_log=True),
        np.ones((len(rates), len(frequency))),
        np.array(ours),
        rtol=1e-12,
        paper=np.array(paper),
        series=tuple(f"{samples} samples per ms" for samples in rates),
    )


def common_times(samples: int) -> Comparison:
    """Return a plate that is struck and scraped, at the times that 20 samples and another number have in common."""
    forces, common = np.abs(np.sin(np.arange(24))) * 4, math.gcd(20, samples)
    with folder() as where:
        heard = [sound(plate(where, torch.float32, samples=k, scrape=1e-3), forces, 0.3)[0] for k in (20, samples)]
    exact, ours = (own.reshape(24 * common, -1)[:, -1] for own in heard)
    return Comparison(
        f"{samples} samples per step are those of 20 at common times, struck and scraped, float32",
        "the same sound at another rate",
        "s(t) does not depend on K",
        CONTACT,
        "velocity of the surface",
        "m/s",
        along("time", "s", times(common, 24)),
        exact,
        ours if abs(exact).max() > 0 else np.full_like(ours, np.nan),
        atol=1e-4 * float(abs(exact).max()),
    )


def collision(duration: float, steps: Sequence[float] = (0.00025, 0.0005, 0.001, 0.002)) -> Comparison:
    """Return how hard a half-sine of 0.02 N·s strikes, which takes the solver one step or many: within the share T/τ of it."""
    modes, ours, paper = [{"frequency": 1000.0, "decay": 10.0, "gain": 1.0}], [], []
    with folder() as where:
        for step in steps:
            given: dict[str, Any] = {"modes": modes, "samples": 16, "scrape": 0, "timestep": step}
            ours.append(struck(plate(where, **given), half_sine(duration, step), 10.0, step)[0])
            found = amplitudes(plate(where, **given, **PAPER), half_sine(duration, step, rest=2 * step), step)[:, 0]
            paper.append(found.max())
    return Comparison(
        f"A collision of {1e3 * duration:g} ms strikes once, with its impulse, at any time step",
        "momentum",
        "J = ∫F dt",
        CONTACT,
        "impulse",
        "N·s",
        along("time step", "s", steps, is_log=True),
        np.full(len(steps), 0.02),
        array(ours),
        rtol=duration / 0.02 + 1e-9,
        paper=array(paper),
    )


def impact(seconds: float = 0.2) -> Comparison:
    """Return how loud balls of 50 g from 5 to 160 mm are, by the solver's impulse."""
    with folder() as where:
        largest, impulse = loudest(*dropped(where), seconds)
        paper, _ = loudest(*dropped(where, **PAPER), seconds)
    return Comparison(
        "A falling ball is as loud as the impulse of its collision",
        "momentum, by MuJoCo's contact forces",
        "|z| = ∫F dt",
        CONTACT,
        "amplitude of a mode",
        "N·s",
        along("impulse", "N·s", impulse, is_log=True),
        impulse,
        largest,
        rtol=0.2,
        paper=paper,
    )


def scraping(num_envs: int = 400, num_steps: int = 90) -> Comparison:
    """Return the mean square of what scraping sounds like, after 30 steps, over environments: by the power of friction."""
    decay, scrape, ours = 200.0, 1e-3, []
    rubs = ((1.0, 0.1), (10.0, 0.1), (1.0, 1.0))
    with folder() as where:
        for force, speed in rubs:
            touch = plate(where, modes=[{"frequency": 1270.0, "decay": decay, "gain": 3.0}], samples=10, scrape=scrape)
            heard = sound(touch, np.full((num_steps, num_envs), force), speed)[:, 300:]
            ours.append((heard**2).mean())
    return Comparison(
        "The level of scraping is by force times speed",
        "mean square of an oscillator that white noise drives",
        "⟨s²⟩ = g² m_s F v/4d",
        CONTACT,
        "mean square",
        "m²/s²",
        cases([f"{force:g} N, {speed:g} m/s" for force, speed in rubs]),
        array([9 * scrape * force * speed / (4 * decay) for force, speed in rubs]),
        array(ours),
        rtol=0.05,
    )


def bands(num_steps: int = 4) -> Comparison:
    """Return energies of third octaves at the ends of steps: 523 Hz in that of 501, 1171 in 1259, 2903 in 3162; else none."""
    with folder() as where:
        touch = plate(where, outputs="bands", samples=16, scrape=0)
        for force in STRIKE[:-1]:
            touch(pressed(touch, [force]))
        read = [touch(pressed(touch, [0.0]))["s"][0, 0, 0].numpy().copy() for _ in range(num_steps)]
    middles = [float(channel.removeprefix("band_")) for channel in touch.outputs[0].channels]
    exact = np.zeros((num_steps, len(middles)))
    for mode, band in zip(MODES, (501.0, 1259.0, 3162.0), strict=True):
        after = STEP * np.arange(1, num_steps + 1)
        exact[:, middles.index(band)] = 0.5 * (IMPULSE * mode["gain"]) ** 2 * np.exp(-2 * mode["decay"] * after)
    return Comparison(
        "Third octaves have the mean squares of their modes",
        "mean square of a damped sine; IEC 61260-1 for the bands",
        "E = ½ (g J)² e^(−2dt)",
        CONTACT,
        "energy",
        "m²/s²",
        cases([f"{middle:g} Hz" for middle in middles], "band"),
        exact,
        np.array(read),
        rtol=1e-12,
        series=tuple(f"after {i} ms" for i in range(1, num_steps + 1)),
    )


def spectrum_of(samples: np.ndarray) -> np.ndarray:
    """Return the amplitudes of sines that fit a whole number of times, by their number."""
    return np.abs(np.fft.rfft(samples)) / (len(samples) / 2)


def partials(speed: float = 8.0, effort: float = -0.3) -> Comparison:
    """Return how strong a whine's multiples are, at 100 Hz per rad/s: peaks at those, and nowhere else."""
    with folder() as where:
        touch = motor(where, load=0.02, power=0.05, partials=[1.0, 0.5, 0.25])
        samples = driven(touch, np.full(500, speed), effort)[0]
    level, strength = 0.02 * abs(effort) + 0.05 * abs(effort * speed), np.array([1.0, 0.5, 0.25])
    frequency = 100.0 * speed * np.arange(1, 4)
    spectrum = spectrum_of(samples)
    at = np.round(frequency * 0.5).astype(int)  # of half a second
    is_there = np.array_equal(np.flatnonzero(spectrum > 1e-3 * level), at)
    return Comparison(
        "A whine's partials are at multiples of κ|ω|",
        "the paper's level and pitch; Fourier",
        "ℓ a_h, ℓ = β_load |τ| + β_pow |τω|",
        MOTORS,
        "amplitude",
        "Pa",
        cases([f"{own:g} Hz" for own in frequency]),
        level * strength,
        spectrum[at] if is_there else np.full(3, np.nan),
        rtol=1e-6,
    )


def glide(num_steps: int = 400) -> Comparison:
    """Return a joint that speeds up evenly from 2 rad/s on while its load grows: the phase is the integral of the pitch."""
    steps = np.arange(num_steps) * STEP
    with folder() as where:
        samples = driven(motor(where, load=0.1, partials=[1.0]), 2.0 + 25.0 * steps, 1.0 + 2.0 * steps)[0]
    time = times(20, num_steps) - STEP  # the first call stands still
    phase = 2 * np.pi * 100 * (2.0 * STEP + 2.0 * time + 12.5 * time**2)
    return Comparison(
        "A whine glides, phase and level",
        "integral of the frequency",
        "s = β (1 + 2t) sin 2πκ(ω₀t + αt²/2)",
        MOTORS,
        "pressure at 1 m",
        "Pa",
        along("time", "s", time[20:]),
        (0.1 * (1.0 + 2.0 * time) * np.sin(phase))[20:],
        samples[20:],
        atol=1e-9,
    )


def fading() -> Comparison:
    """Return multiples of 2125 Hz at 20 kHz: the fourth, 8500 Hz, is between 0.40 and 0.45 of the rate, the fifth beyond."""
    with folder() as where:
        touch = motor(where, load=1.0, pitch=100.0, partials=[1.0] * 5)
        samples = driven(touch, np.full(400, 21.25), 1.0)[0][4000:]
    spectrum, at = spectrum_of(samples), np.round(np.arange(1, 5) * 2125.0 * len(samples) / 20000.0).astype(int)
    rest = np.delete(spectrum, at).max()
    return Comparison(
        "Partials that the rate does not hold fade out, none is aliased",
        "by definition, w = (0.45 − f/f_s)/0.05",
        "ℓ a_h w",
        MOTORS,
        "amplitude",
        "Pa",
        cases(["2125 Hz", "4250 Hz", "6375 Hz", "8500 Hz", "largest of all else"]),
        array([1.0, 1.0, 1.0, 0.5, 0.0]),
        array([*spectrum[at], rest]),
        atol=5e-7,
    )


def hum(num_steps: int = 200) -> Comparison:
    """Return the hum of a joint at rest."""
    with folder() as where:
        samples = driven(motor(where, hum=0.3, hum_frequency=150.0), np.zeros(num_steps), 0.0)[0]
    time = times(20, num_steps)
    exact = 0.3 * np.sin(2 * np.pi * 150.0 * time)
    return Comparison(
        "A motor hums at rest", "by definition", "s = a sin 2πft", MOTORS, "pressure at 1 m", "Pa",
        along("time", "s", time), exact, samples, atol=1e-9,
    )  # fmt: skip


def friction() -> Comparison:
    """Return the spectral density of a joint's friction, white, from 20 and from 40 samples per step."""
    ours = []
    with folder() as where:
        for samples in (20, 40):
            found = driven(motor(where, friction=1e-3, samples=samples), np.full(200, 3.0), 0.0, num_envs=16)
            flat = found / found.std()
            is_white = abs(np.mean(flat[:, 1:] * flat[:, :-1])) < 0.02 and abs(np.mean(flat[1:] * flat[:-1])) < 0.02
            ours.append(np.mean(found**2) / (samples / STEP / 2) if is_white else np.nan)
    return Comparison(
        "Noise of friction has one spectral density at every rate",
        "mean square of white noise over half the rate",
        "S = (β ω)²",
        MOTORS,
        "spectral density",
        "Pa²/Hz",
        cases(["20 kHz", "40 kHz"], "sample rate"),
        np.full(2, (1e-3 * 3.0) ** 2),
        array(ours),
        rtol=0.03,
    )


ORACLES: tuple[Oracle, ...] = (
    ring_down,
    partial(ring_down, torch.float32),
    partial(two_pole, {"frequency": 1171.0, "decay": 20.0, "gain": 1.0}),
    response_by_frequency,
    *(partial(common_times, samples) for samples in (10, 40)),
    *(partial(collision, duration) for duration in (0.0005, 0.002)),
    impact,
    scraping,
    bands,
    partials,
    partial(glide, 100),
    fading,
    partial(hum, 40),
    friction,
)
