"""The driver against an emulated hand on a pseudo-terminal, in real time."""

import contextlib
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from xhand1_hands import PATIENT, Stamps, Wait, WrittenBytes, read_again, wait_until

from tgdsl.runtime.xhand1 import payloads, serial_port
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulated_hand import EmulatedHand, TipForces
from tgdsl.runtime.xhand1.emulator import Emulator
from tgdsl.runtime.xhand1.errors import (
    HandChecksumError,
    HandClosedError,
    HandDisconnectedError,
    HandError,
    HandRefusedError,
    HandTimeoutError,
    MotionError,
    StaleReadingError,
)
from tgdsl.runtime.xhand1.faulty_line import Faults
from tgdsl.runtime.xhand1.find import find_hands
from tgdsl.runtime.xhand1.link import LinkTiming
from tgdsl.runtime.xhand1.protocol import Frame, Register, encode_frame
from tgdsl.runtime.xhand1.replies import Addresses

READ = encode_frame(Frame(0xFE, 0x80, 2, payloads.encode_command(payloads.PASSIVE)))
VERSION = bytes.fromhex("55aafe80130000efc3")
CALM = LinkTiming(reply_timeout_s=0.5, silence_s=0.4)
LIMIT_S = 0.1
"""Within this a reading or a named error must come [s]."""


def test_every_reading_is_new_and_knows_its_age():
    stamps = Stamps()
    with (
        Emulator(EmulatedHand(forces=stamps)) as emulator,
        XHand1.open(emulator.device, timing=PATIENT, max_age_s=20.0) as hand,
    ):
        readings = [hand.read(20.0) for _ in range(60)]
    assert np.all(np.diff([reading.sequence for reading in readings]) > 0)
    assert np.all(np.diff([stamps.check(reading) for reading in readings]) > 0)


def test_reading_writes_the_passive_and_the_version_request_and_nothing_else():
    """Every byte, over failures of all kinds, a pulled cable and the end."""
    written, stamps = WrittenBytes(), Stamps()
    with Emulator(EmulatedHand(forces=stamps), faults=Faults.each(0.1)) as emulator:
        with XHand1.open(emulator.device, open_port=written.open) as hand:
            while len(written.writes) < 100:
                with contextlib.suppress(HandError):
                    stamps.check(hand.read())
            emulator.unplug()
            assert wait_until(lambda: isinstance(failure_of(hand), HandDisconnectedError))
            emulator.replug()
            read_again(hand)
            with pytest.raises(MotionError, match="opened for reading alone"):
                hand.command(np.zeros(12))
            with pytest.raises(MotionError, match="opened for reading alone"):
                hand.command(np.full(12, 0.5))
        assert emulator.hand.is_passive
        assert (emulator.hand.position == 0).all()
    assert len(written.writes) > 100
    assert set(written.writes) == {READ, VERSION}
    for joint in payloads.decode_command(READ[7:-2]):
        assert (joint.mode, joint.kp, joint.ki, joint.kd, joint.current_limit) == (0, 0, 0, 0, 0)


def test_registers_version_and_tare_write_no_set_point_either():
    written = WrittenBytes()
    with (
        Emulator(EmulatedHand(forces=Stamps())) as emulator,
        XHand1.open(emulator.device, timing=CALM, max_age_s=20.0, open_port=written.open) as hand,
    ):
        assert hand.version() == b"tgdsl emulator"
        assert hand.read_register(Register.NAME) == b"emulated"
        with pytest.raises(HandRefusedError, match="the hand refused command 0x15"):
            hand.read_register(999)
        tare = hand.tare(5)
        assert tare.mean.tolist() == [[7, -3, 40]] * 5
        assert (tare.spread == 0).all()
        assert tare.num_frames == 5
        with pytest.raises(HandError, match="a tare over 4 frames, expected at least 5"):
            hand.tare(4)
    assert {data for data in written.writes if data[4] == 2} == {READ}
    assert {data[4] for data in written.writes} == {0x02, 0x13, 0x15}


def test_a_saturated_fingertip_cannot_be_tared():
    def pressed(time_s, position):
        return TipForces(np.full((5, 3), 300.0), np.zeros((5, 120, 3)))

    with (
        Emulator(EmulatedHand(forces=pressed)) as emulator,
        XHand1.open(emulator.device, timing=PATIENT, max_age_s=20.0) as hand,
    ):
        assert hand.read().state.total_force.tolist() == [[127, 127, 255]] * 5
        with pytest.raises(HandError, match="at the end of its range"):
            hand.tare()


FAULTS = ["corrupt", "truncate", "drop", "delay", "duplicate", "noise", "foreign", "silence"]


def failure_of(hand: XHand1) -> HandError | None:
    """Return what a read says now, if it fails."""
    try:
        hand.read()
    except HandError as error:
        return error
    return None


def read_until(hand: XHand1, stamps: Stamps, is_enough) -> tuple[list, list[HandError]]:
    """Read until it is enough; calls must end in time, 97 in 100 at least, each in a new reading or a named error."""
    readings, errors, waits = [], [], []
    deadline = time.monotonic() + 60
    while not is_enough(readings) and time.monotonic() < deadline:
        with Wait() as wait:
            try:
                readings.append(hand.read())
            except HandError as error:
                errors.append(error)
        waits.append(wait.seconds)
    assert np.quantile(waits, 0.97) < LIMIT_S
    assert HandError not in map(type, errors)
    assert np.all(np.diff([reading.sequence for reading in readings]) > 0)
    assert np.all(np.diff([stamps.check(reading) for reading in readings]) > 0)
    return readings, errors


@pytest.mark.parametrize("fault", FAULTS)
def test_one_reply_in_twenty_is_faulty(fault):
    stamps = Stamps()
    with Emulator(EmulatedHand(forces=stamps), seed=3) as emulator, XHand1.open(emulator.device) as hand:
        emulator.set_faults(Faults(**{fault: 0.05}))
        readings, _ = read_until(hand, stamps, lambda found: len(found) > 80 and emulator.fault_counts()[fault] > 1)
        assert emulator.fault_counts()[fault] > 1
    assert len(readings) > 80


@pytest.mark.parametrize("fault", FAULTS)
def test_every_reply_is_faulty(fault):
    """A reading or a named error comes in time whatever the line does, call after call."""
    waits = []
    with Emulator(EmulatedHand(forces=Stamps()), seed=3) as emulator, XHand1.open(emulator.device) as hand:
        emulator.set_faults(Faults(**{fault: 1.0}))
        for _ in range(15):
            with Wait() as wait, contextlib.suppress(HandError):
                hand.read()
            waits.append(wait.seconds)
    assert np.median(waits) < LIMIT_S


def test_all_faults_at_once():
    stamps = Stamps()
    with Emulator(EmulatedHand(forces=stamps), seed=5) as emulator, XHand1.open(emulator.device) as hand:
        emulator.set_faults(Faults.each(0.05))
        readings, _ = read_until(hand, stamps, lambda found: len(found) > 80)
    assert len(readings) > 80


def test_a_silent_device_is_named_at_once_and_again():
    stamps = Stamps()
    with Emulator(EmulatedHand(forces=stamps)) as emulator:
        with XHand1.open(emulator.device) as hand:
            hand.read()
            emulator.set_faults(Faults(silence=1.0))
            assert wait_until(lambda: isinstance(failure_of(hand), HandTimeoutError))
            waits = []
            for _ in range(5):
                with Wait() as wait, pytest.raises(HandTimeoutError, match="no reply to command"):
                    hand.read()
                waits.append(wait.seconds)
            assert np.median(waits) < LIMIT_S
            emulator.set_faults(Faults())
            stamps.check(read_again(hand))
        emulator.set_faults(Faults(silence=1.0))
        with pytest.raises(HandTimeoutError, match="no reply to command 0x02"):
            XHand1.open(emulator.device)


def test_a_line_that_damages_everything():
    timing = LinkTiming(reply_timeout_s=5.0, silence_s=0.5)
    with Emulator(faults=Faults(corrupt=1.0)) as emulator, pytest.raises(HandChecksumError, match="came damaged"):
        XHand1.open(emulator.device, timing=timing)


def test_unplug_and_replug():
    stamps = Stamps()
    with Emulator(EmulatedHand(forces=stamps)) as emulator, XHand1.open(emulator.device) as hand:
        waits = []
        for _ in range(3):
            emulator.unplug()
            assert wait_until(lambda: isinstance(failure_of(hand), HandDisconnectedError))
            with Wait() as wait, pytest.raises(HandDisconnectedError):
                hand.read()
            waits.append(wait.seconds)
            emulator.replug()
            stamps.check(read_again(hand))
        assert min(waits) < LIMIT_S
        assert hand.num_reconnects == 3


def test_a_reading_that_nobody_fetched_grows_stale():
    """What was new once is not handed out later as if it were."""
    with Emulator() as emulator, XHand1.open(emulator.device) as hand:
        assert wait_until(lambda: hand.counters.num_replies > 3)
        emulator.set_faults(Faults(silence=1.0))
        time.sleep(0.2)
        with pytest.raises(HandTimeoutError):
            hand.read()


def test_a_slow_line_is_stale_by_name():
    timing = LinkTiming(reply_timeout_s=5.0)
    with Emulator(turnaround_s=0.3) as emulator, XHand1.open(emulator.device, timing=timing, max_age_s=5.0) as hand:
        hand.read(timeout_s=5.0)
        with pytest.raises(StaleReadingError, match=r"no new reading came in time; the newest is \d+ ms old"):
            hand.read(timeout_s=0.001)


def test_the_wrong_hand():
    with Emulator(EmulatedHand(3)) as emulator:
        with pytest.raises(HandTimeoutError):
            XHand1.open(emulator.device)
        with XHand1.open(emulator.device, Addresses(3), timing=PATIENT) as hand:
            hand.read(20.0)
        found = find_hands(emulator.device, timing=LinkTiming(reply_timeout_s=0.2))
    assert [(hand.addresses, hand.version) for hand in found] == [(Addresses(3, 0x83, 0xFE), b"tgdsl emulator")]


def test_a_closed_hand_says_so():
    with Emulator() as emulator:
        hand = XHand1.open(emulator.device)
        hand.close()
        hand.close()
        for call in (hand.read, hand.version, lambda: hand.command(np.zeros(12))):
            with pytest.raises(HandClosedError, match="this hand was closed"):
                call()


def test_a_port_that_is_not_there_or_taken():
    with pytest.raises(HandDisconnectedError, match="/dev/no-such-port cannot be opened at 3000000 baud"):
        XHand1.open("/dev/no-such-port")
    with Emulator() as emulator, XHand1.open(emulator.device), pytest.raises(HandDisconnectedError, match="cannot be opened"):
        XHand1.open(emulator.device)


def test_without_pyserial_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(HandError, match=r'needs pyserial, which is not installed: pip install "tgdsl\[hardware\]"'):
        XHand1.open("/dev/ttyUSB0")


def test_ports_are_listed():
    assert all(isinstance(port, serial_port.PortInfo) for port in serial_port.list_ports())


def test_only_one_file_knows_pyserial_and_only_in_a_function():
    folder = Path(serial_port.__file__).parents[2]
    found = {file.name for file in folder.rglob("*.py") if "import serial" in file.read_text(encoding="utf-8")}
    assert found == {"serial_port.py"}
    assert "\nimport serial" not in Path(serial_port.__file__).read_text(encoding="utf-8")
