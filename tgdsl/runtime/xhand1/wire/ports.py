"""Which serial ports there are, which hands answer on them, and the one that is meant."""

from __future__ import annotations

from dataclasses import dataclass

from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.discovery import FoundHand, find_hands
from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, HandError
from tgdsl.runtime.xhand1.wire.serial_port import PortInfo, list_ports

_ALL_IDS = tuple(range(8))
_PATIENT = SerialTiming(reply_timeout_s=0.1)
"""A reply that comes later is taken for that of the next id which is asked, so a busy computer is given time."""
_MORE_PATIENT = SerialTiming(reply_timeout_s=0.4)


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
