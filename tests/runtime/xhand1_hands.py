"""An emulated hand whose fingertips say when they were read, so that an old reading cannot pass for a new one.

These tests run in real time, beside others on a machine that may be busy or stand still: they wait for what shall happen rather
than for a time in which it should have, and a limit in time is for what is usual (a quantile, or the best of some rounds), as no
single one can be told from the machine's own pauses.
"""

import time
from collections.abc import Callable

import numpy as np

from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulated_body import TipForces
from tgdsl.runtime.xhand1.errors import HandError
from tgdsl.runtime.xhand1.link import LinkTiming
from tgdsl.runtime.xhand1.reader import Reading
from tgdsl.runtime.xhand1.serial_port import open_serial_port

PATIENT = LinkTiming(reply_timeout_s=5.0, silence_s=2.0)
"""So that a busy machine, whose pseudo-terminals may take half a second, is no failure of the line."""


class Stamps:
    """A force field whose thumb says how often it was read, in four bytes of four taxels; it remembers when that was."""

    def __init__(self):
        self.times: list[float] = []

    def __call__(self, time_s: float, position: np.ndarray) -> TipForces:
        taxel = np.zeros((5, 120, 3))
        taxel[:, :, 0] = np.arange(120) - 60
        taxel[0, :4, 2] = list(len(self.times).to_bytes(4, "little"))
        self.times.append(time_s)
        return TipForces(np.tile([7.0, -3.0, 40.0], (5, 1)), taxel)

    def check(self, reading: Reading, now: float | None = None) -> int:
        """Assert that a reading is whole and was taken after it was asked for and before it came; return its stamp."""
        force = reading.state.taxel_force
        assert (force[:, :, 0] == np.arange(120) - 60).all()
        assert (reading.state.total_force == [7, -3, 40]).all()
        stamp = int.from_bytes(force[0, :4, 2].astype(np.uint8).tobytes(), "little")
        taken = self.times[stamp]
        assert reading.requested_at <= taken <= reading.received_at <= (time.monotonic() if now is None else now)
        return stamp


class WrittenBytes:
    """Opens serial ports and keeps every byte that is written to them, and when it was."""

    def __init__(self):
        self.writes: list[bytes] = []
        self.times: list[float] = []

    def open(self, device: str, baud: int):
        port = open_serial_port(device, baud)
        plain_write = port.write

        def write(data: bytes) -> None:
            self.writes.append(bytes(data))
            self.times.append(time.monotonic())
            plain_write(data)

        port.write = write  # type: ignore[method-assign]
        return port


class Wait:
    """Measures how long a block takes.

    Attributes:
        seconds: Time that passed [s].
    """

    def __enter__(self) -> "Wait":
        self._start = time.monotonic()
        return self

    def __exit__(self, *_) -> None:
        self.seconds = time.monotonic() - self._start


def wait_until(is_so: Callable[[], bool], seconds: float = 20.0) -> bool:
    """Wait until something is so, and return whether it is in the end."""
    deadline = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def read_again(hand: XHand1, seconds: float = 20.0) -> Reading:
    """Return the first reading that comes after failures."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return hand.read()
        except HandError:
            if time.monotonic() > deadline:
                raise
