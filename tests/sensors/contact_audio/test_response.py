"""The sound of an impulse: closed forms, over a long time, for any number of samples, and in third octaves."""

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


def test_a_modes_loudness_depends_only_on_the_impulse():
    """The paper's modes are louder by 1/sin θ: 127 times at 50 Hz and 40 kHz."""
    response = oracles.response_by_frequency()
    theta = 2 * np.pi * np.array(response.at) / np.array([[1e4], [4e4]])
    np.testing.assert_allclose(response.paper, 1 / np.sin(theta), rtol=1e-9)


def test_rounding_errors_do_not_accumulate():
    """5,000 blocks of a mode that hardly decays, in float32: one rounded factor would cause an error of 1e-4."""
    frequency, decay, step, samples = 3333.3, 1e-3, 1e-3, 20
    table = {"frequency": frequency, "decay": decay, "gain": 1.0}
    constants = {name: np.array([[value]]) for name, value in table.items()}
    constants |= {"samples": np.array(samples), "settling": np.array(0.02), "scrape": np.array(0.0)}
    load = {name: torch.zeros(1, 1, 1) for name in ("steady", "pending")}
    tables = {name: torch.from_numpy(np.asarray(value)).float() for name, value in operators(constants, step).items()}
    state, force, blocks = {"phasors": torch.tensor([[[1.0, 0.0]]]), **load}, torch.zeros(1, 1, 1), []
    for count in range(5_000):
        context = Context(torch.tensor(step), torch.tensor([[count]]), 0, torch.tensor([[1.0]]), torch.tensor([[False]]))
        gathered = Gathered({Loads: PairLoads(force, force, None), Places: (torch.zeros(1, 3),)})
        read, state = CONTACT_AUDIO.forward(gathered, context, tables, state)
        blocks.append(read["signal"].flatten())
    heard = torch.cat(blocks).double().numpy()
    time = np.arange(1, len(heard) + 1) * step / samples
    assert abs(heard - np.exp(-decay * time) * np.sin(2 * math.pi * frequency * time)).max() < 3e-5


def test_energy_never_grows_unless_struck(tmp_path):
    """Float32 phasors too, until they are flushed to zero."""
    modes = [{"frequency": f, "decay": d} for f, d in ((50.0, 160.0), (499.9, 200.0), (500.0, 320.0), (3000.0, 1600.0))]
    touch = plate(tmp_path, torch.float32, modes=modes, samples=8, scrape=0)
    sound(touch, oracles.STRIKE)
    silent, energies = pressed(touch, [0.0]), [energy(touch)]
    while energies[-1] > 0 and len(energies) < 225:
        touch(silent)
        energies.append(energy(touch))
    assert all(current < previous for previous, current in itertools.pairwise(energies))
    assert energies[-1] == 0 and energies[-2] < 1e-22


def test_calls_of_several_steps_equal_calls_of_one(tmp_path):
    """The blocks of all physics steps come together, with the noise of each step."""
    forces = np.abs(np.cos(np.arange(12))) * 2
    expected = sound(plate(tmp_path, samples=10), forces, 0.2)
    touch = plate(tmp_path, samples=10, substeps=4)
    states = [pressed(touch, [f], 0.2) for f in forces.tolist()]
    blocks = []
    for i in range(0, 12, 4):
        *earlier, last = states[i : i + 4]
        last.substeps, last.dt = tuple(earlier), 4 * STEP
        blocks.append(touch(last)["s"][0, :, 0, 0])
    np.testing.assert_allclose(torch.cat(blocks).numpy()[None], expected, rtol=0, atol=1e-15)


def test_bands_are_the_mean_squares_of_modes(tmp_path):
    """½ (g J)² e^(−2dt) at the end of each step; 523 Hz lies in the band of 501, 1171 in 1259, 2903 in 3162."""
    touch = plate(tmp_path, outputs="bands", samples=16, scrape=0)
    assert touch.outputs[0].shape == (1, 1, 9) and touch.outputs[0].units == ("m²/s²",) * 9


def test_levels_are_in_decibels(tmp_path):
    linear, level = (plate(tmp_path, outputs="bands", scrape=0, scale=scale) for scale in ("linear", "decibel"))
    readings = [[touch(pressed(touch, [force]))["s"] for force in oracles.STRIKE][-1] for touch in (linear, level)]
    torch.testing.assert_close(readings[1], 10 * torch.log10(1 + readings[0] / 1e-12), rtol=1e-12, atol=0)
    assert level.outputs[0].units == ("dB",) * 9
