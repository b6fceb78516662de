"""Sound of contacts and of motors, against closed forms.

"The paper" is `model: paper` of contact audio on the same states: its two-pole resonators as printed, each struck with ΔF Δt
by a rise of the force ΔF, for which the paper gives no formula.
"""

import math

import numpy as np
import torch

from oracles.comparison import Values, field
from oracles.setups.scenes import folder, temporary
from oracles.setups.sounds import (
    MODES,
    STEP,
    amplitudes,
    driven,
    dropped,
    half_sine,
    loudest,
    motor,
    plate,
    pressed,
    ringing,
    sound,
    struck,
)  # fmt: skip

contact, motors = (field("sound: contacts and motors", kind) for kind in ("contact_audio", "actuation_audio"))
IMPULSE_RESPONSE = "impulse response of damped oscillators"
STRIKE = [0.0, 0.0, 3.0, 0.0]
"""A collision of one step, 3 N over 1 ms, whose impulse strikes at the start of the next one [N]."""
IMPULSE = 3e-3
"""Its impulse [N·s]."""
RATES = (10, 40)
"""Samples per step."""
PAPER = {"model": "paper"}


def times(samples: int, num_steps: int) -> np.ndarray:
    """Return the times of samples [s]."""
    return np.arange(1, samples * num_steps + 1) * STEP / samples


@contact(
    "Three modes ring down after an impulse", "s = J Σ g e^(−dt) sin 2πft", IMPULSE_RESPONSE, "velocity of the surface [m/s]",
    "time [s]", each=[torch.float64, torch.float32],
)  # fmt: skip
def ring_down(dtype: torch.dtype):
    ours = sound(temporary(plate, dtype, samples=16), [*STRIKE, *[0.0] * 60])[0]
    time = times(16, 64) - 3 * STEP
    exact = ringing(IMPULSE, time)
    atol = (1e-12 if dtype == torch.float64 else 2e-6) * abs(exact).max()
    return Values(exact, np.nan if ours[: 3 * 16].any() else ours, at=time, atol=atol)


@contact(
    "Two modes ring for 1,000,000 samples", "s = J Σ g e^(−dt) sin 2πft", IMPULSE_RESPONSE, "velocity of the surface [m/s]",
    "time [s]", each=[], also=[torch.float64, torch.float32],
)  # fmt: skip
def million_samples(dtype: torch.dtype):
    modes, step = [{"frequency": 437.1, "decay": 1.0, "gain": 1.0}, {"frequency": 12345.6, "decay": 0.4, "gain": 0.5}], 0.05
    touch = temporary(plate, dtype, modes=modes, samples=2500, scrape=0, timestep=step, settling=0.1)
    with torch.no_grad():
        for force in (0.0, 2.0):
            touch(pressed(touch, [force], step=step))
        silent = pressed(touch, [0.0], step=step)
        ours = torch.cat([touch(silent)["s"][0, :, 0, 0] for _ in range(400)]).double().numpy()
    time = np.arange(1, 1_000_001) * step / 2500
    exact = ringing(0.1, time, modes)
    return Values(exact, ours, at=time, atol=(1e-5 if dtype == torch.float64 else 1e-4) * abs(exact).max())


@contact(
    "The paper's two-pole response is as it is printed", "y[k] = J r^k sin((k+1)θ)/sin θ",
    "the paper's equation, as a sum of powers", "response [N·s]", "time [s]", of_peak=1e-12,
)  # fmt: skip
def two_pole(samples: int = 10, num_steps: int = 21):
    mode = {"frequency": 1171.0, "decay": 20.0, "gain": 1.0}
    ours = sound(temporary(plate, modes=[mode], samples=samples, scrape=0, **PAPER), [0.0, *[3.0] * num_steps])[0]
    theta, k = 2 * math.pi * mode["frequency"] * STEP / samples, np.arange(num_steps * samples)
    exact = IMPULSE * np.exp(-mode["decay"] * STEP / samples) ** k * np.sin((k + 1) * theta) / math.sin(theta)
    return Values(exact, np.nan if ours[:samples].any() else ours[samples:], at=k * STEP / samples)


@contact(
    "A mode is as loud as the impulse, at every frequency and sample rate", "|z| = J",
    "impulse response of a damped oscillator; the paper's resonator has 1/sin θ, θ = 2πf Δt/K", "amplitude over impulse [1]",
    "frequency [Hz]", is_log=True, rtol=1e-12, series=[f"{samples} samples per ms" for samples in RATES],
)  # fmt: skip
def response_by_frequency():
    frequency = np.array([50.0, 100.0, 200.0, 500.0, 1000.0, 1500.0, 2000.0, 2500.0, 3000.0, 3500.0, 4000.0, 4450.0])
    modes, ours, paper = [{"frequency": f, "decay": 1.0, "gain": 1.0} for f in frequency.tolist()], [], []
    with folder() as where:
        for samples in RATES:
            fields = {"modes": modes, "samples": samples, "scrape": 0}
            ours.append(amplitudes(plate(where, **fields), STRIKE)[3] * math.exp(STEP) / IMPULSE)
            late = STEP * (1 - 1 / samples)  # the paper's strikes at the first sample
            paper.append(amplitudes(plate(where, **fields, **PAPER), STRIKE)[2] * math.exp(late) / IMPULSE)
    return Values(1.0, np.array(ours), np.array(paper), at=frequency)


@contact(
    "{samples} samples per step are those of 20 at common times, struck and scraped, float32", "s(t) does not depend on K",
    "the same sound at another rate", "velocity of the surface [m/s]", "time [s]", of_peak=1e-4, each=[10, 40], also=[7],
)  # fmt: skip
def common_times(samples: int):
    forces, common = np.abs(np.sin(np.arange(24))) * 4, math.gcd(20, samples)
    heard = [sound(temporary(plate, torch.float32, samples=k, scrape=1e-3), forces, 0.3)[0] for k in (20, samples)]
    exact, ours = (samples.reshape(24 * common, -1)[:, -1] for samples in heard)
    return Values(exact, ours if exact.any() else np.nan, at=times(common, 24))


@contact(
    "A collision of {duration:ms} strikes once, with its impulse, at any time step", "J = ∫F dt", "momentum", "impulse [N·s]",
    "time step [s]", is_log=True, each=[0.0005, 0.002], also=[0.004], slow=[0.002],
)  # fmt: skip
def collision(duration: float):
    modes, ours, paper = [{"frequency": 1000.0, "decay": 10.0, "gain": 1.0}], [], []
    steps = (0.00025, 0.0005, 0.001, 0.002)
    for step in steps:
        fields = {"modes": modes, "samples": 16, "scrape": 0, "timestep": step}
        ours.append(struck(temporary(plate, **fields), half_sine(duration, step), 10.0, step)[0])
        printed = temporary(plate, **fields, **PAPER)
        paper.append(amplitudes(printed, half_sine(duration, step, rest=2 * step), step)[:, 0].max())
    return Values(0.02, ours, paper, at=steps, rtol=duration / 0.02 + 1e-9)


@contact(
    "A falling ball is as loud as the impulse of its collision", "|z| = ∫F dt", "momentum, by MuJoCo's contact forces",
    "amplitude of a mode [N·s]", "impulse [N·s]", is_log=True, rtol=0.2,
)  # fmt: skip
def impact(seconds: float = 0.2):
    with folder() as where:
        largest, impulse = loudest(*dropped(where), seconds)
        paper, _ = loudest(*dropped(where, **PAPER), seconds)
    return Values(impulse, largest, paper, at=impulse)


RUBS = ((1.0, 0.1), (10.0, 0.1), (1.0, 1.0))
"""Normal forces [N] and speeds [m/s]."""


@contact(
    "The level of scraping is by force times speed", "⟨s²⟩ = g² m_s F v/4d",
    "mean square of an oscillator that white noise drives", "mean square [m²/s²]",
    at=[f"{force:g} N, {speed:g} m/s" for force, speed in RUBS], rtol=0.05,
)  # fmt: skip
def scraping(num_envs: int = 400, num_steps: int = 90):
    decay, scrape, ours = 200.0, 1e-3, []
    for force, speed in RUBS:
        mode = {"frequency": 1270.0, "decay": decay, "gain": 3.0}
        touch = temporary(plate, modes=[mode], samples=10, scrape=scrape)
        ours.append((sound(touch, np.full((num_steps, num_envs), force), speed)[:, 300:] ** 2).mean())
    return [9 * scrape * force * speed / (4 * decay) for force, speed in RUBS], ours


@contact(
    "Scraping is white noise to modes {apart} Hz apart", "E|z|² = m_s W/2d, E z₁z₂* = m_s W/(2d − i(ω₁ − ω₂))",
    "Campbell's theorem of shot noise", "mean square, correlations, over m_s W/2d [1]",
    at=["mode 1", "mode 2", "z₁z₂*", "z₁z₂"], atol=0.07, each=[4000.0, 2800.0], also=[250.0, 1000.0],
)  # fmt: skip
def independent_modes(apart: float, num_envs: int = 4000, num_steps: int = 60):
    decay, scrape, force, speed = 60.0, 1e-3, 2.0, 0.5
    modes = [{"frequency": f, "decay": decay, "gain": 1.0} for f in (600.0, 600.0 + apart)]
    touch = temporary(plate, modes=modes, samples=20, scrape=scrape)
    for _ in range(num_steps):
        touch(pressed(touch, [force] * num_envs, speed))
    real, imag = touch.memory.get_buffer("s:phasors").double().numpy().reshape(num_envs, 2, 2).swapaxes(0, 1)
    one, other = (real + 1j * imag).T
    power = scrape * force * speed / (2 * decay)
    means = (one * one.conj(), other * other.conj(), one * other.conj(), one * other)
    turns = 2 * np.pi * np.array([0.0, 0.0, apart, 1200.0 + apart])
    return 2 * decay / np.hypot(2 * decay, turns), [abs(mean.mean()) / power for mean in means]


@contact(
    "Third octaves have the mean squares of their modes", "E = ½ (g J)² e^(−2dt)",
    "mean square of a damped sine; IEC 61260-1 for the bands", "energy [m²/s²]", "band", rtol=1e-12,
    series=[f"after {i} ms" for i in range(1, 5)],
)  # fmt: skip
def bands(num_steps: int = 4):
    touch = temporary(plate, outputs="bands", samples=16, scrape=0)
    for force in STRIKE[:-1]:
        touch(pressed(touch, [force]))
    ours = [touch(pressed(touch, [0.0]))["s"][0, 0, 0].numpy().copy() for _ in range(num_steps)]
    middles = [float(channel.removeprefix("band_")) for channel in touch.outputs[0].channels]
    exact = np.zeros((num_steps, len(middles)))
    for mode, band in zip(MODES, (501.0, 1259.0, 3162.0), strict=True):
        after = STEP * np.arange(1, num_steps + 1)
        exact[:, middles.index(band)] = 0.5 * (IMPULSE * mode["gain"]) ** 2 * np.exp(-2 * mode["decay"] * after)
    return Values(exact, ours, at=[f"{middle:g} Hz" for middle in middles])


def spectrum_of(samples: np.ndarray) -> np.ndarray:
    """Return the amplitudes of sines by their whole numbers of periods."""
    return np.abs(np.fft.rfft(samples)) / (len(samples) / 2)


@motors(
    "A whine's partials are at multiples of κ|ω|", "ℓ a_h, ℓ = β_load |τ| + β_pow |τω|", "the paper's level and pitch; Fourier",
    "amplitude [Pa]", rtol=1e-6,
)  # fmt: skip
def partials(speed: float = 8.0, effort: float = -0.3):
    touch = temporary(motor, load=0.02, power=0.05, partials=[1.0, 0.5, 0.25])
    samples = driven(touch, np.full(500, speed), effort)[0]
    level, strength = 0.02 * abs(effort) + 0.05 * abs(effort * speed), np.array([1.0, 0.5, 0.25])
    frequency = 100.0 * speed * np.arange(1, 4)
    spectrum = spectrum_of(samples)
    at = np.round(frequency * 0.5).astype(int)  # of half a second
    is_there = np.array_equal(np.flatnonzero(spectrum > 1e-3 * level), at)
    return Values(level * strength, spectrum[at] if is_there else np.nan, at=[f"{f:g} Hz" for f in frequency])


@motors(
    "A whine glides, phase and level", "s = β (1 + 2t) sin 2πκ(ω₀t + αt²/2)", "integral of the frequency",
    "pressure at 1 m [Pa]", "time [s]", atol=1e-9, each=[100], also=[400],
)  # fmt: skip
def glide(num_steps: int):
    steps = np.arange(num_steps) * STEP
    samples = driven(temporary(motor, load=0.1, partials=[1.0]), 2.0 + 25.0 * steps, 1.0 + 2.0 * steps)[0]
    time = times(20, num_steps) - STEP  # the first call stands still
    phase = 2 * np.pi * 100 * (2.0 * STEP + 2.0 * time + 12.5 * time**2)
    return Values((0.1 * (1.0 + 2.0 * time) * np.sin(phase))[20:], samples[20:], at=time[20:])


@motors(
    "Partials that the rate does not hold fade out, none is aliased", "ℓ a_h w", "by definition, w = (0.45 − f/f_s)/0.05",
    "amplitude [Pa]", at=["2125 Hz", "4250 Hz", "6375 Hz", "8500 Hz", "largest of all else"], atol=5e-7,
)  # fmt: skip
def fading():
    samples = driven(temporary(motor, load=1.0, pitch=100.0, partials=[1.0] * 5), np.full(400, 21.25), 1.0)[0][4000:]
    spectrum, at = spectrum_of(samples), np.round(np.arange(1, 5) * 2125.0 * len(samples) / 20000.0).astype(int)
    return [1.0, 1.0, 1.0, 0.5, 0.0], [*spectrum[at], np.delete(spectrum, at).max()]


@motors(
    "A motor hums at rest", "s = a sin 2πft", "by definition", "pressure at 1 m [Pa]", "time [s]", atol=1e-9, each=[40],
    also=[200],
)  # fmt: skip
def hum(num_steps: int):
    time = times(20, num_steps)
    ours = driven(temporary(motor, hum=0.3, hum_frequency=150.0), np.zeros(num_steps), 0.0)[0]
    return Values(0.3 * np.sin(2 * np.pi * 150.0 * time), ours, at=time)


@motors(
    "Noise of friction has one spectral density at every rate", "S = (β ω)²", "mean square of white noise over half the rate",
    "spectral density [Pa²/Hz]", "sample rate", at=["20 kHz", "40 kHz"], rtol=0.03,
)  # fmt: skip
def friction():
    ours = []
    for samples in (20, 40):
        noise = driven(temporary(motor, friction=1e-3, samples=samples), np.full(200, 3.0), 0.0, num_envs=16)
        flat = noise / noise.std()
        is_white = abs(np.mean(flat[:, 1:] * flat[:, :-1])) < 0.02 and abs(np.mean(flat[1:] * flat[:-1])) < 0.02
        ours.append(np.mean(noise**2) / (samples / STEP / 2) if is_white else np.nan)
    return (1e-3 * 3.0) ** 2, ours
