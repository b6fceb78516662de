"""A serial line at its real speed that damages, drops, delays and repeats what the hand sends. No clock: time is passed in."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields

import numpy as np

_CHUNK = 124
"""Bytes that come out at a time: 0.4 ms of the line at 3 Mbaud."""


@dataclass(frozen=True)
class Faults:
    """How likely each fault is, for each reply: 0 never, 1 always.

    Attributes:
        corrupt: One to four bytes are changed.
        truncate: The end is missing.
        drop: It never comes.
        delay: It comes `delay_s` later, and what follows after it.
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
    def each(cls, probability: float, delay_s: float = 0.04) -> Faults:
        """Return every fault with one probability, but `silence`."""
        names = [field.name for field in fields(cls) if field.name not in ("delay_s", "silence")]
        return cls(**dict.fromkeys(names, probability), delay_s=delay_s)


class FaultyLine:
    """Bytes on their way from the hand to the host, one after another.

    Attributes:
        faults: What goes wrong from now on.
        counts: How often each fault has struck, by its name.
    """

    def __init__(self, baud: int, faults: Faults, seed: int):
        """Start with nothing on its way."""
        self.faults = faults
        self.counts: dict[str, int] = {}
        self._byte_s = 10 / baud
        self._rng = np.random.default_rng(seed)
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._free_at = 0.0

    def wire_time(self, num_bytes: int) -> float:
        """Return how long bytes take on the line [s]."""
        return num_bytes * self._byte_s

    def strikes(self, name: str) -> bool:
        """Return whether a fault strikes this time, and count it."""
        does = bool(self._rng.random() < getattr(self.faults, name))
        self.counts[name] = self.counts.get(name, 0) + does
        return does

    def send(self, reply: bytes, foreign_reply: bytes, ready_at: float) -> None:
        """Put a reply on the line, or what the faults make of it; it waits until what is before it has gone.

        Args:
            reply: The reply.
            foreign_reply: What a second hand would send.
            ready_at: When the hand starts to send [s].
        """
        if self.strikes("delay"):
            ready_at += self.faults.delay_s
        if self.strikes("foreign"):
            self._put(foreign_reply, ready_at)
        if self.strikes("noise"):
            self._put(self._rng.bytes(int(self._rng.integers(1, 40))), ready_at)
        if self.strikes("drop"):
            return
        if self.strikes("truncate"):
            reply = reply[: int(self._rng.integers(0, len(reply)))]
        if self.strikes("corrupt"):
            reply = self._corrupted(reply)
        self._put(reply, ready_at)
        if self.strikes("duplicate"):
            self._put(reply, ready_at)

    def due(self, now: float) -> bytes:
        """Return, and forget, what has come out of the line by now."""
        out = []
        while self._chunks and self._chunks[0][0] <= now:
            out.append(self._chunks.popleft()[1])
        return b"".join(out)

    def next_due(self) -> float | None:
        """Return when more comes out [s], or None if nothing is on its way."""
        return self._chunks[0][0] if self._chunks else None

    def clear(self) -> None:
        """Lose what is on its way."""
        self._chunks.clear()
        self._free_at = 0.0

    def _put(self, raw: bytes, ready_at: float) -> None:
        """Add bytes; where they follow others without a gap, the pieces in which they come out do not show the seam."""
        start = max(ready_at, self._free_at)
        if self._chunks and start == self._free_at and len(self._chunks[-1][1]) < _CHUNK:
            _, begun = self._chunks.pop()
            start -= self.wire_time(len(begun))
            raw = begun + raw
        for at in range(0, len(raw), _CHUNK):
            chunk = raw[at : at + _CHUNK]
            self._chunks.append((start + self.wire_time(at + len(chunk)), chunk))
        self._free_at = start + self.wire_time(len(raw))

    def _corrupted(self, raw: bytes) -> bytes:
        out = bytearray(raw)
        if out:
            for place in self._rng.integers(0, len(out), size=int(self._rng.integers(1, 5))):
                out[place] ^= int(self._rng.integers(1, 256))
        return bytes(out)
