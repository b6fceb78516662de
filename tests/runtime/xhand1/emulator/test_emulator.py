"""The emulated hand and its line against closed forms."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest
from faulty_lines import Faults, FaultyEmulator, FaultyLine
from first_order_hands import first_order_hand
from xhand1_hands import wait_until

from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import EmulatedHand, EmulatedLine, TipForces
from tgdsl.runtime.xhand1.wire.errors import HandError
from tgdsl.runtime.xhand1.wire.protocol import (
    PASSIVE,
    Command,
    Frame,
    FrameParser,
    HandState,
    JointCommand,
    Mode,
    decode_state,
    encode_command,
    encode_frame,
)

BAUD = 3_000_000
MOVING = tuple(JointCommand(0.1 * i, 100, 0, 0, 300, Mode.POSITION) for i in range(12))


def ask(hand: EmulatedHand, now: float, joints=PASSIVE) -> HandState:
    reply = hand.answer(Frame(0xFE, hand.address, Command.EXCHANGE, encode_command(joints)), now)
    assert reply is not None
    assert (reply.source, reply.destination, reply.command) == (hand.address, 0xFE, 2)
    return decode_state(reply.payload)


def test_joints_follow_first_order_and_stay_when_passive():
    hand = first_order_hand(time_constant_s=0.05)
    ask(hand, 10.0, MOVING)
    for after in (0.01, 0.05, 0.2):
        expected = 0.1 * np.arange(12) * (1 - math.exp(-after / 0.05))
        assert ask(hand, 10.0 + after, MOVING).position == pytest.approx(expected, abs=1e-6)
    position = hand.position
    ask(hand, 10.2, PASSIVE)
    assert ask(hand, 60.0, PASSIVE).position == pytest.approx(position, abs=1e-6)
    assert hand.is_passive


@pytest.mark.parametrize("lacking", [{"mode": Mode.PASSIVE}, {"kp": 0}, {"current_limit": 0}])
def test_a_joint_without_mode_gain_or_current_stays(lacking):
    hand = first_order_hand()
    joint = JointCommand(**({"position": 1.0, "kp": 100, "current_limit": 300, "mode": Mode.POSITION} | lacking))
    ask(hand, 1.0, [joint] * 12)
    assert (ask(hand, 2.0, [joint] * 12).position == 0).all()


def test_fingertip_forces_are_rounded_and_clipped_to_a_byte():
    def field(time_s, position):
        taxel = np.zeros((5, 120, 3))
        taxel[1, 7] = [-300, 300, -5]
        return TipForces(np.full((5, 3), time_s), taxel)

    state = ask(first_order_hand(forces=field), 12.4)
    assert (state.total_force == 12).all()
    assert state.taxel_force[1, 7].tolist() == [-128, 127, 0]
    assert np.count_nonzero(state.taxel_force) == 2


def test_unknown_commands_are_refused_and_other_addresses_ignored():
    hand = first_order_hand(2)
    assert hand.answer(Frame(0xFE, 0x80, Command.VERSION), 0.0) is None
    assert hand.answer(Frame(0xFE, 0x82, 0x14), 0.0) == Frame(0x82, 0xFE, 0, b"\x14")
    assert hand.answer(Frame(0xFE, 0x82, Command.EXCHANGE, b"short"), 0.0) == Frame(0x82, 0xFE, 0, b"\x02")
    assert hand.answer(Frame(0xFE, 0x82, Command.READ_REGISTER, b"\x35\x00"), 0.0) == Frame(0x82, 0xFE, 0x15, b"\x02")


def test_bytes_come_at_the_lines_rate_one_after_another():
    """As from a USB adapter: in chunks of 124 bytes across frames, and the rest at the end."""
    line, byte, both = EmulatedLine(first_order_hand()), 10 / BAUD, b"a" * 2217 + b"b" * 297
    line.send(both[:2217], 5.0)
    line.send(both[2217:], 5.001)
    received = b""
    for num_chunks in (1, 17, 18, 20):
        end = 5.0 + 124 * num_chunks * byte
        received += line.due(end - 1e-6)
        assert len(received) == 124 * (num_chunks - 1)
        received += line.due(end + 1e-9)
        assert received == both[: 124 * num_chunks]
    assert line.due(5.0 + 2514 * byte - 1e-6) == b""
    assert line.next_due() == pytest.approx(5.0 + 2514 * byte)
    assert line.due(10.0) == both[20 * 124 :]
    assert line.next_due() is None


def test_after_a_pause_the_line_restarts():
    line = EmulatedLine(first_order_hand())
    line.send(b"a" * 100, 5.0)
    line.send(b"b" * 100, 6.0)
    assert line.due(5.0 + 1001 / BAUD) == b"a" * 100
    assert line.due(6.0 + 999 / BAUD) == b""
    assert line.due(6.0 + 1001 / BAUD) == b"b" * 100


REPLY, OTHER = encode_frame(Frame(0x80, 0xFE, 2, bytes(50))), encode_frame(Frame(0x81, 0xFE, 2, bytes(50)))


@pytest.mark.parametrize(
    ("fault", "frames"),
    [("corrupt", 0), ("truncate", 0), ("drop", 0), ("delay", 1), ("duplicate", 2), ("noise", 1), ("foreign", 2)],
)
def test_each_fault_has_its_effect(fault, frames):
    line = FaultyLine(faults=Faults(**{fault: 1.0}), seed=1)
    line.reply(REPLY, OTHER, 0.0)
    early, late = line.due(0.039), line.due(1.0)
    assert (late if fault == "delay" else early) == early + late
    parser = FrameParser()
    parsed = parser.feed(early + late) + parser.flush()
    assert len(parsed) == frames
    assert [frame.source for frame in parsed] == ([0x81, 0x80] if fault == "foreign" else [0x80] * frames)
    assert line.counts[fault] == 1


def test_faults_have_their_rate_and_repeat_for_a_seed():
    lines = [FaultyLine(faults=Faults.each(0.05), seed=4) for _ in range(2)]
    for line in lines:
        for _ in range(4000):
            line.reply(REPLY, OTHER, 0.0)
    assert lines[0].due(1e9) == lines[1].due(1e9)
    spread = 5 * math.sqrt(4000 * 0.05 * 0.95)
    for name in ("corrupt", "delay", "drop", "duplicate", "foreign", "noise", "truncate"):
        assert abs(lines[0].counts[name] - 200) < spread
    assert "silence" not in lines[0].counts


def test_the_highest_rate_loses_nothing(capsys):
    """A short run of the benchmark; the jitter of readings depends on the machine and is printed."""
    soak = runpy.run_path(str(Path(__file__).parents[4] / "benchmarks" / "hand_soak.py"))["soak"]
    report = soak(5.0)
    assert (report.num_lost, report.num_lost_bytes) == (0, 0)
    counters = report.counters
    assert (counters.num_timeouts, counters.num_damaged, counters.num_unexpected, counters.num_discarded_bytes) == (0, 0, 0, 0)
    assert np.all(np.diff(report.received_at) > 0.97 * 2514 * 10 / BAUD)
    assert "lost: 0 exchanges, 0 bytes" in report.text()
    with capsys.disabled():
        print(f"\n{report.text()}")


def test_an_error_in_the_emulators_thread_is_raised_by_every_call(monkeypatch):
    """A bug in the force field removes the port; every later call raises the error."""

    def broken(time_s, position):
        raise ValueError("a mistake of ours")

    emulator = FaultyEmulator(first_order_hand(forces=broken))
    message = r"the emulator's thread ended: ValueError\('a mistake of ours'\)"
    with pytest.raises(HandError):
        XHand1.open(emulator.device)
    for call in (emulator.check, emulator.unplug, lambda: emulator.set_faults(Faults()), emulator.close):
        with pytest.raises(HandError, match=message) as caught:
            call()
        assert isinstance(caught.value.__cause__, ValueError)
    assert not Path(emulator.device).exists()
    emulator.close()


def test_a_bug_in_the_line_ends_the_thread_and_calls_raise_it(monkeypatch):
    emulator = FaultyEmulator()

    def broken(now):
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr(emulator.line, "due", broken)
    assert wait_until(lambda: emulator.failure is not None)
    for call in (lambda: emulator.set_faults(Faults()), emulator.close):
        with pytest.raises(HandError, match="the emulator's thread ended: RuntimeError"):
            call()


def test_an_error_of_a_call_is_raised_to_its_caller_and_the_hand_goes_on(monkeypatch):
    with FaultyEmulator() as emulator:
        emulator.unplug()
        with monkeypatch.context() as patched:
            patched.setattr("os.symlink", lambda *paths: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                emulator.replug()
        emulator.set_faults(Faults())
        emulator.check()
