"""A ball falling on a plate in MuJoCo and in MuJoCo Warp: its loudness at any time step, and resets."""

import functools

import numpy as np
import pytest
import torch
from oracles.setups import sounds
from oracles.setups.sounds import GRAVITY, HEIGHTS, MASS, loudest

from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.warp import WarpSimulation


@pytest.fixture
def dropped(tmp_path):
    """Returns a simulation of balls falling from heights, and its module."""

    def build(simulator=BatchSimulation, *arguments, **keys):
        kind = functools.partial(WarpSimulation, device="cpu") if simulator is WarpSimulation else simulator
        return sounds.dropped(tmp_path, kind, *arguments, **keys)

    return build


def test_amplitude_grows_with_impulse(dropped):
    """Four heights, a factor of 8: log amplitude over log impulse has slope 1; the impulse of a bouncing ball exceeds m v."""
    heights = HEIGHTS[:4]
    amplitude, impulse = loudest(*dropped(heights=heights), 0.11)
    assert np.all(np.diff(impulse) > 0) and np.all(impulse > MASS * np.sqrt(2 * GRAVITY * heights))
    slope = np.polyfit(np.log(impulse), np.log(amplitude), 1)[0]
    assert abs(slope - 1) < 0.05


@pytest.mark.slow
def test_a_collision_sounds_the_same_at_any_time_step(dropped):
    """Contacts of one stiffness, over some 4 to 14 steps: amplitudes agree within 10 %, impulses are equal."""
    amplitudes = []
    for step in (0.0005, 0.001, 0.002):
        sim, touch = dropped(heights=HEIGHTS[3:], step=step, stiffness="-2e5 -4", samples=round(step * 16000))
        amplitudes.append(loudest(sim, touch, 0.24)[0])
    assert np.ptp(amplitudes, axis=0).max() < 0.1 * np.max(amplitudes)


def test_a_ball_at_rest_is_silent(dropped):
    """It sounds on landing, then not any more, nor in an episode that starts at rest."""
    sim, touch = dropped(heights=np.array([0.002]), stiffness="0.01 1")
    landing = max(float(_step_and_read(sim, touch).abs().max()) for _ in range(60))
    for _ in range(300):
        sim.step()
    touch.reset()
    resting = max(float(_step_and_read(sim, touch).abs().max()) for _ in range(60))
    assert landing > 1e-3
    assert resting < 1e-6 * landing


@pytest.mark.slow
@pytest.mark.parametrize("simulator", [BatchSimulation, WarpSimulation])
def test_all_substeps_at_once_equal_single_steps(dropped, simulator):
    """Reading ten physics steps at once equals reading them one after the other."""
    heights = np.array([0.003, 0.006])
    (one, alone), (ten, together) = dropped(simulator, heights), dropped(simulator, heights, substeps=10)
    expected = torch.cat([_step_and_read(one, alone) for _ in range(80)], dim=1)
    readings = torch.cat([_step_and_read(ten, together) for _ in range(8)], dim=1)
    assert expected.abs().amax(dim=(1, 2, 3)).min() > 0
    torch.testing.assert_close(readings, expected, rtol=0, atol=2e-5 * float(expected.abs().max()))
    if simulator is WarpSimulation:
        again, module = dropped(simulator, heights, substeps=10)
        graphed = torch.cat([again.step_and_read()["s"].clone() for _ in range(8)], dim=1)
        torch.testing.assert_close(graphed, readings, rtol=0, atol=1e-6 * float(expected.abs().max()))
        assert module.num_envs == 2


def _step_and_read(sim, touch):
    sim.step()
    return touch(sim.state())["s"].clone()


@pytest.mark.slow
def test_both_simulators_sound_the_same(dropped):
    """The impulse of a drop is its change of momentum, whichever solver handles the contact: amplitudes within 3 %."""
    heights = np.array([0.004, 0.008])
    amplitudes = [loudest(*dropped(simulator, heights), 0.07)[0] for simulator in (BatchSimulation, WarpSimulation)]
    np.testing.assert_allclose(amplitudes[1], amplitudes[0], rtol=0.03)


def test_resetting_one_environment_silences_only_it(dropped):
    """The other one rings on unchanged."""
    heights = np.array([0.003, 0.003])
    (sim, touch), (twin, other) = dropped(heights=heights), dropped(heights=heights)
    for _ in range(40):
        reading, expected = _step_and_read(sim, touch), _step_and_read(twin, other)
    assert reading.abs().amax(dim=(1, 2, 3)).min() > 0
    sim.reset(env_ids=[0])
    reading, expected = _step_and_read(sim, touch), _step_and_read(twin, other)
    assert not reading[0].any()
    torch.testing.assert_close(reading[1], expected[1], rtol=0, atol=0)
