"""Which hand it is, in its own words. Versions and registers are asked for; no request holds a set-point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from tgdsl.runtime.xhand1.wire.client import SerialClient, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandRefusedError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.payloads import encode_register_request
from tgdsl.runtime.xhand1.wire.ports import FoundHand
from tgdsl.runtime.xhand1.wire.protocol import Command, Register
from tgdsl.runtime.xhand1.wire.serial_port import Port, open_serial_port

UNTOLD = "not told"
_BYTES = ("version", "side", "serial_number", "name")


@dataclass(frozen=True)
class HandIdentity:
    """What a hand tells of itself; bytes as they came, for the layout of these replies is unverified.

    Attributes:
        device: The serial port that it was found on.
        hand_id: Its id.
        version: Its version; empty if it was not asked.
        side: Register 20, which hand it is; None if it does not tell.
        serial_number: Register 21; None if it does not tell.
        name: Register 54; None if it does not tell.
    """

    device: str
    hand_id: int
    version: bytes = b""
    side: bytes | None = None
    serial_number: bytes | None = None
    name: bytes | None = None

    def as_json(self) -> dict[str, Any]:
        """Return it for a log, bytes as hexadecimal text."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value.hex() if isinstance(value, bytes) else value for name, value in values.items()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> HandIdentity:
        """Return the identity that `as_json` has written."""
        as_bytes = {name: None if values[name] is None else bytes.fromhex(values[name]) for name in _BYTES}
        return cls(str(values["device"]), int(values["hand_id"]), **as_bytes)  # type: ignore[arg-type]

    def __str__(self) -> str:
        values = {"version": self.version, "side": self.side, "serial number": self.serial_number, "name": self.name}
        return f"{self.device}: hand {self.hand_id}, " + ", ".join(f"{label} {shown(value)}" for label, value in values.items())


def identify(
    hand: FoundHand, *, timing: SerialTiming | None = None, open_port: Callable[[str, int], Port] = open_serial_port
) -> HandIdentity:
    """Ask a hand that was found for its registers.

    Raises:
        HandDisconnectedError: If the port cannot be opened, or went away.
    """
    timing = timing or SerialTiming()
    client = SerialClient(open_port(hand.device, timing.baud), hand.addresses, timing)
    try:
        registers = [_register(client, number) for number in (Register.SIDE, Register.SERIAL_NUMBER, Register.NAME)]
    finally:
        client.close()
    return HandIdentity(hand.device, hand.addresses.hand_id, hand.version, *registers)


def shown(value: bytes | None) -> str:
    """Return what a reply held as text if it is text, padded with zeros or not; else as hexadecimal bytes."""
    if value is None:
        return UNTOLD
    text = value.rstrip(b"\0")
    if text and text.isascii() and text.decode().isprintable():
        return f'"{text.decode()}"'
    return value.hex(" ") or "empty"


def _register(client: SerialClient, number: int) -> bytes | None:
    """Return what a register holds; None if the hand refuses to tell, or does not answer."""
    try:
        return client.exchange(Command.READ_REGISTER, encode_register_request(number)).payload
    except (HandRefusedError, HandTimeoutError):
        return None
