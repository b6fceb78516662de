"""Which hands answer on a port. Only version requests are sent, which hold no set-point."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tgdsl.runtime.xhand1.wire.client import SerialClient, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandChecksumError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.protocol import Command
from tgdsl.runtime.xhand1.wire.replies import Addresses
from tgdsl.runtime.xhand1.wire.serial_port import Port, open_serial_port


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
            except (HandTimeoutError, HandChecksumError):
                continue
            results.append(FoundHand(device, Addresses(hand_id, reply.source, reply.destination), reply.payload))
    finally:
        client.close()
    return tuple(results)
