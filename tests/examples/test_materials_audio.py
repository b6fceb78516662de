"""examples/materials_audio.yaml: three boxes that are equal to the solver sound different in random drops."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import find_peaks

import tgdsl

pytestmark = pytest.mark.slow
EXAMPLE = Path(__file__).parents[2] / "examples" / "materials_audio.yaml"
BOXES = ("steel", "wood", "glass")
NUM_DROPS, NUM_STEPS, RATE = 16, 400, 24000.0
SPAN = int(0.06 * RATE)
"""Samples after an impact, before any ball bounces back."""


@pytest.fixture(scope="module")
def drops():
    """Return the sounds from the first impact, (drop, sample), final poses of balls, impact times and modes."""
    touch = tgdsl.compile(EXAMPLE, sensors=BOXES, dtype="float64")
    sim = tgdsl.simulate(touch, NUM_DROPS)
    rng = np.random.default_rng(5)
    place, height = rng.uniform(-0.07, 0.07, size=(NUM_DROPS, 2)), rng.uniform(0.1, 0.4, size=NUM_DROPS)
    for i, centre in enumerate((-0.3, 0.0, 0.3)):
        ball = sim.joints[f"ball_{i + 1}"].qpos
        ball = slice(ball.start, ball.start + 3)
        sim.qpos[:, ball] = torch.from_numpy(np.column_stack([centre + place[:, 0], place[:, 1], 0.11 + height]))
    sim.forward()
    blocks = {name: [] for name in BOXES}
    for _ in range(NUM_STEPS):
        sim.step()
        readings = touch(sim.state())
        for name in BOXES:
            blocks[name].append(readings[name][:, :, 0, 0])
    sounds = {name: torch.cat(blocks[name], dim=1).numpy() for name in BOXES}
    loud = {name: np.abs(value) > 0.01 * np.abs(value).max(axis=1, keepdims=True) for name, value in sounds.items()}
    first = {name: value.argmax(axis=1) for name, value in loud.items()}
    assert all((np.abs(value).max(axis=1) > 1e-3).all() for value in sounds.values()) and sim.num_envs == NUM_DROPS
    cut = {n: np.stack([value[k : k + SPAN] for value, k in zip(sounds[n], first[n], strict=True)]) for n in BOXES}
    balls = [sim.qpos[:, sim.joints[f"ball_{i + 1}"].qpos].numpy() for i in range(3)]
    modes = {value.name: (value.constants["frequency"][0], value.constants["decay"][0]) for value in touch.plan.sensors}
    return cut, balls, first, modes


def centroid(sound):
    """Return the spectral centroid [Hz]."""
    power = np.abs(np.fft.rfft(sound)) ** 2
    return power @ np.fft.rfftfreq(sound.shape[-1], 1 / RATE) / power.sum(axis=-1)


def decay(sound):
    """Return the overall decay rate of amplitudes [1/s], from energies of 6 ms frames."""
    energy = (sound.reshape(len(sound), 10, -1) ** 2).sum(axis=2)
    return -0.5 * np.polyfit(0.006 * np.arange(10), np.log(energy).T, 1)[0]


def test_balls_bounce_equally_on_all_boxes(drops):
    _, balls, first, _ = drops
    for ball, centre in zip(balls, (-0.3, 0.0, 0.3), strict=True):
        same = ball[:, :3] - [centre, 0, 0]
        np.testing.assert_allclose(same, balls[1][:, :3], atol=1e-9)
    for name in ("steel", "glass"):  # rounding may delay a contact by one step
        assert (np.abs(first[name] // 24 - first["wood"] // 24) <= 1).all()


@pytest.mark.parametrize("feature", [centroid, decay])
def test_features_of_all_drops_separate_the_materials(drops, feature):
    """The three ranges of centroid and of decay do not overlap."""
    values = {name: feature(sound) for name, sound in drops[0].items()}
    ordered = sorted(values.values(), key=np.median)
    assert all(below.max() < above.min() for below, above in itertools.pairwise(ordered))
    assert np.isfinite(np.concatenate(ordered)).all() and len(np.concatenate(ordered)) == 3 * NUM_DROPS


@pytest.mark.parametrize("name", BOXES)
def test_peaks_of_the_spectrum_are_at_modes(drops, name):
    """Strong peaks of every drop are at modes, and at least four are in band.

    Tolerance: 1 %, half the mode's width d/2π, and half the 17 Hz resolution of 60 ms.
    """
    modes, decays = drops[3][name]
    assert len(modes) >= 4
    for sound in drops[0][name]:
        spectrum = np.abs(np.fft.rfft(sound * np.hanning(2 * SPAN)[SPAN:], 1 << 15))
        frequency = np.fft.rfftfreq(1 << 15, 1 / RATE)
        peaks = frequency[find_peaks(spectrum, prominence=0.25 * spectrum.max())[0]]
        assert len(peaks) >= 4
        allowed = 0.01 * modes + decays / (2 * np.pi) + 0.5 * RATE / SPAN
        assert all((np.abs(modes - peak) < allowed).any() for peak in peaks)


def test_an_ear_hears_a_box_delayed_and_attenuated_by_distance():
    """Expect ρc √(A/4π)/r of the surface's velocity, r/c later, within 5e-3; the last samples are still in flight."""
    touch = tgdsl.compile(EXAMPLE, sensors=["ear"], overrides={"sensors.ear.hears": ["glass"]}, dtype="float64")
    assert [output.name for output in touch.outputs] == ["glass", "ear"]
    sim = tgdsl.simulate(touch, 1)
    blocks = {"glass": [], "ear": []}
    for _ in range(300):
        sim.step()
        readings = touch(sim.state())
        for name, parts in blocks.items():
            parts.append(readings[name][0, :, 0, 0])
    emitted, heard = (torch.cat(blocks[name]).numpy() for name in ("glass", "ear"))
    distance = np.linalg.norm(np.array([0.3, 0, 0.05]) - [0, -0.6, 0.4])
    level = 1.204 * 343.2 * np.sqrt(0.01 / (4 * np.pi)) / distance
    num = 2 * len(emitted)
    phase = np.exp(-2j * np.pi * np.fft.rfftfreq(num, 1 / RATE) * distance / 343.0)
    expected = level * np.fft.irfft(np.fft.rfft(emitted, num) * phase, num)[: len(heard)]
    assert np.abs(expected).max() > 1.0
    assert np.abs(heard - expected)[:-300].max() < 5e-3 * np.abs(expected).max()
