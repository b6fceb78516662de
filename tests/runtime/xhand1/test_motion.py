"""Motion limits: set-points against the limits, and an emulated hand that must become passive."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest
from faulty_lines import Faults, FaultyEmulator
from first_order_hands import first_order_hand
from hypothesis import given, settings
from hypothesis import strategies as st
from xhand1_hands import PATIENT, Stamps, WrittenBytes, drive_until, open_again, wait_until

from tgdsl.files.find import robot_names
from tgdsl.runtime.xhand1 import driver
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.motion import Motion, MotionLimits, joint_ids
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandDisconnectedError, HandError, MotionError, WatchdogError
from tgdsl.runtime.xhand1.wire.protocol import JOINTS, PASSIVE, Frame, Mode, encode_command, encode_frame

RANGES = [
    (0, 1.832), (-0.698, 1.57), (0, 1.57), (-0.174, 0.174), (0, 1.919), (0, 1.919),
    (0, 1.919), (0, 1.919), (0, 1.919), (0, 1.919), (0, 1.919), (0, 1.919),
]  # fmt: skip
"""The vendor's joint ranges by joint id [rad]."""
LOWER, UPPER = (tuple(float(pair[i]) for pair in RANGES) for i in (0, 1))
MODE_POSITION = b"\x03\x00"
REST = np.array([0.5, 0.2, 0.3, 0.0] + [0.6] * 8)
ZERO = np.zeros(12)


CALM = SerialTiming(reply_timeout_s=0.5, silence_s=0.4)
"""The longest timing that still notices a failed line before the watchdog does, after 1 s."""


def limits(speed: float = 1.0, watchdog_s: float = 0.1) -> MotionLimits:
    return MotionLimits(LOWER, UPPER, (speed,) * 12, (300,) * 12, kp=100, kd=5, watchdog_s=watchdog_s)


def positions(motion: Motion, now: float) -> np.ndarray:
    return np.array([joint.position for joint in motion.joints(now)])


@pytest.mark.parametrize("name", ["xhand1_right", "xhand1_left"])
def test_ranges_come_from_the_robot_file(name):
    model = mujoco.MjModel.from_xml_path(str(robot_names()[name]))
    assert np.abs(model.jnt_range[joint_ids(model)]) == pytest.approx(np.abs(np.array(RANGES)), abs=1e-9)
    motion_limits = MotionLimits.of_robot(model, speed=0.5, current_limit=200, kp=80)
    assert [motion_limits.lower, motion_limits.upper] == [tuple(model.jnt_range[joint_ids(model)][:, i]) for i in (0, 1)]
    assert (motion_limits.speed, motion_limits.current_limit, motion_limits.watchdog_s) == ((0.5,) * 12, (200,) * 12, 0.1)


def test_a_robot_without_the_hands_joints_is_refused():
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(MotionError, match="is a whole hand: expected one joint with a range for each of thumb_bend_joint, "):
        model.jnt_range[joint_ids(model)]
    finger = "".join(f'<body><joint name="{name}" range="0 90"/><geom size=".1"/></body>' for name in JOINTS[1:])
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{finger}</worldbody></mujoco>")
    with pytest.raises(MotionError, match=f"for each of {JOINTS[0]}; the robot has {JOINTS[1]}, "):
        model.jnt_range[joint_ids(model)]


def test_a_set_point_starts_at_the_joint_and_moves_at_the_speed_limit():
    motion, target = Motion(limits(speed=0.5)), np.clip(REST + 0.1, LOWER, UPPER)
    assert motion.joints(9.0) == PASSIVE
    motion.command(target, 10.0, REST)
    for step in range(30):
        now = 10.0 + 0.01 * step
        motion.command(target, now, REST)
        travelled = np.minimum(0.5 * 0.01 * step, target - REST)
        assert positions(motion, now) == pytest.approx(REST + travelled, abs=1e-9)
    joint = motion.joints(10.3)[4]
    assert (joint.mode, joint.kp, joint.ki, joint.kd, joint.current_limit) == (Mode.POSITION, 100, 0, 5, 300)


TARGETS = st.lists(st.floats(0, 1), min_size=12, max_size=12).map(
    lambda part: np.array(LOWER) + part * np.subtract(UPPER, LOWER)
)


@given(st.lists(st.tuples(TARGETS, st.floats(0, 0.09)), min_size=1, max_size=20), TARGETS, st.floats(0.01, 20))
@settings(max_examples=200, deadline=None)
def test_no_set_point_moves_faster_or_further_than_its_limits(commands, start, speed):
    motion, now, last = Motion(limits(speed)), 5.0, start
    for target, elapsed in commands:
        motion.command(target, now, start)
        now += elapsed
        set_points = positions(motion, now)
        assert (np.abs(set_points - last) <= speed * min(elapsed, 0.05) + 1e-12).all()
        assert (set_points >= np.minimum(LOWER, start)).all()
        assert (set_points <= np.maximum(UPPER, start)).all()
        last = set_points


def test_the_watchdog_stops_and_only_resume_starts_again():
    motion = Motion(limits())
    motion.command(REST, 1.0, REST)
    assert motion.joints(1.0999) is not PASSIVE
    assert motion.joints(1.1001) is PASSIVE
    with pytest.raises(WatchdogError, match=r"is passive: no command came for 100 ms, expected one every 100 ms; call resume"):
        motion.command(REST, 1.2, REST)
    assert motion.joints(1.2) is PASSIVE
    motion.resume()
    assert motion.joints(1.3) is PASSIVE
    motion.command(REST, 1.4, ZERO)
    assert positions(motion, 1.4) == pytest.approx(ZERO)


def test_a_late_command_is_refused_before_the_next_exchange():
    motion = Motion(limits())
    motion.command(REST, 1.0, REST)
    with pytest.raises(WatchdogError):
        motion.command(REST, 1.2, REST)
    assert motion.joints(1.2) is PASSIVE


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (1.95, "index_joint1: target 1.95 rad, expected 0 to 1.919"),
        (-0.01, "index_joint1: target -0.01 rad, expected 0 to 1.919"),
        (float("nan"), "index_joint1: target nan rad, expected 0 to 1.919"),
        (float("inf"), "index_joint1: target inf rad, expected 0 to 1.919"),
    ],
)
def test_a_target_outside_its_range_stops_the_hand(value, message):
    motion, target = Motion(limits()), REST.copy()
    motion.command(target, 1.0, REST)
    target[4] = value
    with pytest.raises(MotionError, match=message):
        motion.command(target, 1.01, REST)
    assert motion.joints(1.02) is PASSIVE
    with pytest.raises(MotionError, match="the hand is passive"):
        motion.command(REST, 1.03, REST)


def test_without_a_reading_nothing_moves():
    motion = Motion(limits())
    with pytest.raises(MotionError, match="where the joints are is not known"):
        motion.command(REST, 1.0, None)
    assert motion.joints(1.0) is PASSIVE


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"lower": LOWER[:11]}, "lower is .*, expected 12 finite numbers"),
        ({"upper": (float("inf"),) * 12}, "upper is .*, expected 12 finite numbers"),
        ({"upper": LOWER}, "thumb_bend_joint: the range is 0 to 0 rad, expected lower < upper"),
        ({"speed": (0.0,) * 12}, "thumb_bend_joint: speed 0 rad/s, current 300 mA; expected more than 0"),
        ({"current_limit": (70000,) * 12}, "thumb_bend_joint: speed 1 rad/s, current 70000 mA"),
        ({"watchdog_s": 2.0}, "watchdog_s is 2, expected more than 0 and at most 1 s"),
    ],
)
def test_invalid_limits_are_refused(wrong, message):
    good = {"lower": LOWER, "upper": UPPER, "speed": (1.0,) * 12, "current_limit": (300,) * 12, "kp": 1}
    with pytest.raises(MotionError, match=message):
        MotionLimits(**(good | wrong))


def test_motion_limits_without_commands_move_nothing():
    written = WrittenBytes()
    with (
        FaultyEmulator() as emulator,
        XHand1.open(emulator.device, timing=PATIENT, motion=limits(), open_port=written.open) as hand,
    ):
        for _ in range(10):
            hand.read()
    passive = encode_frame(Frame(0xFE, 0x80, 2, encode_command(PASSIVE)))
    assert set(written.writes) == {passive, bytes.fromhex("55aafe80130000efc3")}


def drive(hand: XHand1, emulator: FaultyEmulator) -> None:
    """Command until a request drives the hand."""
    before = len(drive_times(emulator))
    drive_until(hand, REST, lambda: len(drive_times(emulator)) > before)


def drive_times(emulator: FaultyEmulator) -> list[float]:
    """Return the times of requests that drive the hand [s]."""
    return [at for at, frame in list(emulator.requests) if frame.payload[14:16] == MODE_POSITION]


def becomes_passive(emulator: FaultyEmulator) -> bool:
    """Wait until the last request is passive and the hand is too: requests are recorded before they act."""

    def is_passive() -> bool:
        last = list(emulator.requests)[-1][1]
        return last.payload[14:16] != MODE_POSITION and emulator.hand.is_passive

    return wait_until(is_passive)


def test_an_emulated_hand_reaches_its_target_and_close_makes_it_passive():
    with FaultyEmulator(first_order_hand(time_constant_s=0.02)) as emulator:
        with XHand1.open(emulator.device, timing=PATIENT, motion=limits(speed=5.0, watchdog_s=1.0)) as hand:
            assert emulator.hand.is_passive
            drive_until(hand, REST, lambda: abs(emulator.hand.position - REST).max() < 0.01)
        assert emulator.hand.is_passive


def test_a_policy_that_stalls_leaves_the_hand_passive():
    with FaultyEmulator() as emulator, XHand1.open(emulator.device, timing=PATIENT, motion=limits()) as hand:
        for _ in range(3):
            drive(hand, emulator)
            assert becomes_passive(emulator)
            with pytest.raises(WatchdogError):
                hand.command(REST)
            held = emulator.hand.position
            hand.read()
            assert (emulator.hand.position == held).all()
            hand.resume()
            hand.read()
            assert emulator.hand.is_passive


@pytest.mark.parametrize("faults", [Faults(corrupt=1.0), Faults(drop=1.0), Faults(truncate=1.0)])
def test_a_failed_line_leaves_the_hand_passive(faults):
    """On a busy machine the watchdog may come first; `test_virtual.py` tests the failure in virtual time."""
    with FaultyEmulator() as emulator, open_again(emulator.device, timing=CALM, motion=limits(watchdog_s=1.0)) as hand:
        drive(hand, emulator)
        emulator.set_faults(faults)
        assert becomes_passive(emulator)
        assert wait_until(lambda: hand.stopped is not None)
        with pytest.raises(HandError, match="the hand is passive"):
            hand.command(REST)
        emulator.set_faults(Faults())


def test_a_hand_unplugged_in_motion_is_passive_when_replugged():
    stamps = Stamps()
    with (
        FaultyEmulator(first_order_hand(forces=stamps)) as emulator,
        XHand1.open(emulator.device, timing=PATIENT, motion=limits(watchdog_s=1.0)) as hand,
    ):
        drive(hand, emulator)
        emulator.unplug()
        assert wait_until(lambda: hand.stopped is not None)
        with pytest.raises((HandDisconnectedError, WatchdogError), match="the hand is passive"):
            hand.command(REST)
        emulator.replug()
        assert becomes_passive(emulator)
        stamps.check(hand.read())


def test_a_target_outside_its_range_leaves_the_hand_passive():
    with FaultyEmulator() as emulator, XHand1.open(emulator.device, timing=PATIENT, motion=limits(watchdog_s=1.0)) as hand:
        for wrong in (np.full(12, 5.0), np.zeros(3)):
            drive(hand, emulator)
            hand.relax()
            with pytest.raises(MotionError, match=r"thumb_bend_joint: target 5 rad|shape \(3,\), expected \(12,\)"):
                hand.command(wrong)
            assert becomes_passive(emulator)
            hand.resume()


def test_a_bug_in_the_reader_leaves_the_hand_passive(monkeypatch):
    def broken(payload):
        raise ValueError("a mistake of ours")

    with FaultyEmulator() as emulator, XHand1.open(emulator.device, timing=PATIENT, motion=limits(watchdog_s=1.0)) as hand:
        drive(hand, emulator)
        monkeypatch.setattr(driver, "decode_state", broken)
        assert becomes_passive(emulator)
        hand._reader.join()
        for call in (lambda: hand.command(REST), hand.read):
            with pytest.raises(HandClosedError, match=r"the reader ended: ValueError\('a mistake of ours'\)"):
                call()


SCRIPT = """
import sys, time
import numpy as np
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.wire.errors import WatchdogError
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.motion import MotionLimits
patient = SerialTiming(reply_timeout_s=5.0, silence_s=2.0)
limits = MotionLimits((0.0,) * 12, (1.0,) * 12, (1.0,) * 12, (300,) * 12, kp=100, watchdog_s=1.0)
hand = XHand1.open(sys.argv[1], motion=limits, timing=patient)
while not hand._reader._is_driven:
    try:
        hand.command(np.full(12, 0.5))
    except WatchdogError:
        hand.resume()
    time.sleep(0.002)
raise RuntimeError("a policy that fails")
"""


def test_a_crashing_program_leaves_the_hand_passive():
    with FaultyEmulator() as emulator:
        run = subprocess.run([sys.executable, "-c", SCRIPT, emulator.device], capture_output=True, text=True)
        assert "a policy that fails" in run.stderr
        assert drive_times(emulator)
        assert becomes_passive(emulator)
