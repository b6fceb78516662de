"""Which serial ports there are, which hands answer on them, and the one that is meant.

Only version requests are sent, which hold no set-point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tgdsl.runtime.xhand1.wire.client import Addresses, SerialClient, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, HandError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.protocol import Command
from tgdsl.runtime.xhand1.wire.serial_port import Port, PortInfo, list_ports, open_serial_port

_ALL_IDS = tuple(range(8))
_PATIENT = SerialTiming(reply_timeout_s=0.1)
"""A reply that comes later is taken for that of the next id which is asked, so a busy computer is given time."""
_MORE_PATIENT = SerialTiming(reply_timeout_s=0.4)


@dataclass(frozen=True)
class FoundHand:
    """A hand that answered.

    Attributes:
        device: Its serial port.
        addresses: Its id, and the addresses that its reply had.
        version: What the reply held, as it came.
    """

    device: str
    addresses: Addresses
    version: bytes


def find_hands(
    device: str,
    hand_ids: Iterable[int] = range(8),
    *,
    timing: SerialTiming | None = None,
    open_port: Callable[[str, int], Port] = open_serial_port,
) -> tuple[FoundHand, ...]:
    """Ask each id on a port for its version and return those that answer.

    Args:
        device: The serial port, such as `/dev/ttyUSB0`.
        hand_ids: Ids to ask.
        timing: Times of the line.
        open_port: Opens a port, given its name and baud rate.

    Raises:
        HandDisconnectedError: If the port cannot be opened, or went away.
        HandRefusedError: If a hand answers with its error command.
    """
    timing = timing or SerialTiming()
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


@dataclass(frozen=True)
class AskedPort:
    """A serial port that was asked for hands.

    Attributes:
        port: The port.
        hands: The hands that answered.
        trouble: Why it could not be asked, or empty.
    """

    port: PortInfo
    hands: tuple[FoundHand, ...]
    trouble: str = ""

    def __str__(self) -> str:
        name = f"{self.port.device} ({self.port.description})" if self.port.description else self.port.device
        return name + (f": {self.trouble}" if self.trouble else "" if self.hands else ": no hand answers")


def ask_ports(device: str | None = None, hand_id: int | None = None) -> tuple[AskedPort, ...]:
    """Ask all serial ports, or one, for hands: a version request per id, which holds no set-point.

    Args:
        device: The only port to ask; default: all.
        hand_id: The only id to ask for; default: 0 to 7.

    Raises:
        HandDisconnectedError: If the port that was named cannot be opened.
        HandError: If pyserial is not installed.
    """
    if device is not None:
        known = {port.device: port for port in list_ports()}
        return (AskedPort(known.get(device, PortInfo(device, "", "")), _hands(device, hand_id)),)
    asked = []
    for port in list_ports():
        try:
            asked.append(AskedPort(port, _hands(port.device, hand_id)))
        except HandError as error:
            asked.append(AskedPort(port, (), str(error)))
    return tuple(asked)


def the_hand(device: str | None = None, hand_id: int | None = None) -> FoundHand:
    """Return the only hand there is, or that on a port, or with an id.

    Args:
        device: The hand's serial port; default: any.
        hand_id: Its id; default: any from 0 to 7.

    Raises:
        HandError: If there is none or more than one; it lists the ports, or the hands.
        HandDisconnectedError: If the port that was named cannot be opened.
    """
    asked = ask_ports(device, hand_id)
    hands = [hand for port in asked for hand in port.hands]
    if len(hands) == 1:
        return hands[0]
    if hands:
        found = ", ".join(f"{hand.device} (id {hand.addresses.hand_id})" for hand in hands)
        raise HandError(f"{len(hands)} hands answer: {found}; choose one with --port or --hand-id")
    wanted = "no hand answers" if hand_id is None else f"no hand with id {hand_id} answers"
    if device is not None:
        raise HandDisconnectedError(f"{wanted} on {device}; is it switched on, and is this its port?")
    listed = "; ".join(map(str, asked)) or "this computer has no serial port"
    raise HandDisconnectedError(f"{wanted}; {listed}")


def _hands(device: str, hand_id: int | None) -> tuple[FoundHand, ...]:
    if hand_id is None:
        return find_hands(device, _ALL_IDS, timing=_PATIENT)
    return find_hands(device, (hand_id,), timing=_MORE_PATIENT)
