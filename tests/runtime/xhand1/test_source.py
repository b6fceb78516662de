"""The hand as a source: the velocity filter against closed forms, samples, and timing of steps."""

import time

import numpy as np
import pytest
import torch
from first_order_hands import first_order_hand
from virtual_hands import virtual_hand
from xhand1_hands import PATIENT, wait_until

from tgdsl.errors import StateError
from tgdsl.runtime.connection import Source
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Emulator, TipForces
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.source import VelocityFilter, XHand1Source
from tgdsl.runtime.xhand1.wire.errors import HandError, MotionError, WatchdogError

CALM = {"timing": PATIENT, "max_age_s": 20.0}
TIPS = np.array([[10, -20, 30], [1, 2, 3], [0, 0, 127], [127, 0, 0], [0, 0, 255]])


def pressed(time_s, position):
    return TipForces(TIPS.astype(np.float64), np.ones((5, 120, 3)))


def test_the_filter_of_a_steady_motion_has_a_closed_form():
    velocity_filter = VelocityFilter(0.05)
    for n in range(40):
        speed = velocity_filter.update(100 + 0.01 * n, np.array([0.3 * 0.01 * n, -2 * 0.01 * n]))
        assert speed == pytest.approx(np.array([0.3, -2]) * (1 - np.exp(-0.01 * n / 0.05)), abs=1e-9)


def test_the_filter_takes_uneven_times_into_account():
    velocity_filter, times = VelocityFilter(0.05), np.cumsum(np.random.default_rng(0).uniform(0.001, 0.01, 30))
    filtered = [velocity_filter.update(now, np.array([1.5 * now]))[0] for now in times]
    assert filtered == pytest.approx(1.5 * (1 - np.exp(-(times - times[0]) / 0.05)), abs=1e-9)


def test_the_filter_damps_and_delays_a_sine_to_first_order():
    omega, tau, times = 20.0, 0.03, np.arange(0, 2, 1e-4)
    velocity_filter = VelocityFilter(tau)
    filtered = np.array([velocity_filter.update(t, np.array([np.sin(omega * t)]))[0] for t in times])
    gain, lag = 1 / np.hypot(1, omega * tau), np.arctan(omega * tau)
    expected = omega * gain * np.cos(omega * times - lag)
    assert filtered[times > 1] == pytest.approx(expected[times > 1], abs=2e-3 * omega)


def test_the_filter_starts_at_rest_and_a_time_that_is_not_later_changes_nothing():
    velocity_filter = VelocityFilter(1e-3)  # e⁻⁵⁰⁰ of a difference is left
    assert velocity_filter.update(1.0, np.array([5.0])) == [0.0]
    assert velocity_filter.update(1.5, np.array([6.0])) == [2.0]
    assert velocity_filter.update(1.5, np.array([9.0])) == [2.0]
    assert velocity_filter.update(2.0, np.array([6.0])) == [0.0]
    velocity_filter.reset()
    assert velocity_filter.update(0.0, np.array([1.0])) == [0.0]


def test_a_sample_has_calibrated_forces_and_saturation():
    newton = Calibration("N", np.full((5, 3), 0.1), np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), np.zeros((5, 3)))
    with Emulator(first_order_hand(forces=pressed)) as emulator, XHand1.open(emulator.device, **CALM) as hand:
        source: Source = XHand1Source(hand, control_step=0.02, calibration=newton, read_timeout_s=20.0)
        assert isinstance(source, XHand1Source)
        source.step()
        sample = source.sample()
        with pytest.raises(StateError, match="cannot give the poses and contacts of a SceneState; its sample"):
            source.state()
    assert (sample.units, source.num_envs) == ("N", 1)
    assert sample.tip_force.numpy() == pytest.approx(0.1 * TIPS[None], abs=1e-6)
    assert sample.is_tip_saturated.tolist() == [[False, False, False, True, True]]
    assert (sample.taxel_counts == 1).all()
    assert (sample.joint_temperature == 25).all()
    assert not sample.joint_error.any()


def test_steps_keep_their_period_and_late_ones_are_counted(monkeypatch):
    with virtual_hand(monkeypatch) as (hand, _, clock):
        start, ends = clock.now, []
        source = XHand1Source(hand, control_step=0.04)
        for work in (0.0, 0.03, 0.01, 0.0399, 0.1, 0.0, 0.2, 0.0):
            clock.sleep(work)
            source._wait()
            ends.append(clock.now - start)
        assert ends == pytest.approx([0.04, 0.08, 0.12, 0.16, 0.26, 0.3, 0.5, 0.54])
        assert source.num_late_steps == 2
        clock.sleep(1.0)
        source.reset()
        source._wait()
        assert (clock.now - start, source.num_late_steps) == (pytest.approx(1.58), 2)


def test_each_step_waits_for_a_new_reading():
    with Emulator() as emulator, XHand1.open(emulator.device, **CALM) as hand:
        start, sequences = time.monotonic(), []
        source = XHand1Source(hand, control_step=0.04, read_timeout_s=20.0)
        for _ in range(5):
            source.step()
            sequences.append(source.sample().reading.sequence)
        assert time.monotonic() - start >= 5 * 0.04 - 0.001
        assert np.all(np.diff(sequences) > 0)
        before = time.monotonic()
        source.reset()
        assert source.sample().reading.requested_at >= before
        assert (source.sample().joint_vel == 0).all()
        with pytest.raises(MotionError, match="opened for reading alone"):
            source.step(np.zeros(12))
        with pytest.raises(HandError, match="a control step of -1 s, expected a finite time above 0"):
            XHand1Source(hand, control_step=-1.0)


def test_controls_are_joint_angles():
    limits = MotionLimits((0.0,) * 12, (1.0,) * 12, (10.0,) * 12, (300,) * 12, kp=100, watchdog_s=1.0)
    with (
        Emulator(first_order_hand(time_constant_s=0.01)) as emulator,
        XHand1.open(emulator.device, motion=limits, **CALM) as hand,
    ):
        with pytest.raises(MotionError, match="a control step of 1000 ms, and the watchdog bites after 1000 ms"):
            XHand1Source(hand, control_step=1.0)
        source = XHand1Source(hand, control_step=0.02, read_timeout_s=20.0)
        target = torch.linspace(0, 1, 12)

        def is_there() -> bool:
            try:
                source.step(target[None])
                source.step()
            except WatchdogError:  # the machine was too busy
                hand.resume()
                return False
            return abs(source.sample().joint_pos[0] - target).max() < 0.01

        assert wait_until(is_there)
        source.reset()
        source.step()
        assert emulator.hand.is_passive
        assert hand.stopped is None
