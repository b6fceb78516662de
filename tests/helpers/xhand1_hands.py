"""An emulated hand whose fingertips say when they were read, so that an old reading cannot pass for a new one.

These tests run in real time, beside others on a machine that may be busy or stand still: they wait for what shall happen rather
than for a time in which it should have, and do again what such a pause has spoilt. What must happen in time is tested in virtual
time (`virtual_hands`).
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.emulator.emulator import TipForces
from tgdsl.runtime.xhand1.wire.client import SerialPort, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandError

PATIENT = SerialTiming(reply_timeout_s=5.0, silence_s=2.0)
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
        port = SerialPort(device, baud)
        plain_write = port.write

        def write(data: bytes) -> None:
            self.writes.append(bytes(data))
            self.times.append(time.monotonic())
            plain_write(data)

        port.write = write  # type: ignore[method-assign]
        return port


GENEROUS_S = 120.0
"""How long to wait for what must happen [s]."""


def wait_until(is_so: Callable[[], bool], seconds: float = GENEROUS_S) -> bool:
    """Wait until something is so, and return whether it is in the end."""
    deadline = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def open_again(device: str, **options: Any) -> XHand1:
    """Open a hand, again and again where faults or a busy machine keep it from answering."""
    deadline = time.monotonic() + GENEROUS_S
    while True:
        try:
            return XHand1.open(device, **options)
        except HandError:
            if time.monotonic() > deadline:
                raise


def read_again(hand: XHand1) -> Reading:
    """Return the first reading that comes after failures."""
    deadline = time.monotonic() + GENEROUS_S
    while True:
        try:
            return hand.read()
        except HandError:
            if time.monotonic() > deadline:
                raise


def drive_until(hand: XHand1, target: np.ndarray, is_so: Callable[[], bool]) -> None:
    """Command until a condition holds; a hand that stopped because the machine stood still is started again."""

    def commanded() -> bool:
        try:
            hand.command(target)
        except HandError:
            hand.resume()
            return False
        return is_so()

    assert wait_until(commanded)
