"""The driver's time limits, in virtual time: each holds for every call, however busy the machine is."""

import contextlib

import numpy as np
import pytest
from faulty_lines import Faults
from first_order_hands import first_order_hand
from virtual_hands import VirtualPort, VirtualTime, virtual_hand
from xhand1_hands import Stamps

from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.errors import (
    HandDisconnectedError,
    HandError,
    HandTimeoutError,
    MotionError,
    WatchdogError,
)

FAULTS = ["corrupt", "truncate", "drop", "delay", "duplicate", "noise", "foreign", "silence"]
EXCHANGE_S = 2514 * 10 / 3e6
LIMIT_S = 0.1
"""Longest time until a reading or a named error [s]."""
MODE_POSITION = b"\x03\x00"
REST = np.array([0.5, 0.2, 0.3, 0.0] + [0.6] * 8)


def limits(speed: float = 5.0, watchdog_s: float = 0.1) -> MotionLimits:
    return MotionLimits((-0.5,) * 12, (1.5,) * 12, (speed,) * 12, (300,) * 12, kp=100, kd=5, watchdog_s=watchdog_s)


def read_for(hand: XHand1, time: VirtualTime, stamps: Stamps, num_calls: int) -> tuple[list, list[HandError]]:
    """Read repeatedly; every call must end in time with a new reading or a named error."""
    readings, errors, fresh = [], [], []
    for _ in range(num_calls):
        start = time.now
        try:
            readings.append(hand.read())
            fresh.append(stamps.check(readings[-1], time.now))
            assert readings[-1].age_s(time.now) <= LIMIT_S
        except HandError as error:
            errors.append(error)
        assert time.now - start < LIMIT_S
    assert HandError not in map(type, errors)
    assert np.all(np.diff([reading.sequence for reading in readings]) > 0)
    assert np.all(np.diff(fresh) > 0)
    return readings, errors


def failure_of(hand: XHand1) -> HandError | None:
    """Return the error of a read, if it fails."""
    try:
        hand.read()
    except HandError as error:
        return error
    return None


def drive(hand: XHand1, time: VirtualTime, seconds: float = 0.1) -> None:
    for _ in range(round(seconds / 0.005)):
        hand.command(REST)
        time.sleep(0.005)


def drive_times(port: VirtualPort) -> list[float]:
    """Return the times of requests that drive the hand [s]."""
    return [at for at, data in port.writes if data[21:23] == MODE_POSITION]


def test_readings_come_as_fast_as_the_line_carries_them(monkeypatch):
    stamps = Stamps()
    with virtual_hand(monkeypatch, first_order_hand(forces=stamps)) as (hand, _, time):
        readings, errors = read_for(hand, time, stamps, 100)
    periods = np.diff([reading.received_at for reading in readings])
    assert errors == [] and (periods >= EXCHANGE_S).all() and (periods < EXCHANGE_S + 0.002).all()
    assert max(reading.received_at - reading.requested_at for reading in readings) < EXCHANGE_S + 0.002


@pytest.mark.parametrize("fault", FAULTS)
def test_reads_survive_one_faulty_reply_in_twenty(fault, monkeypatch):
    stamps = Stamps()
    with virtual_hand(monkeypatch, first_order_hand(forces=stamps), seed=3) as (hand, port, time):
        hand.read()
        port.set_faults(Faults(**{fault: 0.05}))
        readings, _ = read_for(hand, time, stamps, 400)
        assert port.line.counts[fault] > 7
    assert len(readings) > 330


@pytest.mark.parametrize("fault", FAULTS)
def test_reads_end_in_time_when_every_reply_is_faulty(fault, monkeypatch):
    with virtual_hand(monkeypatch, first_order_hand(forces=Stamps()), seed=3) as (hand, port, time):
        hand.read()
        port.set_faults(Faults(**{fault: 1.0}))
        for _ in range(60):
            start, failure = time.now, failure_of(hand)
            assert time.now - start < LIMIT_S
            assert type(failure) is not HandError


def test_reads_survive_half_a_minute_of_all_faults(monkeypatch):
    stamps = Stamps()
    with virtual_hand(monkeypatch, first_order_hand(forces=stamps), seed=7) as (hand, port, time):
        hand.read()
        port.set_faults(Faults.each(0.05))
        start = time.now
        while time.now < start + 30:
            readings, errors = read_for(hand, time, stamps, 500)
            assert len(readings) > 300 and errors


def test_every_read_of_a_silent_device_raises_in_time(monkeypatch):
    stamps = Stamps()
    with virtual_hand(monkeypatch, first_order_hand(forces=stamps)) as (hand, port, time):
        hand.read()
        port.set_faults(Faults(silence=1.0))
        with contextlib.suppress(HandError):  # the exchange in progress
            hand.read()
        for _ in range(5):
            start = time.now
            with pytest.raises(HandTimeoutError, match="no reply to command"):
                hand.read()
            assert time.now - start < LIMIT_S
        port.set_faults(Faults())
        stamps.check(hand.read(1.0), time.now)


def test_an_unplugged_hand_raises_in_time_and_reconnects(monkeypatch):
    stamps = Stamps()
    with virtual_hand(monkeypatch, first_order_hand(forces=stamps)) as (hand, port, time):
        for i in range(3):
            hand.read()
            port.unplug()
            for _ in range(3):
                start = time.now
                with pytest.raises(HandDisconnectedError):
                    hand.read()
                assert time.now - start < LIMIT_S
            port.replug()
            stamps.check(hand.read(1.0), time.now)
            assert hand.num_reconnects == i + 1


def test_a_slow_line_is_a_timeout_with_the_readings_age(monkeypatch):
    with virtual_hand(monkeypatch, timing=SerialTiming(reply_timeout_s=5.0), turnaround_s=0.3) as (hand, _, time):
        hand.read()
        with pytest.raises(HandTimeoutError, match="no new reading came in time; the newest is 310 ms old"):
            hand.read(0.001)
        start = time.now
        hand.read()
        assert time.now - start == pytest.approx(0.3 + EXCHANGE_S, abs=0.005)


def test_an_unfetched_reading_becomes_stale(monkeypatch):
    with virtual_hand(monkeypatch) as (hand, port, time):
        time.sleep(0.05)
        port.set_faults(Faults(silence=1.0))
        time.sleep(0.2)
        with pytest.raises(HandTimeoutError):
            hand.read()


def test_a_call_waits_as_long_as_two_replies_may_take(monkeypatch):
    """A reading may be as old: a longer reply timeout also makes callers wait longer."""
    with virtual_hand(monkeypatch, timing=SerialTiming(reply_timeout_s=0.5), turnaround_s=0.4) as (hand, _, time):
        hand.read()
        for _ in range(3):
            assert hand.read().age_s(time.now) == pytest.approx(0.4 + EXCHANGE_S, abs=0.005)


def test_a_hand_reaches_its_target_and_close_makes_it_passive(monkeypatch):
    emulated = first_order_hand(time_constant_s=0.02)
    with virtual_hand(monkeypatch, emulated, motion=limits()) as (hand, _, time):
        hand.read()
        assert emulated.is_passive
        drive(hand, time, 0.5)
        assert not emulated.is_passive and hand.stopped is None
        assert emulated.position == pytest.approx(REST, abs=1e-3)
    assert emulated.is_passive


def test_a_policy_that_stalls_leaves_the_hand_passive(monkeypatch):
    """Requests drive the hand for the watchdog's time after the last command, less one exchange at most."""
    emulated = first_order_hand()
    with virtual_hand(monkeypatch, emulated, motion=limits()) as (hand, port, time):
        hand.read()
        for _ in range(3):
            commanded_at = time.now
            hand.command(REST)
            time.sleep(0.5)
            assert emulated.is_passive
            assert 0.1 - EXCHANGE_S - 0.002 < drive_times(port)[-1] - commanded_at <= 0.1
            with pytest.raises(WatchdogError):
                hand.command(REST)
            position = emulated.position
            time.sleep(0.1)
            assert (emulated.position == position).all()
            hand.resume()
            time.sleep(0.1)
            assert emulated.is_passive


@pytest.mark.parametrize(
    ("faults", "error"),
    [
        (Faults(corrupt=1.0), HandTimeoutError),
        (Faults(drop=1.0), HandTimeoutError),
        (Faults(truncate=1.0), HandError),
        (Faults(silence=1.0), HandTimeoutError),
    ],
)
def test_a_failed_line_leaves_the_hand_passive(monkeypatch, faults, error):
    emulated = first_order_hand()
    with virtual_hand(monkeypatch, emulated, motion=limits(watchdog_s=1.0)) as (hand, port, time):
        hand.read()
        drive(hand, time)
        assert not emulated.is_passive
        port.set_faults(faults)
        time.sleep(LIMIT_S)
        assert drive_times(port)[-1] < time.now - 0.03
        assert emulated.is_passive or faults.silence
        with pytest.raises(error, match="the hand is passive"):
            hand.command(REST)
        port.set_faults(Faults())
        time.sleep(LIMIT_S)
        assert emulated.is_passive


def test_a_hand_unplugged_in_motion_is_passive_when_replugged(monkeypatch):
    stamps = Stamps()
    emulated = first_order_hand(forces=stamps)
    with virtual_hand(monkeypatch, emulated, motion=limits(watchdog_s=1.0)) as (hand, port, time):
        hand.read()
        drive(hand, time)
        port.unplug()
        time.sleep(0.05)
        with pytest.raises(HandDisconnectedError, match="the hand is passive"):
            hand.command(REST)
        assert not emulated.is_passive
        port.replug()
        time.sleep(0.1)
        assert emulated.is_passive
        stamps.check(hand.read(), time.now)


def test_a_target_outside_its_range_leaves_the_hand_passive(monkeypatch):
    emulated = first_order_hand()
    with virtual_hand(monkeypatch, emulated, motion=limits()) as (hand, _, time):
        hand.read()
        for wrong, message in ((np.full(12, 5.0), "thumb_bend_joint: target 5 rad"), (np.zeros(3), r"shape \(3,\), expected")):
            drive(hand, time)
            assert not emulated.is_passive
            with pytest.raises(MotionError, match=message):
                hand.command(wrong)
            time.sleep(0.03)
            assert emulated.is_passive
            hand.resume()


def test_close_raises_if_the_hand_may_still_be_driven(monkeypatch):
    def close_in_silence():
        with virtual_hand(monkeypatch, motion=limits()) as (hand, port, time):
            hand.read()
            drive(hand, time)
            port.set_faults(Faults(silence=1.0))

    with pytest.raises(HandError, match="the hand did not confirm that it is passive: switch its power off"):
        close_in_silence()
