"""An emulated hand at the far end of a line: bytes in, bytes out at their times. No thread and no clock: time is passed in."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from tgdsl.runtime.xhand1.emulator.faulty_line import Faults, FaultyLine
from tgdsl.runtime.xhand1.emulator.hand import EmulatedHand
from tgdsl.runtime.xhand1.wire.parser import FrameParser
from tgdsl.runtime.xhand1.wire.protocol import HAND_ADDRESS, OVERHEAD, Frame, encode_frame

_KEPT_REQUESTS = 20_000


class EmulatedWire:
    """The line between a host and an emulated hand.

    Attributes:
        hand: The hand.
        line: The line's faults and their counts.
        requests: The latest requests that arrived, with their times [s].
    """

    def __init__(self, hand: EmulatedHand, faults: Faults, baud: int, turnaround_s: float, seed: int):
        """Connect a hand.

        Args:
            hand: The hand.
            faults: What goes wrong on the line.
            baud: Bits per second.
            turnaround_s: Time from a request's last byte to the reply's first [s].
            seed: Seed of the faults.
        """
        self.hand = hand
        self.line = FaultyLine(baud, faults, seed)
        self.requests: deque[tuple[float, Frame]] = deque(maxlen=_KEPT_REQUESTS)
        self._second_hand = EmulatedHand((hand.address ^ 1) - HAND_ADDRESS)
        self._turnaround_s = turnaround_s
        self._parser = FrameParser()

    def hear(self, data: bytes, now: float) -> None:
        """Take bytes that the host has sent; the hand answers what is a request."""
        for frame in self._parser.feed(data):
            self.requests.append((now, frame))
            if self.line.strikes("silence"):
                continue
            arrived_at = now + self.line.wire_time(OVERHEAD + len(frame.payload))
            if (reply := self.hand.answer(frame, arrived_at)) is not None:
                self.line.send(encode_frame(reply), self._foreign(frame, arrived_at), arrived_at + self._turnaround_s)

    def due(self, now: float) -> bytes:
        """Return, and forget, what has reached the host by now."""
        return self.line.due(now)

    def next_due(self) -> float | None:
        """Return when more reaches it [s], or None if nothing is on its way."""
        return self.line.next_due()

    def cut(self) -> None:
        """Lose what is on its way, in both directions."""
        self.line.clear()
        self._parser = FrameParser()

    def _foreign(self, frame: Frame, now: float) -> bytes:
        """Return what a second hand would reply, if the line ever lets it."""
        own = replace(frame, destination=self._second_hand.address)
        reply = self._second_hand.answer(own, now) if self.line.faults.foreign else None
        return b"" if reply is None else encode_frame(reply)
