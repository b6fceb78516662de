"""An emulated hand that no command may have moved, and serial ports that this computer seems to have."""

import pytest
from faulty_lines import FaultyEmulator
from first_order_hands import first_order_hand
from resting_hands import resting

from tgdsl.runtime.xhand1 import driver
from tgdsl.runtime.xhand1.wire import ports
from tgdsl.runtime.xhand1.wire.client import PortInfo, SerialTiming
from tgdsl.runtime.xhand1.wire.protocol import PASSIVE, Command, Register, encode_command

ALLOWED = {Command.VERSION, Command.READ_REGISTER, Command.EXCHANGE}


@pytest.fixture
def emulator():
    """A hand at rest; at the end, no request may have held a set-point that moves a joint."""
    registers = {Register.SERIAL_NUMBER: b"X1-0042" + bytes(25), Register.NAME: b"\xff\x00", Register.SIDE: b"\x01"}
    hand = first_order_hand(forces=resting)
    hand.registers = registers
    with FaultyEmulator(hand) as emulator:
        yield emulator
        assert {frame.command for _, frame in emulator.requests} <= ALLOWED
        assert {frame.payload for _, frame in emulator.requests if frame.command == Command.EXCHANGE} <= {
            encode_command(PASSIVE)
        }
        assert emulator.hand.is_passive
        assert not emulator.hand.position.any()


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Wait for replies as long as a busy computer may take: an emulated hand shares it with all other tests."""
    monkeypatch.setattr(driver, "SerialTiming", lambda: SerialTiming(reply_timeout_s=0.3))


@pytest.fixture
def plugged(monkeypatch):
    """Say which serial ports this computer has."""

    def plug(*devices: str) -> None:
        found = tuple(PortInfo(device, "an adapter" if i == 0 else "", "") for i, device in enumerate(devices))
        monkeypatch.setattr(ports, "list_ports", lambda: found)

    return plug


@pytest.fixture(autouse=True)
def checked_often(monkeypatch):
    """Look after each episode's length whether all have ended: those of the small task last 8 control steps."""
    monkeypatch.setattr("tgdsl.rl.playing.evaluation.CHECK_INTERVAL", 8)


@pytest.fixture
def no_pictures(monkeypatch):
    """Draw nothing: a picture takes a second."""
    for name in ("picture", "overview"):
        monkeypatch.setattr(f"tgdsl.view.{name}.{name}", lambda touch, sim, readings, file, **_: file)
