"""The driver against an emulated hand on a pseudo-terminal, in real time."""

import contextlib
import sys
from pathlib import Path

import numpy as np
import pytest
from faulty_lines import Faults, FaultyEmulator
from first_order_hands import first_order_hand
from xhand1_hands import PATIENT, Stamps, WrittenBytes, open_again, read_again, wait_until

from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import TipForces
from tgdsl.runtime.xhand1.wire import client, protocol
from tgdsl.runtime.xhand1.wire.client import Addresses, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import (
    HandClosedError,
    HandDisconnectedError,
    HandError,
    HandTimeoutError,
    MotionError,
)
from tgdsl.runtime.xhand1.wire.ports import find_hands, identify
from tgdsl.runtime.xhand1.wire.protocol import Frame, encode_frame

READ = encode_frame(Frame(0xFE, 0x80, 2, protocol.encode_command(protocol.PASSIVE)))
VERSION = bytes.fromhex("55aafe80130000efc3")
CALM = SerialTiming(reply_timeout_s=0.5, silence_s=0.4)
BRISK = SerialTiming(reply_timeout_s=0.2, silence_s=0.1)


def test_every_reading_is_new_and_has_its_age():
    stamps = Stamps()
    with (
        FaultyEmulator(first_order_hand(forces=stamps)) as emulator,
        XHand1.open(emulator.device, timing=PATIENT, max_age_s=20.0) as hand,
    ):
        readings = [hand.read(20.0) for _ in range(60)]
    assert np.all(np.diff([reading.sequence for reading in readings]) > 0)
    assert np.all(np.diff([stamps.check(reading) for reading in readings]) > 0)


def test_reading_writes_only_passive_and_version_requests():
    """Every byte is checked, through faults of all kinds, an unplugged cable and the end."""
    written, stamps = WrittenBytes(), Stamps()
    with FaultyEmulator(first_order_hand(forces=stamps), faults=Faults.each(0.1)) as emulator:
        with open_again(emulator.device, timing=BRISK, open_port=written.open) as hand:
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
    for joint in protocol.decode_command(READ[7:-2]):
        assert (joint.mode, joint.kp, joint.ki, joint.kd, joint.current_limit) == (0, 0, 0, 0, 0)


def test_identity_and_tare_write_no_set_point():
    written = WrittenBytes()
    with FaultyEmulator(first_order_hand(forces=Stamps())) as emulator:
        (device,) = find_hands(emulator.device, (0,), timing=PATIENT, open_port=written.open)
        identity = identify(device, timing=PATIENT, open_port=written.open)
        assert (identity.version, identity.name, identity.side) == (b"tgdsl emulator", b"emulated", None)
        hand = XHand1.open(emulator.device, timing=PATIENT, open_port=written.open)
        tare = hand.tare(5)
        assert tare.mean.tolist() == [[7, -3, 40]] * 5
        assert (tare.spread == 0).all()
        assert tare.num_frames == 5
        with pytest.raises(HandError, match="a tare over 4 frames, expected at least 5"):
            hand.tare(4)
        hand.close()
    assert {data for data in written.writes if data[4] == 2} == {READ}
    assert {data[4] for data in written.writes} == {0x02, 0x13, 0x15}


def test_a_saturated_fingertip_cannot_be_tared():
    def pressed(time_s, position):
        return TipForces(np.full((5, 3), 300.0), np.zeros((5, 120, 3)))

    with (
        FaultyEmulator(first_order_hand(forces=pressed)) as emulator,
        XHand1.open(emulator.device, timing=PATIENT, max_age_s=20.0) as hand,
    ):
        assert hand.read().state.total_force.tolist() == [[127, 127, 255]] * 5
        with pytest.raises(HandError, match="at the end of its range"):
            hand.tare()


def failure_of(hand: XHand1) -> HandError | None:
    """Return the error of a read, if it fails."""
    try:
        hand.read()
    except HandError as error:
        return error
    return None


def test_under_all_faults_readings_stay_new_and_errors_named():
    stamps, readings, errors = Stamps(), [], []
    with FaultyEmulator(first_order_hand(forces=stamps), seed=5) as emulator, open_again(emulator.device, timing=CALM) as hand:
        emulator.set_faults(Faults.each(0.05))

        def is_read() -> bool:
            try:
                readings.append(hand.read())
            except HandError as error:
                errors.append(error)
            return len(readings) > 60

        assert wait_until(is_read)
    assert HandError not in map(type, errors)
    assert np.all(np.diff([reading.sequence for reading in readings]) > 0)
    assert np.all(np.diff([stamps.check(reading) for reading in readings]) > 0)


def test_a_silent_device_is_named():
    stamps = Stamps()
    with FaultyEmulator(first_order_hand(forces=stamps)) as emulator:
        with open_again(emulator.device, timing=CALM) as hand:
            emulator.set_faults(Faults(silence=1.0))
            assert wait_until(lambda: isinstance(failure_of(hand), HandTimeoutError))
            with pytest.raises(HandTimeoutError, match="no reply to command"):
                hand.read()
            emulator.set_faults(Faults())
            stamps.check(read_again(hand))
        emulator.set_faults(Faults(silence=1.0))
        assert wait_until(lambda: "no reply to command 0x02" in refusal(emulator.device))


def refusal(device: str) -> str:
    """Return why a hand cannot be opened."""
    with pytest.raises(HandTimeoutError) as caught:
        XHand1.open(device)
    return str(caught.value)


def test_a_line_that_damages_everything_is_an_error():
    timing = SerialTiming(reply_timeout_s=1.0, silence_s=0.1)
    with FaultyEmulator(faults=Faults(corrupt=1.0)) as emulator, pytest.raises(HandTimeoutError, match="came damaged"):
        XHand1.open(emulator.device, timing=timing)


def test_a_replugged_hand_reconnects():
    stamps = Stamps()
    with FaultyEmulator(first_order_hand(forces=stamps)) as emulator, open_again(emulator.device, timing=CALM) as hand:
        for _ in range(3):
            emulator.unplug()
            assert wait_until(lambda: isinstance(failure_of(hand), HandDisconnectedError))
            with pytest.raises(HandDisconnectedError):
                hand.read()
            emulator.replug()
            stamps.check(read_again(hand))
        assert hand.num_reconnects == 3


def test_a_hand_with_another_id_does_not_answer():
    with FaultyEmulator(first_order_hand(3)) as emulator:
        with pytest.raises(HandTimeoutError):
            XHand1.open(emulator.device)
        with XHand1.open(emulator.device, Addresses(3), timing=PATIENT) as hand:
            hand.read(20.0)
        hands = find_hands(emulator.device, (1, 3), timing=SerialTiming(reply_timeout_s=2.0, silence_s=1.0))
    assert [(hand.addresses, hand.version) for hand in hands] == [(Addresses(3, 0x83, 0xFE), b"tgdsl emulator")]


def test_a_closed_hand_raises():
    with FaultyEmulator() as emulator:
        hand = XHand1.open(emulator.device, timing=PATIENT)
        hand.close()
        hand.close()
        for call in (hand.read, lambda: hand.command(np.zeros(12))):
            with pytest.raises(HandClosedError, match="this hand was closed"):
                call()


def test_a_missing_or_busy_port_is_an_error():
    with pytest.raises(HandDisconnectedError, match="/dev/no-such-port cannot be opened at 3000000 baud"):
        XHand1.open("/dev/no-such-port")
    taken = pytest.raises(HandDisconnectedError, match="cannot be opened")
    with FaultyEmulator() as emulator, XHand1.open(emulator.device, timing=PATIENT), taken:
        XHand1.open(emulator.device)


def test_without_pyserial_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(HandError, match=r'needs pyserial, which is not installed: pip install "tgdsl\[hardware\]"'):
        XHand1.open("/dev/ttyUSB0")


def test_ports_are_listed():
    assert all(isinstance(port, client.PortInfo) for port in client.list_ports())


def test_only_one_file_imports_pyserial_and_only_in_a_function():
    folder = Path(client.__file__).parents[2]
    names = {file.name for file in folder.rglob("*.py") if "import serial" in file.read_text(encoding="utf-8")}
    assert names == {"client.py"}
    assert "\nimport serial" not in Path(client.__file__).read_text(encoding="utf-8")
