"""The driver and an emulated hand in virtual time: exact, and the same however busy the machine is.

The driver's thread runs only while the test waits for virtual time to pass, and the test only while that thread waits for the
line: so both are one program, and the clock shows what a wait would have taken with nothing in its way.
"""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from faulty_lines import Faults, FaultyLine

from tgdsl.runtime.xhand1 import driver, source
from tgdsl.runtime.xhand1.driver import HandReader, XHand1
from tgdsl.runtime.xhand1.emulator.emulator import EmulatedHand
from tgdsl.runtime.xhand1.motion import Motion, MotionLimits
from tgdsl.runtime.xhand1.wire.client import POLL_S, Addresses, SerialClient, SerialCounters, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError


class VirtualTime:
    """Time that passes when both sides wait; what the driver sees in the place of the module `time`."""

    def __init__(self):
        self.now, self._limit, self._is_over = 1000.0, 1000.0, False
        self._go, self._back = threading.Semaphore(0), threading.Semaphore(0)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let the driver's thread run for some time; for the test."""
        self.run_until(self.now + seconds, lambda: False)

    def run_until(self, limit: float, is_so: Callable[[], Any]) -> None:
        """Let the driver's thread run until a time, or until something is so when it has told of something; for the test."""
        while not is_so() and not self._is_over and self.now < limit:
            self._limit = limit
            self._go.release()
            self._back.acquire()
        if self._is_over:
            self.now = max(self.now, min(limit, 1e9))

    def wake(self) -> None:
        """Let the test look at once, unless it waits for the end; for the driver's thread."""
        if self._limit < math.inf:
            self._limit = self.now

    def pass_until(self, then: float) -> None:
        """Wait for a time; for the driver's thread."""
        while then > self._limit:
            self.now = max(self.now, self._limit)
            self._back.release()
            self._go.acquire()
        self.now = max(self.now, then)

    def begin(self) -> None:
        self._go.acquire()

    def end(self) -> None:
        self._is_over = True
        self._back.release()

    def finish(self) -> None:
        """Let the driver's thread run to its end."""
        self._limit = math.inf
        self._go.release()


class VirtualPort:
    """The host's end of an emulated wire.

    Attributes:
        writes: Time and bytes of all that was written.
    """

    def __init__(self, line: FaultyLine, time: VirtualTime):
        self.line, self.time, self.is_there = line, time, True
        self.writes: list[tuple[float, bytes]] = []
        self._here = b""

    def write(self, data: bytes) -> None:
        self._check()
        self.writes.append((self.time.now, bytes(data)))
        self.line.hear(data, self.time.now)

    def read(self) -> bytes:
        self._check()
        if not self.pending():
            later = self.time.now + POLL_S
            self.time.pass_until(min(self.line.next_due() or later, later))
            self._check()
            self.pending()
        here, self._here = self._here, b""
        return here

    def pending(self) -> int:
        self._check()
        self._here += self.line.due(self.time.now)
        return len(self._here)

    def close(self) -> None:
        self._here = b""

    def set_faults(self, faults: Faults) -> None:
        self.line.faults = faults

    def unplug(self) -> None:
        self.is_there = False
        self.line.cut()

    def replug(self) -> None:
        self.is_there = True

    def _check(self) -> None:
        if not self.is_there:
            raise HandDisconnectedError("the port went away")


class _Condition(threading.Condition):
    def __init__(self, time: VirtualTime):
        super().__init__()
        self._time = time

    def wait_for(self, predicate: Callable[[], Any], timeout: float | None = None) -> Any:
        held = self._release_save()  # type: ignore[attr-defined]
        try:
            self._time.run_until(math.inf if timeout is None else self._time.now + timeout, predicate)
        finally:
            self._acquire_restore(held)  # type: ignore[attr-defined]
        return predicate()

    def notify_all(self) -> None:
        self._time.wake()


class _Event(threading.Event):
    def __init__(self, time: VirtualTime):
        super().__init__()
        self._time = time

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self._time.pass_until(self._time.now + timeout)
        return self.is_set()


class _Reader(HandReader):
    def __init__(
        self, client: SerialClient, connect: Callable[[SerialCounters], SerialClient], motion: Motion, time: VirtualTime
    ):
        super().__init__(client, connect, motion)
        self._time, self.changed, self._stopping = time, _Condition(time), _Event(time)

    def run(self) -> None:
        self._time.begin()
        try:
            super().run()
        finally:
            self._time.end()

    def join(self, timeout: float | None = None) -> None:
        if self.is_alive():
            self._time.finish()
        super().join()


@contextmanager
def virtual_hand(
    monkeypatch,
    hand: EmulatedHand | None = None,
    *,
    motion: MotionLimits | None = None,
    timing: SerialTiming | None = None,
    turnaround_s: float = 0.0002,
    seed: int = 0,
) -> Iterator[tuple[XHand1, VirtualPort, VirtualTime]]:
    """Open a hand as `XHand1.open` does, its line and its clock virtual."""
    time, timing = VirtualTime(), timing or SerialTiming()
    for module in (driver, source):
        monkeypatch.setattr(module, "time", time)
    port = VirtualPort(FaultyLine(hand, seed=seed, turnaround_s=turnaround_s), time)

    def connect(counters: SerialCounters) -> SerialClient:
        port._check()
        return SerialClient(port, Addresses(), timing, counters, clock=time.monotonic)

    own = _Reader(connect(SerialCounters()), connect, Motion(motion), time)
    own.start()
    opened = XHand1(own, timing)
    try:
        yield opened, port, time
    finally:
        opened.close()
