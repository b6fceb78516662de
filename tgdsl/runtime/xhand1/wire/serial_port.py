"""The serial port: the only file that knows pyserial, which is an extra."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, HandError

BAUD = 3_000_000
POLL_S = 0.0005  # how long a read waits for the first byte [s]
_WRITE_TIMEOUT_S = 0.5
_LARGEST_READ = 4096


@runtime_checkable
class Port(Protocol):
    """A line of bytes. Each call may raise `HandDisconnectedError`."""

    def write(self, data: bytes) -> None:
        """Write all bytes."""
        ...

    def read(self) -> bytes:
        """Return what has arrived; if nothing has, wait `POLL_S` for it and return what came, or no bytes."""
        ...

    def pending(self) -> int:
        """Return how many bytes have arrived and were not read."""
        ...

    def close(self) -> None:
        """Release the port."""
        ...


@dataclass(frozen=True)
class PortInfo:
    """A serial port of this computer."""

    device: str  # name to open it by, such as `/dev/ttyUSB0`
    description: str  # what the adapter calls itself
    serial_number: str  # the adapter's serial number, or empty


def list_ports() -> tuple[PortInfo, ...]:
    """Return the serial ports of this computer, whatever is behind them.

    Raises:
        HandError: If pyserial is not installed.
    """
    result = _pyserial().tools.list_ports.comports()
    return tuple(
        sorted((PortInfo(p.device, p.description or "", p.serial_number or "") for p in result), key=lambda p: p.device)
    )


def open_serial_port(device: str, baud: int = BAUD) -> Port:
    """Open a serial port for this process alone: 8 data bits, no parity, 1 stop bit, no flow control.

    Args:
        device: Its name, such as `/dev/ttyUSB0`; one of `/dev/serial/by-id` stays the same when others are plugged in.
        baud: Bits per second.

    Raises:
        HandDisconnectedError: If it cannot be opened.
        HandError: If pyserial is not installed.
    """
    return _SerialPort(device, baud)


class _SerialPort:
    def __init__(self, device: str, baud: int):
        self._device = device
        self._errors = (_pyserial().SerialException, OSError)
        try:
            self._serial = _pyserial().Serial(device, baud, timeout=POLL_S, write_timeout=_WRITE_TIMEOUT_S, exclusive=True)
        except (*self._errors, ValueError) as error:
            raise HandDisconnectedError(f"{device} cannot be opened at {baud} baud: {error}") from error
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            # FTDI adapters else hold the end of a reply back for 16 ms; others know no such mode.
            self._serial.set_low_latency_mode(True)

    def write(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except self._errors as error:
            raise self._gone(error) from error

    def read(self) -> bytes:
        try:
            return self._serial.read(min(max(self._serial.in_waiting, 1), _LARGEST_READ))
        except self._errors as error:
            raise self._gone(error) from error

    def pending(self) -> int:
        try:
            return self._serial.in_waiting
        except self._errors as error:
            raise self._gone(error) from error

    def close(self) -> None:
        with contextlib.suppress(*self._errors):
            self._serial.close()

    def _gone(self, error: Exception) -> HandDisconnectedError:
        return HandDisconnectedError(f"{self._device} went away: {error}")


def _pyserial() -> Any:
    try:
        import serial
        import serial.tools.list_ports
    except ImportError as error:
        raise HandError('a real hand needs pyserial, which is not installed: pip install "tgdsl[hardware]"') from error
    return serial
