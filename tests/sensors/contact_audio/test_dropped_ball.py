"""A ball that falls on a plate in MuJoCo and in MuJoCo Warp: how loud it is, whenever it is read, and whose turn it is."""

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
    """Returns a simulation of balls that fall from heights, and its module."""

    def build(simulator=BatchSimulation, *given, **keys):
        kind = functools.partial(WarpSimulation, device="cpu") if simulator is WarpSimulation else simulator
        return sounds.dropped(tmp_path, kind, *given, **keys)

    return build


def test_amplitude_grows_with_impulse(dropped):
    """Four heights, a factor of 8: the slope of log amplitude over log impulse is 1, and a ball that bounces has more than m v."""
    heights = HEIGHTS[:4]
    amplitude, impulse = loudest(*dropped(heights=heights), 0.11)
    assert np.all(np.diff(impulse) > 0) and np.all(impulse > MASS * np.sqrt(2 * GRAVITY * heights))
    slope = np.polyfit(np.log(impulse), np.log(amplitude), 1)[0]
    assert abs(slope - 1) < 0.05


@pytest.mark.slow
def test_a_collision_sounds_the_same_at_any_time_step(dropped):
    """Contacts of one stiffness that take some 4 to 14 steps: amplitudes within 10 %, impulses the same."""
    found = []
    for step in (0.0005, 0.001, 0.002):
        sim, touch = dropped(heights=HEIGHTS[3:], step=step, stiffness="-2e5 -4", samples=round(step * 16000))
        found.append(loudest(sim, touch, 0.24)[0])
    assert np.ptp(found, axis=0).max() < 0.1 * np.max(found)


def test_a_ball_at_rest_is_silent(dropped):
    """It is heard when it lands, and no more once it lies: neither as it goes on, nor in an episode that begins so."""
    sim, touch = dropped(heights=np.array([0.002]), stiffness="0.01 1")
    landing = max(float(_stepped(sim, touch).abs().max()) for _ in range(60))
    for _ in range(300):
        sim.step()
    touch.reset()
    resting = max(float(_stepped(sim, touch).abs().max()) for _ in range(60))
    assert landing > 1e-3
    assert resting < 1e-6 * landing


@pytest.mark.slow
@pytest.mark.parametrize("simulator", [BatchSimulation, WarpSimulation])
def test_blocks_of_all_substeps_come_together(dropped, simulator):
    """What is read of each physics step alone, one after the other, is what is read of all ten at once."""
    heights = np.array([0.003, 0.006])
    (one, alone), (ten, together) = dropped(simulator, heights), dropped(simulator, heights, substeps=10)
    expected = torch.cat([_stepped(one, alone) for _ in range(80)], dim=1)
    found = torch.cat([_stepped(ten, together) for _ in range(8)], dim=1)
    assert expected.abs().amax(dim=(1, 2, 3)).min() > 0
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-5 * float(expected.abs().max()))
    if simulator is WarpSimulation:
        again, module = dropped(simulator, heights, substeps=10)
        graphed = torch.cat([again.step_and_read()["s"].clone() for _ in range(8)], dim=1)
        torch.testing.assert_close(graphed, found, rtol=0, atol=1e-6 * float(expected.abs().max()))
        assert module.num_envs == 2


def _stepped(sim, touch):
    sim.step()
    return touch(sim.state())["s"].clone()


@pytest.mark.slow
def test_both_simulators_sound_alike(dropped):
    """The impulse of a drop is the momentum that it changes, whoever solves the contact: amplitudes within 3 %."""
    heights = np.array([0.004, 0.008])
    found = [loudest(*dropped(simulator, heights), 0.07)[0] for simulator in (BatchSimulation, WarpSimulation)]
    np.testing.assert_allclose(found[1], found[0], rtol=0.03)


def test_reset_of_one_environment_silences_it(dropped):
    """The other one rings on as it would have."""
    heights = np.array([0.003, 0.003])
    (sim, touch), (twin, other) = dropped(heights=heights), dropped(heights=heights)
    for _ in range(40):
        read, same = _stepped(sim, touch), _stepped(twin, other)
    assert read.abs().amax(dim=(1, 2, 3)).min() > 0
    sim.reset(env_ids=[0])
    read, same = _stepped(sim, touch), _stepped(twin, other)
    assert not read[0].any()
    torch.testing.assert_close(read[1], same[1], rtol=0, atol=0)
