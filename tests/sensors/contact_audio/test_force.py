"""`model: force`: modes driven by the history of the contact force, against momentum, closed forms and SciPy's ODEs."""

import math

import numpy as np
import pytest
import torch
from oracles.setups.sounds import MODES, STEP, amplitudes, half_sine, plate, pressed, sound
from scipy.signal import lsim

import tgdsl
from tgdsl.runtime.batch.simulation import BatchSimulation

FORCE = {"model": "force", "scrape": 0}
RATES = np.array([complex(-mode["decay"], 2 * math.pi * mode["frequency"]) for mode in MODES])
THROWN = """
<mujoco>
  <option timestep="{step}" gravity="0 0 0"/>
  <worldbody>
    <body name="plate"><geom type="box" size=".1 .1 .005" solref="{solref}"/></body>
    <body name="ball" pos="0 0 .0162"><freejoint/><geom type="sphere" size=".01" mass=".05" solref="{solref}"/></body>
  </worldbody>
</mujoco>
"""


def phasors(touch):
    """Return the plate's current phasors (env, mode) [N·s]."""
    real, imag = touch.memory.get_buffer("s:phasors")[:, 0].double().numpy().reshape(touch.num_envs, 2, -1).swapaxes(0, 1)
    return real + 1j * imag


@pytest.mark.parametrize(("step", "solref"), [(0.002, "0.02 1"), (0.001, "0.004 1"), (0.0005, "0.004 1")])
def test_a_strikes_amplitude_is_its_change_of_momentum(tmp_path, step, solref):
    """A 1 Hz mode is slow next to contacts of up to 40 ms: its amplitude is m Δv of a ball that MuJoCo throws on the plate."""
    (tmp_path / "thrown.xml").write_text(THROWN.format(step=step, solref=solref))
    modes = [{"frequency": 1.0, "decay": 0.01}]
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "thrown.xml")},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"s": {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": modes, **FORCE}},
        },
        dtype=torch.float64,
    )
    sim = BatchSimulation(touch, 1)
    sim.qvel[:, 2] = -1.0
    sim.forward()
    touch(sim.state())
    for _ in range(round(0.06 / step)):
        sim.step()
        touch(sim.state())
    impulse = 0.05 * (float(sim.qvel[0, 2]) + 1.0)
    assert impulse > 0.05
    assert np.abs(phasors(touch)) * math.exp(0.01 * 0.06) == pytest.approx(impulse, rel=0.01)


def test_a_piecewise_linear_force_is_exact_at_any_step(tmp_path):
    """Steps of 2 ms and of 0.2 ms give the same phasors and samples, to 1e-12 of the largest."""
    corners = np.random.default_rng(0).uniform(0, 5, 12)
    results = []
    for num in (1, 10):
        touch = plate(tmp_path, samples=20 // num, timestep=0.002 / num, **FORCE)
        forces = np.interp(np.arange(11 * num + 1) / num, np.arange(12), corners)
        heard = sound(touch, forces, step=0.002 / num)[0]
        results.append((phasors(touch)[0], heard[20 // num :]))
    for coarse, fine in zip(*results, strict=True):
        np.testing.assert_allclose(fine, coarse, rtol=0, atol=1e-12 * np.abs(coarse).max())


def test_samples_are_velocities_of_driven_oscillators(tmp_path):
    """SciPy integrates q̈ + 2d q̇ + (d² + ω²) q = F for a force that is linear between samples: Σ g q̇."""
    forces, num = np.concatenate([[0.0], np.random.default_rng(1).uniform(0, 5, 20), np.zeros(20)]), 16
    heard = sound(plate(tmp_path, samples=num, **FORCE), forces)[0]
    time = np.arange(40 * num + 1) * STEP / num
    drive = np.interp(time / STEP, np.arange(41), forces)
    each = [
        mode["gain"] * lsim(([1.0, 0.0], [1.0, 2 * mode["decay"], abs(rate) ** 2]), drive, time)[1]
        for mode, rate in zip(MODES, RATES, strict=True)
    ]
    expected = np.sum(each, axis=0)[1:]
    assert not heard[:num].any()
    np.testing.assert_allclose(heard[num:], expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_half_sine_converges_to_its_closed_form(tmp_path):
    """∫ sin(at) e^(λ(T−t)) dt = a (1 + e^(λT))/(λ² + a²), a = π/T; convergence in the step is of second order."""
    duration, errors = 0.004, []
    a = math.pi / duration
    exact = a * (1 + np.exp(RATES * duration)) / (RATES**2 + a**2)
    for num in (128, 256):
        step = duration / num
        touch = plate(tmp_path, samples=2, timestep=step, **FORCE)
        sound(touch, np.sin(np.pi * np.arange(num + 1) / num).clip(0), step=step)
        errors.append(np.abs(phasors(touch)[0] - exact) / np.abs(exact).max())
    assert np.all(errors[1] < 2e-3)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.1)


@pytest.mark.parametrize("frequency", [20.0, 300.0, 700.0, 1400.0, 2500.0])
def test_a_contact_excites_a_mode_by_its_spectrum(tmp_path, frequency):
    """A triangle of force, 1 ms up and 1 ms down, of 3e-3 N·s: J sinc²(f Δt); multiples of one kilohertz are silent."""
    touch = plate(tmp_path, modes=[{"frequency": frequency, "decay": 1e-6}], samples=10, **FORCE)
    amplitude = amplitudes(touch, [0.0, 3.0, 0.0])[-1, 0]
    assert amplitude == pytest.approx(3e-3 * np.sinc(frequency * STEP) ** 2, rel=1e-5)


def test_a_steady_force_adds_nothing(tmp_path):
    """Nor does the first force of an episode; after a rise z decays freely, with e^(λΔt) per step, at any force."""
    touch = plate(tmp_path, samples=16, **FORCE)
    assert not sound(touch, [5.0] * 20).any()
    sound(touch, [0.0])
    previous = phasors(touch)
    for _ in range(30):
        sound(touch, [0.0])
        np.testing.assert_allclose(
            phasors(touch), previous * np.exp(RATES * STEP), rtol=0, atol=1e-12 * np.abs(previous).max() + 2e-12
        )
        previous = phasors(touch)
    assert np.abs(previous).min() > 1e-6


def test_twice_the_force_sounds_twice_as_loud_in_float32(tmp_path):
    one, two = (sound(plate(tmp_path, torch.float32, **FORCE), np.array(half_sine(0.003, STEP, rest=0.01)) * k) for k in (1, 2))
    np.testing.assert_allclose(two, 2 * one, rtol=0, atol=1e-6 * np.abs(two).max())


def test_a_reset_forgets_the_force(tmp_path):
    """Of two environments under load, the reset one is silent when its first force differs."""
    touch = plate(tmp_path, **FORCE)
    for load in (0.0, 3.0):
        touch(pressed(touch, [load] * 2))
    touch.reset(torch.tensor([True, False]))
    heard = touch(pressed(touch, [1.0] * 2))["s"]
    assert not heard[0].any() and heard[1].any()
