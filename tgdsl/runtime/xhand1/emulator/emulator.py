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
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType

from tgdsl.runtime.xhand1.emulator.faulty_line import Faults
from tgdsl.runtime.xhand1.emulator.hand import EmulatedHand
from tgdsl.runtime.xhand1.emulator.wire import EmulatedWire
from tgdsl.runtime.xhand1.wire.errors import HandError
from tgdsl.runtime.xhand1.wire.protocol import Frame
from tgdsl.runtime.xhand1.wire.serial_port import BAUD

_IDLE_S = 0.05


class Emulator:
    """A thread that lets an emulated hand answer on a pseudo-terminal, as fast as a line of its baud rate would.

    Attributes:
        device: The serial port's name. It stays the same when the hand is unplugged and plugged in again.
        num_lost_bytes: Bytes that nobody read in time.
        failure: What ended its thread; None if nothing did. The port is then gone, and every call says why.
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
        self.num_lost_bytes = 0
        self.failure: Exception | None = None
        self._wire = EmulatedWire(hand or EmulatedHand(), faults or Faults(), baud, turnaround_s, seed)
        self._folder = tempfile.TemporaryDirectory(prefix="xhand1-")
        self.device = str(Path(self._folder.name) / "ttyXHAND1")
        self._ends: tuple[int, int] | None = None
        self._calls: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = queue.SimpleQueue()
        self._calling = threading.Lock()
        self._wake_read, self._wake_write = os.pipe()
        self._is_running = self._is_serving = True
        self._plug()
        self._thread = threading.Thread(target=self._run, name="xhand1-emulator", daemon=True)
        self._thread.start()

    @property
    def hand(self) -> EmulatedHand:
        """The hand."""
        return self._wire.hand

    @property
    def requests(self) -> deque[tuple[float, Frame]]:
        """The latest requests that arrived, with the time of `time.monotonic` [s]."""
        return self._wire.requests

    def set_faults(self, faults: Faults) -> None:
        """Let other faults strike from now on."""
        self._call(lambda: setattr(self._wire.line, "faults", faults))

    def fault_counts(self) -> dict[str, int]:
        """Return how often each fault has struck, by its name."""
        return dict(self._wire.line.counts)

    def unplug(self) -> None:
        """Pull the cable: the port goes away, and what is on its way is lost."""
        self._call(self._unplug)

    def replug(self) -> None:
        """Plug it in again: the port is there under the same name. The hand was on all the time."""
        self._call(self._plug)

    def check(self) -> None:
        """Look whether the emulator still answers.

        Raises:
            HandError: If its thread has ended, and why.
        """
        if self.failure is not None:
            raise self._ended()

    def close(self) -> None:
        """Switch the hand off and remove the port.

        Raises:
            HandError: If the emulator's thread had ended before, and why.
        """
        if self._is_running:
            with contextlib.suppress(HandError):
                self._call(self._stop)
            self._is_running = False
            self._thread.join()
            self._unplug()
            for end in (self._wake_read, self._wake_write):
                os.close(end)
            self._folder.cleanup()
            self.check()

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _call(self, call: Callable[[], None]) -> None:
        """Run something in the emulator's thread, wait until it is done, and raise what it raises.

        Raises:
            HandError: If the thread has ended, or ends before it is done, and why.
        """
        done: Future[None] = Future()
        with self._calling:
            self.check()
            self._calls.put((call, done))
        os.write(self._wake_write, b"!")
        done.result()

    def _ended(self) -> HandError:
        error = HandError(f"the emulator's thread ended: {self.failure!r}")
        error.__cause__ = self.failure
        return error

    def _stop(self) -> None:
        self._is_serving = False

    def _plug(self) -> None:
        if self._ends is None:
            ends = os.openpty()
            try:
                for end in ends:
                    tty.setraw(end)
                os.set_blocking(ends[0], False)
                os.symlink(os.ttyname(ends[1]), self.device)
            except BaseException:
                for end in ends:
                    os.close(end)
                raise
            self._ends = ends

    def _unplug(self) -> None:
        if self._ends is not None:
            os.unlink(self.device)
            for end in self._ends:
                os.close(end)
            self._ends = None
            self._wire.cut()

    def _run(self) -> None:
        try:
            self._serve()
        except Exception as error:
            with self._calling:
                self.failure = error
            self._unplug()
            while not self._calls.empty():
                self._calls.get()[1].set_exception(self._ended())

    def _serve(self) -> None:
        while self._is_serving:
            next_due = self._wire.next_due()
            wait = _IDLE_S if next_due is None else max(next_due - time.monotonic(), 0.0)
            watched = [self._wake_read] if self._ends is None else [self._wake_read, self._ends[0]]
            ready = select.select(watched, [], [], min(wait, _IDLE_S))[0]
            if self._ends is not None and self._ends[0] in ready:
                self._listen(self._ends[0])
            if self._ends is not None and (data := self._wire.due(time.monotonic())):
                self._speak(self._ends[0], data)
            if self._wake_read in ready:
                os.read(self._wake_read, 1)
                call, done = self._calls.get()
                try:
                    call()
                    done.set_result(None)
                except Exception as error:
                    done.set_exception(error)

    def _listen(self, end: int) -> None:
        data = b""
        with contextlib.suppress(OSError):
            data = os.read(end, 65536)
        self._wire.hear(data, time.monotonic())

    def _speak(self, end: int, data: bytes) -> None:
        try:
            sent = os.write(end, data)
        except OSError:
            sent = 0
        self.num_lost_bytes += len(data) - sent
