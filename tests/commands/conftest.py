"""An emulated hand that no command may move, and fake serial ports."""

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
    """Yield a hand at rest; at the end, require that no request would have moved a joint."""
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
    """Wait longer for replies: the emulated hand shares a busy computer with other tests."""
    monkeypatch.setattr(driver, "SerialTiming", lambda: SerialTiming(reply_timeout_s=0.3))


@pytest.fixture
def plugged(monkeypatch):
    """Return a function that sets the serial ports of this computer."""

    def plug(*devices: str) -> None:
        port_infos = tuple(PortInfo(device, "an adapter" if i == 0 else "", "") for i, device in enumerate(devices))
        monkeypatch.setattr(ports, "list_ports", lambda: port_infos)

    return plug


@pytest.fixture(autouse=True)
def checked_often(monkeypatch):
    """Check for the end of evaluation every 8 control steps, an episode of the small task."""
    monkeypatch.setattr("tgdsl.rl.playing.evaluation.CHECK_INTERVAL", 8)


@pytest.fixture
def no_pictures(monkeypatch):
    """Draw nothing: a picture takes a second."""
    for name in ("picture", "overview"):
        monkeypatch.setattr(f"tgdsl.view.{name}.{name}", lambda touch, sim, readings, file, **_: file)
