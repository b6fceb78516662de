"""Recorded hands as sources: the same samples as live, at the same times."""

import math
import time
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from faulty_lines import Faults, FaultyEmulator
from first_order_hands import first_order_hand
from hand_logs import assert_same_reading, random_readings, write_log

from tgdsl.errors import StateError, TgdslError
from tgdsl.runtime.connection import Source
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import TipForces
from tgdsl.runtime.xhand1.log.log import Fault, LogError, LogWriter
from tgdsl.runtime.xhand1.log.replay import ReplayOverError, ReplaySource
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.source import TIME_CONSTANT_S, HandSample, XHand1Source
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, HandError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.protocol import saturated

RNG = np.random.default_rng(5)
NEWTON = Calibration(
    "N", RNG.uniform(0.05, 0.2, (5, 3)), np.linalg.qr(RNG.normal(size=(5, 3, 3)))[0], RNG.normal(size=(5, 3)), np.ones((5, 3))
)
LIMITS = MotionLimits((0.0,) * 12, (1.0,) * 12, (10.0,) * 12, (300,) * 12, kp=100, watchdog_s=1.0)


def assert_same_sample(sample: HandSample, expected: HandSample) -> None:
    for field in fields(HandSample):
        a, b = getattr(sample, field.name), getattr(expected, field.name)
        if isinstance(b, torch.Tensor):
            assert a.dtype == b.dtype
            assert torch.equal(a, b), field.name
        elif field.name == "reading":
            assert_same_reading(a, b)
        else:
            assert a == b


def swelling(time_s, position):
    taxel = np.zeros((5, 120, 3))
    taxel[:, :, 2] = np.arange(120) + 200 * (position[0] > 0.2)
    return TipForces(400 * position[:5, None] * [0.1, -0.2, 1.0], taxel)


def run_live(path) -> list[HandSample | Fault]:
    """Let a hand move, saturate and fall silent for a while; log and return its samples and faults."""
    live: list[HandSample | Fault] = []
    with (
        FaultyEmulator(first_order_hand(forces=swelling, time_constant_s=0.1)) as emulator,
        XHand1.open(emulator.device, motion=LIMITS, timing=SerialTiming(reply_timeout_s=2.0, silence_s=1.0)) as hand,
        LogWriter(path, calibration=NEWTON) as log,
    ):
        source = XHand1Source(hand, control_step=0.02, calibration=NEWTON)
        live.append(source.sample())
        log.add(source.sample().reading)
        while sum(isinstance(event, HandSample) for event in live) < 50 or not any(isinstance(event, Fault) for event in live):
            if len(live) == 35:
                emulator.set_faults(Faults(silence=1.0))
            try:
                source.step(np.full(12, 0.9))
                live.append(source.sample())
                log.add(source.sample().reading)
            except HandError as error:
                live.append(Fault.of(error, time.monotonic()))
                log.add(live[-1])
                emulator.set_faults(Faults())
                hand.resume()
    return live


def test_a_replay_gives_the_live_samples(tmp_path):
    live = run_live(tmp_path / "a.npz")
    replayed: list[HandSample | Fault] = []
    with ReplaySource(tmp_path / "a.npz", speed=math.inf) as replay:
        replayed.append(replay.sample())
        while not replay.is_over:
            try:
                replay.step()
                replayed.append(replay.sample())
            except HandError as error:
                replayed.append(Fault.of(error, replay.now))
    for event, expected in zip(replayed, live, strict=True):
        if isinstance(expected, Fault):
            assert event == expected
        else:
            assert isinstance(event, HandSample)
            assert_same_sample(event, expected)
    samples = [sample for sample in live if isinstance(sample, HandSample)]
    assert max(float(sample.joint_vel.max()) for sample in samples) > 0.5
    assert samples[-1].is_tip_saturated.any() and not samples[0].is_tip_saturated.any()
    assert samples[-1].units == "N"


# which reading a step delivers


def sequences(path, **options) -> list[int | str]:
    """Return for each step of a replay the reading's number in the log, or the error's name."""
    source = ReplaySource(path, speed=math.inf, **options)
    steps: list[int | str] = [(source.sample().reading.sequence - 10) // 2]
    while not source.is_over:
        try:
            source.step()
            steps.append((source.sample().reading.sequence - 10) // 2)
        except HandError as error:
            steps.append(type(error).__name__)
    return steps


def test_without_a_control_step_each_step_is_a_reading_or_a_failure(tmp_path):
    faults = (Fault(1.15, "HandTimeoutError", "a"), Fault(1.16, "NewError", "b"), Fault(1.3, "HandError", "c"))
    path = write_log(tmp_path / "a.npz", random_readings(np.array([1.0, 1.1, 1.2])), faults)
    assert sequences(path) == [0, 1, "HandTimeoutError", "HandError", 2, "HandError"]


def test_a_step_delivers_the_newest_reading(tmp_path):
    # steps end at      1.00  1.02  1.04  1.06  1.08  1.10
    times = np.array([1.0, 1.009, 1.018, 1.027, 1.036, 1.045, 1.055, 1.061, 1.07, 1.08, 1.089])
    path = write_log(tmp_path / "a.npz", random_readings(times))
    assert sequences(path, control_step=0.02) == [0, 2, 4, 6, 9, 10]


def test_a_step_that_waits_for_a_reading_makes_the_next_late(tmp_path):
    # The step due at 1.02 waits for the reading at 1.075. So the next one, due at 1.04, is late: it starts at 1.075 and waits for
    # 1.08. The one after that ends at 1.095, 20 ms after 1.075.
    times = np.array([1.0, 1.075, 1.08, 1.09, 1.1, 1.11, 1.115])
    path = write_log(tmp_path / "a.npz", random_readings(times))
    source = ReplaySource(path, control_step=0.02, speed=math.inf)
    steps = []
    while not source.is_over:
        source.step()
        steps.append(((source.sample().reading.sequence - 10) // 2, round(source.now, 6), source.num_late_steps))
    assert steps == [(1, 1.075, 0), (2, 1.08, 1), (3, 1.095, 1), (6, 1.115, 1)]


def test_a_gap_raises_the_recorded_errors(tmp_path):
    """As in a recording, failures are noticed 80 ms after the last reading, and every 80 ms from then on."""
    times = np.array([1.0, 1.01, 1.02, 1.5, 1.51, 1.52])
    faults = tuple(Fault(1.1 + 0.08 * i, "HandTimeoutError" if i < 3 else "HandDisconnectedError", str(i)) for i in range(5))
    path = write_log(tmp_path / "a.npz", random_readings(times), faults)
    source = ReplaySource(path, control_step=0.02, speed=math.inf)
    steps = []
    while not source.is_over:
        try:
            source.step()
            steps.append((source.sample().reading.sequence - 10) // 2)
        except HandError as error:
            steps.append((type(error), str(error), round(source.now, 6)))
    assert steps == [
        2,
        (HandTimeoutError, "0", 1.12),  # due at 1.04, given up 80 ms later
        (HandTimeoutError, "1", 1.2),
        (HandTimeoutError, "2", 1.28),
        (HandDisconnectedError, "3", 1.36),
        (HandDisconnectedError, "4", 1.44),
        3,  # due at 1.44, came at 1.5
        4,
        5,
    ]


def test_a_gap_without_a_recorded_failure_is_a_timeout(tmp_path):
    path = write_log(tmp_path / "a.npz", random_readings(np.array([1.0, 1.01, 2.0])))
    source = ReplaySource(path, control_step=0.02, speed=math.inf)
    source.step()
    with pytest.raises(HandTimeoutError, match=r"no new reading came in time; the newest is 118 ms old"):
        source.step()  # due at 1.04, given up at 1.12; the newest was requested at 1.002


def expected_steps(times, faults, control_step: float) -> list[int | str]:
    """Return what a live source would have delivered, by checking every instant at which something arrives."""
    now = due = times[0]
    delivered, steps = 0, [0]
    while now < max(times[-1], *(fault.time for fault in faults)):
        due += control_step
        if due < now:
            due = now
        for instant in [due, *(t for t in times if due < t <= due + 0.08)]:
            arrived = [i for i, t in enumerate(times) if t <= instant]
            if arrived[-1] > delivered and instant - (times[arrived[-1]] - 0.008) <= 0.1:
                delivered, now = arrived[-1], instant
                steps.append(delivered)
                break
        else:
            now = due + 0.08
            last = max(t for t in times if t <= now)
            after = [fault for fault in faults if last < fault.time <= now]
            steps.append(after[-1].kind if after else "HandTimeoutError")
    return steps


@pytest.mark.parametrize("seed", range(20))
def test_a_replay_matches_a_source_that_checks_every_instant(tmp_path, seed):
    rng = np.random.default_rng(seed)
    gaps = np.where(rng.random(120) < 0.08, rng.uniform(0.05, 0.4, 120), rng.uniform(0.0084, 0.02, 120))
    times = (5.0 + np.cumsum(gaps)).tolist()
    faults = []
    for earlier, later in pairwise(times):
        faults += [
            Fault(t, "HandTimeoutError", "") for t in np.arange(earlier + 0.08, later, 0.08).tolist() if rng.random() < 0.9
        ]
    path = write_log(tmp_path / "a.npz", random_readings(np.array(times)), tuple(faults))
    for control_step in (0.005, 0.02, 0.05, 0.3):
        assert sequences(path, control_step=control_step) == expected_steps(times, faults, control_step)


# time


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self):
        self.now, self.naps = 500.0, []

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.naps.append(seconds)
        self.now += seconds


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_a_replay_has_the_original_timing_or_a_multiple(tmp_path, speed):
    times = np.array([1.0, 1.01, 1.03, 1.06])
    path = write_log(tmp_path / "a.npz", random_readings(times))
    clock = Clock()
    source = ReplaySource(path, speed=speed, clock=lambda: clock.now, sleep=clock.sleep)
    for expected in (0.01, 0.03, 0.06):
        source.step()
        assert clock.now == pytest.approx(500 + expected / speed)
        assert source.now == pytest.approx(1 + expected)
    assert source.sample().reading.age_s(source.now) == pytest.approx(0.008)


def test_a_slow_caller_misses_readings_as_it_would_live(tmp_path):
    times = 1.0 + 0.01 * np.arange(100)
    path = write_log(tmp_path / "a.npz", random_readings(times))
    clock = Clock()
    source = ReplaySource(path, control_step=0.02, clock=lambda: clock.now, sleep=clock.sleep)
    source.step()
    assert clock.now == pytest.approx(500.02)
    clock.now += 0.105
    source.step()
    assert source.sample().reading.received_at == pytest.approx(1.12)
    assert source.num_late_steps == 1
    source.step()
    assert clock.now == pytest.approx(500.145)
    assert source.sample().reading.received_at == pytest.approx(1.14)
    assert source.num_late_steps == 1


def test_an_infinite_speed_never_sleeps(tmp_path):
    path = write_log(tmp_path / "a.npz", random_readings(1.0 + 0.01 * np.arange(50)))
    naps: list[float] = []
    source = ReplaySource(path, control_step=0.02, speed=math.inf, clock=lambda: 0.0, sleep=naps.append)
    while not source.is_over:
        source.step()
    assert naps == []
    assert source.sample().reading.received_at == pytest.approx(1.49)


# the rest of a source


def test_a_step_after_the_end_raises(tmp_path):
    path = write_log(tmp_path / "a.npz", random_readings(np.array([1.0, 1.01])))
    source = ReplaySource(path, speed=math.inf)
    source.step()
    last = source.sample()
    assert source.is_over
    for _ in range(2):
        with pytest.raises(ReplayOverError, match=r"a\.npz: the log is over, 0\.010 s after its first reading"):
            source.step()
    assert source.sample() is last


def test_rewind_starts_again(tmp_path):
    path = write_log(tmp_path / "a.npz", random_readings(1.0 + 0.01 * np.arange(6)))
    source = ReplaySource(path, speed=math.inf)
    first, samples = source.sample(), []
    for _ in range(5):
        source.step()
        samples.append(source.sample())
    source.rewind()
    assert_same_sample(source.sample(), first)
    assert not source.is_over
    for expected in samples[:3]:
        source.step()
        assert_same_sample(source.sample(), expected)
    source.close()
    assert source.is_over


def test_reset_zeroes_velocities_and_continues(tmp_path):
    path = write_log(tmp_path / "a.npz", random_readings(1.0 + 0.01 * np.arange(12)))
    source = ReplaySource(path, speed=math.inf)
    source.step()
    assert source.sample().joint_vel.any()
    source.reset()
    assert source.sample().reading.received_at == 1.02
    assert not source.sample().joint_vel.any()
    # With a control step, now is 1.02. The reading that arrived then was requested at 1.012, too early; the next, at 1.022.
    source = ReplaySource(path, speed=math.inf, control_step=0.02)
    source.step()
    source.reset()
    assert source.sample().reading.received_at == 1.03
    assert not source.sample().joint_vel.any()
    source.step()
    assert source.sample().reading.received_at == 1.04  # 20 ms after the reset
    while not source.is_over:
        source.step()
    with pytest.raises(ReplayOverError):
        source.reset()


def test_reset_in_a_gap_raises_the_recorded_error(tmp_path):
    faults = (Fault(1.09, "HandTimeoutError", "silent"),)
    path = write_log(tmp_path / "a.npz", random_readings(np.array([1.0, 1.01, 1.2])), faults)
    source = ReplaySource(path, speed=math.inf, control_step=0.01)
    source.step()
    with pytest.raises(HandTimeoutError, match="silent"):
        source.reset()
    assert source.now == pytest.approx(1.09)


def test_a_sample_matches_the_logged_state(tmp_path):
    readings = random_readings(np.array([1.0, 1.01]))
    source: Source = ReplaySource(write_log(tmp_path / "a.npz", readings), speed=math.inf)
    assert isinstance(source, ReplaySource)
    source.step(np.full(99, 7.0))
    sample, before, state = source.sample(), readings[0].state, readings[1].state
    assert (source.num_envs, source.control_step, sample.units) == (1, pytest.approx(0.01), "counts")
    assert sample.joint_pos.numpy()[0].tobytes() == state.position.tobytes()
    elapsed = readings[1].requested_at - readings[0].requested_at
    speed = (1.0 - np.exp(-elapsed / TIME_CONSTANT_S)) * (state.position.astype(np.float64) - before.position) / elapsed
    assert sample.joint_vel.numpy()[0] == pytest.approx(speed, rel=1e-6)
    assert (sample.tip_force.numpy()[0] == state.total_force).all()
    assert (sample.taxel_counts.numpy()[0] == state.taxel_force).all()
    assert (sample.is_taxel_saturated.numpy()[0] == saturated(state.taxel_force).any(axis=-1)).all()
    assert (sample.joint_temperature.numpy()[0] == state.joint_temperature % 256).all()
    with pytest.raises(StateError, match="the log of an XHand1 cannot give the poses and contacts of a SceneState"):
        source.state()


def test_a_calibration_overrides_the_logs(tmp_path):
    readings = random_readings(np.array([1.0]))
    path = write_log(tmp_path / "a.npz", readings, calibration=NEWTON)
    other = replace(NEWTON, scale=2 * NEWTON.scale)
    for calibration in (None, other):
        sample = ReplaySource(path, calibration=calibration).sample()
        expected = (calibration or NEWTON).apply(readings[0].state.total_force)
        assert sample.tip_force.numpy()[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"speed": math.nan}, {"control_step": 0.0}, {"control_step": math.inf}])
def test_invalid_speeds_and_control_steps_are_refused(tmp_path, options):
    ((name, value),) = options.items()
    message = f"^{name} is {value:g}( s)?, expected more than 0"
    path = write_log(tmp_path / "a.npz", random_readings(np.array([1.0])))
    with pytest.raises(TgdslError, match=message):
        ReplaySource(path, **options)


def test_a_missing_log_is_an_error(tmp_path):
    with pytest.raises(LogError, match="No such file"):
        ReplaySource(tmp_path / "none.npz")
