"""What an impulse sounds like: closed forms, over a long time, for any number of samples, and in third octaves."""

import itertools
import math

import numpy as np
import torch
from oracles import sound as oracles
from oracles.setups.sounds import STEP, energy, plate, pressed, sound

from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contacts import Loads, PairLoads
from tgdsl.quantities.kinematics import Places
from tgdsl.sensors.base import Context
from tgdsl.sensors.contact_audio.kind import CONTACT_AUDIO
from tgdsl.sensors.contact_audio.modes import operators


def test_a_mode_is_as_loud_as_the_impulse_at_every_frequency_and_rate():
    """The paper's is 1/sin θ as loud: at 50 Hz and 40 kHz by 127 times."""
    found = oracles.response_by_frequency()
    theta = 2 * np.pi * np.array(found.at) / np.array([[1e4], [4e4]])
    np.testing.assert_allclose(found.paper, 1 / np.sin(theta), rtol=1e-9)


def test_roundings_do_not_add_up():
    """5,000 blocks of a mode that hardly decays, in float32: one rounded factor would be off by 1e-4 by then."""
    frequency, decay, step, samples = 3333.3, 1e-3, 1e-3, 20
    table = {"frequency": frequency, "decay": decay, "gain": 1.0}
    constants = {name: np.array([[value]]) for name, value in table.items()}
    constants |= {"samples": np.array(samples), "settling": np.array(0.02), "scrape": np.array(0.0)}
    load = {name: torch.zeros(1, 1, 1) for name in ("steady", "pending")}
    own = {name: torch.from_numpy(np.asarray(value)).float() for name, value in operators(constants, step).items()}
    state, force, found = {"phasors": torch.tensor([[[1.0, 0.0]]]), **load}, torch.zeros(1, 1, 1), []
    for count in range(5_000):
        context = Context(torch.tensor(step), torch.tensor([[count]]), 0, torch.tensor([[1.0]]), torch.tensor([[False]]))
        gathered = Gathered({Loads: PairLoads(force, force, None), Places: (torch.zeros(1, 3),)})
        read, state = CONTACT_AUDIO.forward(gathered, context, own, state)
        found.append(read["signal"].flatten())
    heard = torch.cat(found).double().numpy()
    time = np.arange(1, len(heard) + 1) * step / samples
    assert abs(heard - np.exp(-decay * time) * np.sin(2 * math.pi * frequency * time)).max() < 3e-5


def test_energy_never_grows_unless_struck(tmp_path):
    """Of float32 phasors too, down to where they are flushed to zero."""
    modes = [{"frequency": f, "decay": d} for f, d in ((50.0, 160.0), (499.9, 200.0), (500.0, 320.0), (3000.0, 1600.0))]
    touch = plate(tmp_path, torch.float32, modes=modes, samples=8, scrape=0)
    sound(touch, oracles.STRIKE)
    silent, held = pressed(touch, [0.0]), [energy(touch)]
    while held[-1] > 0 and len(held) < 225:
        touch(silent)
        held.append(energy(touch))
    assert all(after < before for before, after in itertools.pairwise(held))
    assert held[-1] == 0 and held[-2] < 1e-22


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


def test_bands_are_the_mean_squares_of_modes(tmp_path):
    """½ (g J)² e^(−2dt) at the end of each step, 523 Hz in that of 501, 1171 in 1259, 2903 in 3162."""
    touch = plate(tmp_path, outputs="bands", samples=16, scrape=0)
    assert touch.outputs[0].shape == (1, 1, 9) and touch.outputs[0].units == ("m²/s²",) * 9


def test_levels_are_in_decibels(tmp_path):
    linear, level = (plate(tmp_path, outputs="bands", scrape=0, scale=scale) for scale in ("linear", "decibel"))
    read = [[touch(pressed(touch, [force]))["s"] for force in oracles.STRIKE][-1] for touch in (linear, level)]
    torch.testing.assert_close(read[1], 10 * torch.log10(1 + read[0] / 1e-12), rtol=1e-12, atol=0)
    assert level.outputs[0].units == ("dB",) * 9
