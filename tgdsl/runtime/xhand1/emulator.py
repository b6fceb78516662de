"""An emulated hand behind a pseudo-terminal, which opens like a serial port. POSIX only."""

from __future__ import annotations

import contextlib
import os
import queue
import select
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from tgdsl.runtime.xhand1.emulated_hand import EmulatedHand
from tgdsl.runtime.xhand1.errors import HandError
from tgdsl.runtime.xhand1.faulty_line import Faults, FaultyLine
from tgdsl.runtime.xhand1.parser import FrameParser
from tgdsl.runtime.xhand1.protocol import HAND_ADDRESS, OVERHEAD, Frame, encode_frame
from tgdsl.runtime.xhand1.serial_port import BAUD

_IDLE_S = 0.05
_KEPT_REQUESTS = 20_000
_CALL_TIMEOUT_S = 10.0


class Emulator:
    """A thread that lets an emulated hand answer on a pseudo-terminal, as fast as a line of its baud rate would.

    Attributes:
        device: The serial port's name. It stays the same when the hand is unplugged and plugged in again.
        hand: The hand.
        requests: The latest requests that arrived, with the time of `time.monotonic` [s].
        num_lost_bytes: Bytes that nobody read in time.
    """

    def __init__(
        self,
        hand: EmulatedHand | None = None,
        *,
        faults: Faults | None = None,
        baud: int = BAUD,
        turnaround_s: float = 0.0002,
        seed: int = 0,
    ):
        """Plug the hand in and switch it on.

        Args:
            hand: The hand; default: one with id 0 that feels nothing.
            faults: What goes wrong on the line; default: nothing.
            baud: Bits per second.
            turnaround_s: Time from a request's last byte to the reply's first [s].
            seed: Seed of the faults.
        """
        self.hand = hand or EmulatedHand()
        self.requests: deque[tuple[float, Frame]] = deque(maxlen=_KEPT_REQUESTS)
        self.num_lost_bytes = 0
        self._second_hand = EmulatedHand((self.hand.address ^ 1) - HAND_ADDRESS)
        self._line = FaultyLine(baud, faults or Faults(), seed)
        self._turnaround_s = turnaround_s
        self._parser = FrameParser()
        self._folder = tempfile.TemporaryDirectory(prefix="xhand1-")
        self.device = str(Path(self._folder.name) / "ttyXHAND1")
        self._ends: tuple[int, int] | None = None
        self._calls: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        self._wake_read, self._wake_write = os.pipe()
        self._is_running = True
        self._plug()
        self._thread = threading.Thread(target=self._run, name="xhand1-emulator", daemon=True)
        self._thread.start()

    def set_faults(self, faults: Faults) -> None:
        """Let other faults strike from now on."""
        self._call(lambda: setattr(self._line, "faults", faults))

    def fault_counts(self) -> dict[str, int]:
        """Return how often each fault has struck, by its name."""
        return dict(self._line.counts)

    def unplug(self) -> None:
        """Pull the cable: the port goes away, and what is on its way is lost."""
        self._call(self._unplug)

    def replug(self) -> None:
        """Plug it in again: the port is there under the same name. The hand was on all the time."""
        self._call(self._plug)

    def close(self) -> None:
        """Switch the hand off and remove the port."""
        if self._is_running:
            self._call(self._stop)
            self._thread.join()
            self._unplug()
            for end in (self._wake_read, self._wake_write):
                os.close(end)
            self._folder.cleanup()

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _call(self, call: Callable[[], None]) -> None:
        """Run something in the emulator's thread and wait until it is done.

        Raises:
            HandError: If it is not done in time.
        """
        done = threading.Event()
        self._calls.put((call, done))
        os.write(self._wake_write, b"!")
        if not done.wait(_CALL_TIMEOUT_S):
            raise HandError(f"the emulator did not do within {_CALL_TIMEOUT_S:g} s what it was told; its thread may have ended")

    def _stop(self) -> None:
        self._is_running = False

    def _plug(self) -> None:
        if self._ends is None:
            self._ends = os.openpty()
            for end in self._ends:
                tty.setraw(end)
            os.set_blocking(self._ends[0], False)
            os.symlink(os.ttyname(self._ends[1]), self.device)

    def _unplug(self) -> None:
        if self._ends is not None:
            os.unlink(self.device)
            for end in self._ends:
                os.close(end)
            self._ends = None
            self._line.clear()
            self._parser = FrameParser()

    def _run(self) -> None:
        while self._is_running:
            next_due = self._line.next_due()
            wait = _IDLE_S if next_due is None else max(next_due - time.monotonic(), 0.0)
            watched = [self._wake_read] if self._ends is None else [self._wake_read, self._ends[0]]
            ready = select.select(watched, [], [], min(wait, _IDLE_S))[0]
            if self._ends is not None and self._ends[0] in ready:
                self._listen(self._ends[0])
            if self._ends is not None and (data := self._line.due(time.monotonic())):
                self._speak(self._ends[0], data)
            if self._wake_read in ready:
                os.read(self._wake_read, 1)
                call, done = self._calls.get()
                call()
                done.set()

    def _listen(self, end: int) -> None:
        data = b""
        with contextlib.suppress(OSError):
            data = os.read(end, 65536)
        now = time.monotonic()
        for frame in self._parser.feed(data):
            self.requests.append((now, frame))
            if self._line.strikes("silence"):
                continue
            arrived_at = now + self._line.wire_time(OVERHEAD + len(frame.payload))
            if (reply := self.hand.answer(frame, arrived_at)) is not None:
                self._line.send(encode_frame(reply), self._foreign(frame, arrived_at), arrived_at + self._turnaround_s)

    def _foreign(self, frame: Frame, now: float) -> bytes:
        """Return what a second hand would reply, if the line ever lets it."""
        own = replace(frame, destination=self._second_hand.address)
        reply = self._second_hand.answer(own, now) if self._line.faults.foreign else None
        return b"" if reply is None else encode_frame(reply)

    def _speak(self, end: int, data: bytes) -> None:
        try:
            sent = os.write(end, data)
        except OSError:
            sent = 0
        self.num_lost_bytes += len(data) - sent
