"""Who may reply, and what to make of each frame that comes while a reply is waited for."""

from __future__ import annotations

from dataclasses import dataclass

from tgdsl.runtime.xhand1.wire.protocol import HOST_ADDRESS, Command, Frame, hand_address


@dataclass(frozen=True)
class Addresses:
    """Where requests go, and from and to where replies come. What a real hand puts into its replies is unverified.

    Attributes:
        hand_id: The hand's id.
        reply_source: Source of its replies; default: the hand's address.
        reply_destination: Destination of its replies; default: the host's address.
    """

    hand_id: int = 0
    reply_source: int | None = None
    reply_destination: int | None = None

    @property
    def reply(self) -> tuple[int, int]:
        """Source and destination of replies."""
        source = hand_address(self.hand_id) if self.reply_source is None else self.reply_source
        return source, HOST_ADDRESS if self.reply_destination is None else self.reply_destination


@dataclass(frozen=True)
class Reply:
    """A reply.

    Attributes:
        payload: Its bytes.
        requested_at: When the request went out, on the client's clock [s]: the reply is not older than this.
        received_at: When the reply was complete [s].
        source: Address that it came from.
        destination: Address that it was for.
    """

    payload: bytes
    requested_at: float
    received_at: float
    source: int
    destination: int


class Waiting:
    """What came while one reply was waited for."""

    def __init__(
        self, command: Command, reply_size: int | None, addresses: Addresses | None, wire_time: float, requested_at: float
    ):
        self.command = command
        self.reply_size = reply_size
        self.requested_at = requested_at
        self.reply: Reply | None = None
        self.refusal: bytes | None = None
        self.foreign: Frame | None = None
        self.wrong_size: int | None = None
        self.is_early = self.is_babble = False
        self.num_foreign = self.num_unexpected = self.num_damaged = self.num_incomplete = 0
        self._addresses = addresses
        self._wire_time = wire_time

    def sort(self, frames: list[Frame], now: float) -> None:
        """Say of each frame what it is."""
        for frame in frames:
            self._sort(frame, now)

    def _sort(self, frame: Frame, now: float) -> None:
        ends = frame.source, frame.destination
        if self._addresses is None and frame.source == HOST_ADDRESS and not frame.payload:
            return  # an adapter that hears its own requests
        if self._addresses is not None and ends != self._addresses.reply:
            if ends != (HOST_ADDRESS, hand_address(self._addresses.hand_id)):
                self.num_foreign += 1
                self.foreign = frame
            return
        if frame.command == Command.ERROR:
            self.refusal = frame.payload
            return
        if self._is_sought(frame, now):
            self.num_unexpected += self.reply is not None
            self.reply = Reply(frame.payload, self.requested_at, now, *ends)
        else:
            self.num_unexpected += 1

    def _is_sought(self, frame: Frame, now: float) -> bool:
        if frame.command != self.command:
            return False
        if self.reply_size not in (None, len(frame.payload)):
            self.wrong_size = len(frame.payload)
            return False
        self.is_early = now - self.requested_at < self._wire_time
        return not self.is_early
