"""Which serial ports there are, which hands answer on them, and what these say of themselves.

Only versions and registers are asked for: no request holds a set-point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from tgdsl.runtime.xhand1.wire.client import Addresses, Port, PortInfo, SerialClient, SerialPort, SerialTiming, list_ports
from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, HandError, HandRefusedError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.protocol import Command, Register, encode_register_request

_OpenPort = Callable[[str, int], Port]  # opens a port, given its name and baud rate
_PATIENT = SerialTiming(reply_timeout_s=0.1)
"""A late reply would count for the next id, so a busy computer gets more time."""
_MORE_PATIENT = SerialTiming(reply_timeout_s=0.4)


class FoundHand(NamedTuple):
    """A hand that answered."""

    device: str  # its serial port
    addresses: Addresses  # its id, and the addresses that its reply had
    version: bytes  # what the reply held, as it came


def find_hands(
    device: str, hand_ids: Iterable[int], *, timing: SerialTiming, open_port: _OpenPort = SerialPort
) -> tuple[FoundHand, ...]:
    """Request the version of each id on a port and return the hands that answer."""
    client = SerialClient(open_port(device, timing.baud), None, timing)
    results = []
    try:
        for hand_id in hand_ids:
            try:
                reply = client.exchange(Command.VERSION, hand_id=hand_id)
            except HandTimeoutError:
                continue
            results.append(FoundHand(device, Addresses(hand_id, reply.source, reply.destination), reply.payload))
    finally:
        client.close()
    return tuple(results)


class AskedPort(NamedTuple):
    """A serial port that was asked for hands."""

    port: PortInfo
    hands: tuple[FoundHand, ...]  # that answered
    trouble: str = ""  # why it could not be asked, or empty

    def __str__(self) -> str:
        name = f"{self.port.device} ({self.port.description})" if self.port.description else self.port.device
        return name + (f": {self.trouble}" if self.trouble else "" if self.hands else ": no hand answers")


def ask_ports(device: str | None, hand_id: int | None) -> tuple[AskedPort, ...]:
    """Ask all serial ports, or one, for all hands, or one: a version request per id, which holds no set-point."""
    ids, timing = (range(8), _PATIENT) if hand_id is None else ((hand_id,), _MORE_PATIENT)
    ports = {port.device: port for port in list_ports()}
    if device is not None:
        return (AskedPort(ports.get(device, PortInfo(device, "", "")), find_hands(device, ids, timing=timing)),)
    results = []
    for name, port in ports.items():
        try:
            results.append(AskedPort(port, find_hands(name, ids, timing=timing)))
        except HandError as error:
            results.append(AskedPort(port, (), str(error)))
    return tuple(results)


def the_hand(device: str | None = None, hand_id: int | None = None) -> FoundHand:
    """Return the only hand there is, or that on a port, or with an id.

    Raises:
        HandError: If there is none or more than one; it lists the ports, or the hands.
        HandDisconnectedError: If the port that was named cannot be opened.
    """
    ports = ask_ports(device, hand_id)
    hands = [hand for port in ports for hand in port.hands]
    if len(hands) == 1:
        return hands[0]
    if hands:
        candidates = ", ".join(f"{hand.device} (id {hand.addresses.hand_id})" for hand in hands)
        raise HandError(f"{len(hands)} hands answer: {candidates}; choose one with --port or --hand-id")
    problem = "no hand answers" if hand_id is None else f"no hand with id {hand_id} answers"
    if device is not None:
        raise HandDisconnectedError(f"{problem} on {device}; is it switched on, and is this its port?")
    raise HandDisconnectedError(f"{problem}; {'; '.join(map(str, ports)) or 'this computer has no serial port'}")


@dataclass(frozen=True)
class HandIdentity:
    """What a hand says about itself; bytes as they came, for the layout of these replies is unverified."""

    device: str  # the serial port that it answers on
    hand_id: int
    version: bytes = b""  # empty if it was not asked
    side: bytes | None = None  # register 20, which hand it is; None if it does not tell
    serial_number: bytes | None = None  # register 21; None if it does not tell
    name: bytes | None = None  # register 54; None if it does not tell

    def as_json(self) -> dict[str, Any]:
        """Return it for a log, bytes as hexadecimal text."""
        return {name: value.hex() if isinstance(value, bytes) else value for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> HandIdentity:
        """Return the identity that `as_json` has written."""
        names = ("version", "side", "serial_number", "name")
        as_bytes: dict[str, Any] = {name: None if values[name] is None else bytes.fromhex(values[name]) for name in names}
        return cls(str(values["device"]), int(values["hand_id"]), **as_bytes)

    def __str__(self) -> str:
        values = {"version": self.version, "side": self.side, "serial number": self.serial_number, "name": self.name}
        return f"{self.device}: hand {self.hand_id}, " + ", ".join(
            f"{label} {_as_text(value)}" for label, value in values.items()
        )


def identify(hand: FoundHand, *, timing: SerialTiming | None = None, open_port: _OpenPort = SerialPort) -> HandIdentity:
    """Read the registers of a hand from `find_hands`."""
    timing = timing or SerialTiming()
    client = SerialClient(open_port(hand.device, timing.baud), hand.addresses, timing)

    def register(number: int) -> bytes | None:
        try:
            return client.exchange(Command.READ_REGISTER, encode_register_request(number)).payload
        except (HandRefusedError, HandTimeoutError):
            return None

    try:
        registers = [register(number) for number in (Register.SIDE, Register.SERIAL_NUMBER, Register.NAME)]
    finally:
        client.close()
    return HandIdentity(hand.device, hand.addresses.hand_id, hand.version, *registers)


def _as_text(value: bytes | None) -> str:
    """Return a reply's payload as quoted text if it is printable, without zero padding; else as hexadecimal bytes."""
    if value is None:
        return "not told"
    text = value.rstrip(b"\0")
    if text and text.isascii() and text.decode().isprintable():
        return f'"{text.decode()}"'
    return value.hex(" ") or "empty"
