"""An emulated hand's line that damages, drops, delays and repeats the hand's replies, with a seed."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from first_order_hands import first_order_hand

from tgdsl.runtime.xhand1.emulator.emulator import EmulatedHand, EmulatedLine, Emulator
from tgdsl.runtime.xhand1.wire.protocol import HAND_ADDRESS, Frame, encode_frame


@dataclass(frozen=True)
class Faults:
    """How likely each fault is, for each reply: 0 never, 1 always.

    Attributes:
        corrupt: One to four bytes are changed.
        truncate: The end is missing.
        drop: It never comes.
        delay: It comes `delay_s` later, and all that follows it.
        duplicate: It comes twice.
        noise: Random bytes come before it.
        foreign: A second hand's reply comes before it.
        silence: The hand does not even listen. Unlike `drop`, the request has no effect.
        delay_s: How late a delayed reply is [s].
    """

    corrupt: float = 0.0
    truncate: float = 0.0
    drop: float = 0.0
    delay: float = 0.0
    duplicate: float = 0.0
    noise: float = 0.0
    foreign: float = 0.0
    silence: float = 0.0
    delay_s: float = 0.04

    @classmethod
    def each(cls, probability: float, delay_s: float = 0.04) -> "Faults":
        """Return every fault with one probability, but `silence`."""
        names = [field.name for field in fields(cls) if field.name not in ("delay_s", "silence")]
        return cls(**dict.fromkeys(names, probability), delay_s=delay_s)


class FaultyLine(EmulatedLine):
    """A line with faults.

    Attributes:
        faults: The faults that strike from now on.
        counts: How often each fault has struck, by its name.
    """

    def __init__(self, hand: EmulatedHand | None = None, faults: Faults | None = None, seed: int = 0, **options):
        super().__init__(hand or first_order_hand(), **options)
        self.faults = faults or Faults()
        self.counts: dict[str, int] = {}
        self._rng = np.random.default_rng(seed)
        self._second_hand = EmulatedHand((self.hand.address ^ 1) - HAND_ADDRESS)

    def answer(self, frame: Frame, arrived_at: float) -> None:
        if self._strikes("silence") or (reply := self.hand.answer(frame, arrived_at)) is None:
            return
        other = replace(frame, destination=self._second_hand.address)
        foreign = self._second_hand.answer(other, arrived_at) if self.faults.foreign else None
        self.reply(encode_frame(reply), b"" if foreign is None else encode_frame(foreign), arrived_at + self._turnaround_s)

    def reply(self, raw: bytes, foreign: bytes, ready_at: float) -> None:
        """Send a reply, or what the faults make of it, at a time [s]; `foreign` is a second hand's."""
        if self._strikes("delay"):
            ready_at += self.faults.delay_s
        if self._strikes("foreign"):
            self.send(foreign, ready_at)
        if self._strikes("noise"):
            self.send(self._rng.bytes(int(self._rng.integers(1, 40))), ready_at)
        if self._strikes("drop"):
            return
        if self._strikes("truncate"):
            raw = raw[: int(self._rng.integers(0, len(raw)))]
        if self._strikes("corrupt"):
            raw = self._corrupted(raw)
        self.send(raw, ready_at)
        if self._strikes("duplicate"):
            self.send(raw, ready_at)

    def _strikes(self, name: str) -> bool:
        does = bool(self._rng.random() < getattr(self.faults, name))
        self.counts[name] = self.counts.get(name, 0) + does
        return does

    def _corrupted(self, raw: bytes) -> bytes:
        out = bytearray(raw)
        if out:
            for place in self._rng.integers(0, len(out), size=int(self._rng.integers(1, 5))):
                out[place] ^= int(self._rng.integers(1, 256))
        return bytes(out)


class FaultyEmulator(Emulator):
    """An emulator on a faulty line."""

    line: FaultyLine

    def __init__(self, hand: EmulatedHand | None = None, faults: Faults | None = None, seed: int = 0):
        super().__init__(line=FaultyLine(hand, faults, seed))

    def unplug(self) -> None:
        """Pull the cable: the port goes away, and the bytes on their way are lost."""
        self.call(self._unplug)

    def replug(self) -> None:
        """Plug it in again: the port is there under the same name. The hand was on all the time."""
        self.call(self._plug)

    def call(self, change: Callable[[], None]) -> None:
        """Change the emulator or its line between two of the thread's turns."""
        with self._lock:
            self.check()
            change()

    def set_faults(self, faults: Faults) -> None:
        """Let other faults strike from now on."""
        self.call(lambda: setattr(self.line, "faults", faults))
