"""What an impulse sounds like: closed forms, over a long time, for any number of samples, and in third octaves."""

import itertools
import math

import numpy as np
import pytest
import torch
from struck_plate import MODES, STEP, energy, plate, pressed, ringing, sound

from tgdsl.quantities.base import Gathered
from tgdsl.quantities.loads import Loads, PairLoads
from tgdsl.quantities.places import Places
from tgdsl.sensors.base import Context
from tgdsl.sensors.contact_audio.kind import CONTACT_AUDIO
from tgdsl.sensors.contact_audio.operators import operators

STRIKE = [0.0, 0.0, 3.0, 0.0]
"""A collision of one step, 3 N over 1 ms, whose impulse strikes at the start of the next one."""


def times(samples: int, num_steps: int) -> np.ndarray:
    return np.arange(1, samples * num_steps + 1) * STEP / samples


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_an_impulse_rings_as_damped_sines(tmp_path, dtype):
    """J Σ g e^(−dt) sin 2πft from the impulse on, and nothing at all before."""
    found = sound(plate(tmp_path, dtype, samples=16), [*STRIKE, *[0.0] * 60])[0]
    expected = ringing(3e-3, times(16, 64) - 3 * STEP)
    assert not found[: 3 * 16].any()
    np.testing.assert_allclose(found, expected, rtol=0, atol=(1e-12 if dtype == torch.float64 else 2e-6) * abs(expected).max())


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-5), (torch.float32, 1e-4)])
def test_a_million_samples(tmp_path, dtype, tolerance):
    """Two modes that ring for all of it, by blocks of 2500 samples through the module."""
    modes = [{"frequency": 437.1, "decay": 1.0, "gain": 1.0}, {"frequency": 12345.6, "decay": 0.4, "gain": 0.5}]
    step = 0.05
    touch = plate(tmp_path, dtype, modes=modes, samples=2500, scrape=0, timestep=step, settling=0.1)
    touch(pressed(touch, [0.0], step=step)), touch(pressed(touch, [2.0], step=step))
    silent = pressed(touch, [0.0], step=step)
    with torch.no_grad():
        found = torch.cat([touch(silent)["s"][0, :, 0, 0] for _ in range(400)]).double().numpy()
    expected = ringing(0.1, np.arange(1, len(found) + 1) * step / 2500, modes)
    assert len(found) == 1_000_000
    assert abs(found - expected).max() <= tolerance * abs(expected).max()


def test_roundings_do_not_add_up():
    """20,000 blocks of a mode that hardly decays, in float32: one rounded factor would be off by 5e-4 by then."""
    frequency, decay, step, samples = 3333.3, 1e-3, 1e-3, 20
    table = {"frequency": frequency, "decay": decay, "gain": 1.0}
    constants = {name: np.array([[value]]) for name, value in table.items()}
    constants |= {"samples": np.array(samples), "settling": np.array(0.02), "scrape": np.array(0.0)}
    load = {name: torch.zeros(1, 1, 1) for name in ("steady", "pending")}
    own = {name: torch.from_numpy(np.asarray(value)).float() for name, value in operators(constants, step).items()}
    state, force, found = {"phasors": torch.tensor([[[1.0, 0.0]]]), **load}, torch.zeros(1, 1, 1), []
    for count in range(20_000):
        context = Context(torch.tensor(step), torch.tensor([[count]]), 0, torch.tensor([[1.0]]), torch.tensor([[False]]))
        gathered = Gathered({Loads: PairLoads(force, force, None), Places: (torch.zeros(1, 3),)})
        read, state = CONTACT_AUDIO.forward(gathered, context, own, state)
        found.append(read["signal"].flatten())
    heard = torch.cat(found).double().numpy()
    time = np.arange(1, len(heard) + 1) * step / samples
    assert abs(heard - np.exp(-decay * time) * np.sin(2 * math.pi * frequency * time)).max() < 3e-5


def test_energy_never_grows_unless_struck(tmp_path):
    """Of float32 phasors too, down to where they are flushed to zero."""
    modes = [{"frequency": f, "decay": d} for f, d in ((50.0, 40.0), (499.9, 50.0), (500.0, 80.0), (3000.0, 400.0))]
    touch = plate(tmp_path, torch.float32, modes=modes, samples=8, scrape=0)
    sound(touch, STRIKE)
    silent, held = pressed(touch, [0.0]), [energy(touch)]
    while held[-1] > 0 and len(held) < 900:
        touch(silent)
        held.append(energy(touch))
    assert all(after < before for before, after in itertools.pairwise(held))
    assert held[-1] == 0 and held[-2] < 1e-22


@pytest.mark.parametrize("samples", [7, 10, 40])
def test_samples_at_common_times_are_the_same_for_all_numbers_of_samples(tmp_path, samples):
    """Struck and scraped: what 20 samples and another number have in common."""
    forces = np.abs(np.sin(np.arange(24))) * 4
    found = {k: sound(plate(tmp_path, torch.float32, samples=k, scrape=1e-3), forces, 0.3)[0] for k in (20, samples)}
    common = math.gcd(20, samples)
    one, other = (found[k].reshape(24, common, -1)[:, :, -1] for k in (20, samples))
    assert abs(one).max() > 0
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-4 * abs(one).max())
    assert common > 1 or samples == 7


def test_calls_of_several_steps_sound_as_calls_of_one(tmp_path):
    """The blocks of all physics steps come together, and the noise is that of the physics step."""
    forces = np.abs(np.cos(np.arange(12))) * 2
    expected = sound(plate(tmp_path, samples=10), forces, 0.2)
    touch = plate(tmp_path, samples=10, substeps=4)
    states = [pressed(touch, [f], 0.2) for f in forces.tolist()]
    found = []
    for i in range(0, 12, 4):
        *earlier, last = states[i : i + 4]
        last.substeps, last.dt = tuple(earlier), 4 * STEP
        found.append(touch(last)["s"][0, :, 0, 0])
    np.testing.assert_allclose(torch.cat(found).numpy()[None], expected, rtol=0, atol=1e-15)


def test_the_papers_response_is_as_printed(tmp_path):
    """y[k] = r^k sin((k+1)θ)/sin θ times the rise of the force, from the first sample of the step of the rise on."""
    (mode,) = modes = [{"frequency": 1171.0, "decay": 20.0, "gain": 1.0}]
    touch = plate(tmp_path, modes=modes, samples=10, model="paper", scrape=0)
    found = sound(touch, [0.0, 3.0, *[3.0] * 20])[0]
    theta, k = 2 * math.pi * mode["frequency"] * STEP / 10, np.arange(21 * 10)
    expected = 3e-3 * np.exp(-mode["decay"] * STEP / 10) ** k * np.sin((k + 1) * theta) / math.sin(theta)
    assert not found[:10].any()
    np.testing.assert_allclose(found[10:], expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_bands_are_the_mean_squares_of_modes(tmp_path):
    """½ (g J)² e^(−2dt) at the end of each step, 523 Hz in that of 501, 1171 in 1259, 2903 in 3162."""
    touch = plate(tmp_path, outputs="bands", samples=16, scrape=0)
    channels = touch.outputs[0].channels
    assert touch.outputs[0].shape == (1, 1, 9) and touch.outputs[0].units == ("m²/s²",) * 9
    for force in STRIKE[:-1]:
        touch(pressed(touch, [force]))
    for i in range(1, 5):
        read = dict(zip(channels, touch(pressed(touch, [0.0]))["s"][0, 0, 0].tolist(), strict=True))
        for mode, band in zip(MODES, (501, 1259, 3162), strict=True):
            expected = 0.5 * (3e-3 * mode["gain"]) ** 2 * math.exp(-2 * mode["decay"] * i * STEP)
            assert read.pop(f"band_{band}") == pytest.approx(expected, rel=1e-12)
        assert set(read.values()) == {0.0}


def test_levels_are_in_decibels(tmp_path):
    linear, level = (plate(tmp_path, outputs="bands", scrape=0, scale=scale) for scale in ("linear", "decibel"))
    read = [[touch(pressed(touch, [force]))["s"] for force in STRIKE][-1] for touch in (linear, level)]
    torch.testing.assert_close(read[1], 10 * torch.log10(1 + read[0] / 1e-12), rtol=1e-12, atol=0)
    assert level.outputs[0].units == ("dB",) * 9
