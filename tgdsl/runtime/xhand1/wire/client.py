"""One request and its reply on a serial line, with noise and stale replies; and the port, by pyserial, an extra.

Replies carry no sequence number. These rules keep an old reply from being taken for a new one:

- a request goes out only on a silent line, and the last reply before the line falls silent again counts, if no damaged one
  follows;
- a reply that is complete before the wire could have carried it is not this request's;
- after a failure the client requests the version: that answer comes after all late replies.

A hand that does not answer version requests (their reply is *unverified*) must be silent for `settle_s` instead. One error
remains: a reply later than `reply_timeout_s + settle_s`, and apart from the next one, counts as the next one. For all hands,
so does a reply repeated after a silence if the next one is lost.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, HandError, HandRefusedError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.protocol import (
    COMMAND_SIZE,
    HOST_ADDRESS,
    OVERHEAD,
    STATE_SIZE,
    Command,
    Frame,
    FrameParser,
    encode_frame,
    hand_address,
)

BAUD = 3_000_000
POLL_S = 0.0005  # how long a read waits for the first byte [s]
_WRITE_TIMEOUT_S = 0.5
_LARGEST_READ = 4096
_CLOCK_TOLERANCE = 0.97  # part of the nominal time that a UART with a fast clock may take for a frame
_VERSION_TRIES = 3
_BABBLE = "the line does not fall silent: something else is sending on it"


@runtime_checkable  # for tests that check types
class Port(Protocol):
    """A line of bytes. Each call may raise `HandDisconnectedError`."""

    def write(self, data: bytes) -> None: ...

    def read(self) -> bytes:
        """Return the bytes that have arrived; if there are none, wait up to `POLL_S` for some."""
        ...

    def pending(self) -> int:
        """Return how many bytes have arrived and were not read."""
        ...

    def close(self) -> None: ...


class PortInfo(NamedTuple):
    """A serial port of this computer."""

    device: str  # name to open it by, such as `/dev/ttyUSB0`
    description: str  # what the adapter calls itself
    serial_number: str  # the adapter's serial number, or empty


def list_ports() -> tuple[PortInfo, ...]:
    """Return the serial ports of this computer, whatever is behind them."""
    ports = _pyserial().tools.list_ports.comports()
    return tuple(sorted(PortInfo(port.device, port.description or "", port.serial_number or "") for port in ports))


class SerialPort:
    """A serial port of this process alone: 8 data bits, no parity, 1 stop bit, no flow control."""

    def __init__(self, device: str, baud: int):
        """Open it by its name, such as `/dev/ttyUSB0`; one of `/dev/serial/by-id` stays the same when others are plugged in."""
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
        self._named(lambda: self._serial.write(data))

    def read(self) -> bytes:
        return self._named(lambda: self._serial.read(min(max(self._serial.in_waiting, 1), _LARGEST_READ)))

    def pending(self) -> int:
        return self._named(lambda: self._serial.in_waiting)

    def close(self) -> None:
        with contextlib.suppress(*self._errors):
            self._serial.close()

    def _named(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except self._errors as error:
            raise HandDisconnectedError(f"{self._device} went away: {error}") from error


def _pyserial() -> Any:
    try:
        import serial
        import serial.tools.list_ports
    except ImportError as error:
        raise HandError('a real hand needs pyserial, which is not installed: pip install "tgdsl[hardware]"') from error
    return serial


@dataclass(frozen=True)
class SerialTiming:
    """Times of the line."""

    baud: int = BAUD  # bits per second; 10 bits carry one byte
    reply_timeout_s: float = 0.03  # how long a reply may take to be complete [s]
    silence_s: float = 0.018  # silence after which a reply that has begun will not go on [s]; FTDI pauses for up to 16 ms
    settle_s: float = 0.018  # required silence after a failure [s]: since the last byte, if the hand reports its version
    quiet_s: float = 0.0005  # silence that ends a good reply [s]
    # whether a reply complete sooner than the baud rate allows is refused as an earlier request's. Turn it off for a line
    # that is faster than its baud rate.
    checks_wire_time: bool = True

    @property
    def exchange_s(self) -> float:
        """Transfer time of a command and its reply, a state, on the line [s]."""
        return 10 * (2 * OVERHEAD + COMMAND_SIZE + STATE_SIZE) / self.baud


@dataclass
class SerialCounters:
    """What happened on the line so far."""

    num_requests: int = 0  # requests sent
    num_replies: int = 0  # requests that were answered
    num_timeouts: int = 0  # requests without an answer
    num_damaged: int = 0  # requests with a damaged answer
    num_foreign: int = 0  # frames from or to other addresses
    num_unexpected: int = 0  # replies that were not asked for: repeated, early, or to another command
    num_discarded_bytes: int = 0  # bytes that belonged to no frame, or that came when nothing was asked


@dataclass(frozen=True)
class Addresses:
    """Where requests go, and from and to where replies come. What a real hand puts into its replies is unverified."""

    hand_id: int = 0
    reply_source: int | None = None  # default: the hand's address
    reply_destination: int | None = None  # default: the host's address

    @property
    def reply(self) -> tuple[int, int]:
        """Source and destination of replies."""
        source = hand_address(self.hand_id) if self.reply_source is None else self.reply_source
        return source, HOST_ADDRESS if self.reply_destination is None else self.reply_destination


class Reply(NamedTuple):
    """A reply."""

    payload: bytes
    requested_at: float  # when the request went out, on the client's clock [s]: the reply is not older than this
    received_at: float  # when the reply was complete [s]
    source: int  # address that it came from
    destination: int  # address that it was for


class _Waiting:
    """What came while one reply was waited for."""

    def __init__(
        self, command: Command, reply_size: int | None, addresses: Addresses | None, wire_time: float, requested_at: float
    ):
        self.command, self.reply_size, self.requested_at = command, reply_size, requested_at
        self.reply: Reply | None = None
        self.refusal: bytes | None = None
        self.foreign: Frame | None = None
        self.wrong_size: int | None = None
        self.is_early = self.is_babble = False
        self.num_foreign = self.num_unexpected = self.num_damaged = self.num_incomplete = 0
        self._addresses, self._wire_time = addresses, wire_time

    def sort(self, frames: list[Frame], now: float) -> None:
        """Take frames that came by now [s]: this request's reply, a refusal, another's or none that was asked for."""
        for frame in frames:
            ends = frame.source, frame.destination
            if self._addresses is None and frame.source == HOST_ADDRESS and not frame.payload:
                continue  # an adapter that hears its own requests
            if self._addresses is not None and ends != self._addresses.reply:
                if ends != (HOST_ADDRESS, hand_address(self._addresses.hand_id)):
                    self.num_foreign += 1
                    self.foreign = frame
            elif frame.command == Command.ERROR:
                self.refusal = frame.payload
            elif self._is_sought(frame, now):
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


class SerialClient:
    """A port on which one hand answers, one request at a time. Not for use by two threads."""

    def __init__(
        self,
        port: Port,
        addresses: Addresses | None,
        timing: SerialTiming,
        counters: SerialCounters | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Take over an open port; without addresses replies from and to any are accepted but the host's own requests."""
        self.port, self.timing, self.counters = port, timing, counters or SerialCounters()
        self._addresses, self._clock, self._parser = addresses, clock, FrameParser()
        self._is_suspect, self._silent_since = True, clock()
        self._tells_version: bool | None = None if addresses else False

    def exchange(self, command: Command, payload: bytes = b"", reply_size: int | None = None, hand_id: int = 0) -> Reply:
        """Send a request and return its reply, whose payload has `reply_size` bytes if that is known.

        Without addresses the hand `hand_id` is asked.

        Raises:
            HandTimeoutError: If no reply came in time, a damaged one or another hand's, or the line does not fall silent.
            HandRefusedError: If the hand replied with its error command.
            HandDisconnectedError: If the port went away.
        """
        self._await_silence()
        if self._is_suspect and self._tells_version is not False:
            self._synchronise()
        return self._ask(command, payload, reply_size, hand_id)

    def post(self, command: Command, payload: bytes) -> None:
        """Send a request at once and wait for nothing; its reply is discarded by the next exchange."""
        self._silent_since = self._clock()
        self._write(self._request(command, payload, 0))

    def close(self) -> None:
        self.port.close()

    def _request(self, command: Command, payload: bytes, hand_id: int) -> bytes:
        hand_id = hand_id if self._addresses is None else self._addresses.hand_id
        return encode_frame(Frame(HOST_ADDRESS, hand_address(hand_id), command, payload))

    def _write(self, request: bytes) -> None:
        self._is_suspect = True
        self.counters.num_requests += 1
        self.port.write(request)

    def _ask(self, command: Command, payload: bytes, reply_size: int | None, hand_id: int) -> Reply:
        request, wire_time = self._request(command, payload, hand_id), 0.0
        if self.timing.checks_wire_time:
            wire_time = _CLOCK_TOLERANCE * 10 * (len(request) + OVERHEAD + (reply_size or 0)) / self.timing.baud
        waiting = _Waiting(command, reply_size, self._addresses, wire_time, self._clock())
        self._write(request)
        self._listen(waiting)
        if waiting.reply is None:
            raise self._failure(waiting)
        self._is_suspect = False
        self.counters.num_replies += 1
        return waiting.reply

    def _synchronise(self) -> None:
        """Ask for the version: earlier replies come before the answer. Learn at first whether there is one."""
        for left in range(1 if self._tells_version else _VERSION_TRIES, 0, -1):
            try:
                self._ask(Command.VERSION, b"", None, 0)
            except HandDisconnectedError:
                raise
            except HandError:
                if left == 1 and self._tells_version:
                    raise
                self._await_silence()
            else:
                self._tells_version = True
                return
        self._tells_version = False

    def _await_silence(self) -> None:
        """Wait until the line is silent, if it may not be; raise an error if it does not fall silent."""
        if not self._is_suspect and not self.port.pending():
            return
        self._is_suspect = True
        give_up_at = self._clock() + self.timing.reply_timeout_s + self.timing.settle_s
        while self._clock() - self._silent_since < self.timing.settle_s or self.port.pending():
            if data := self.port.read():
                self._silent_since = self._clock()
                self.counters.num_discarded_bytes += len(data)
            if self._clock() > give_up_at:
                raise HandTimeoutError(_BABBLE)
        self._parser = FrameParser()

    def _listen(self, waiting: _Waiting) -> None:
        """Collect what comes until a reply has come and the line is silent, or nothing more is to be expected."""
        timing, parser = self.timing, self._parser
        give_up_at = waiting.requested_at + timing.reply_timeout_s
        last_byte_at = waiting.requested_at
        discarded = parser.num_discarded
        while True:
            data = self.port.read()
            now = self._clock()
            if data:
                last_byte_at = now
                waiting.sort(parser.feed(data), now)
            silent_s = now - last_byte_at
            is_damaged = bool(parser.num_buffered) or parser.num_discarded > discarded
            is_answered = waiting.reply is not None and not parser.num_buffered
            if (is_answered and silent_s >= timing.quiet_s) or (is_damaged and silent_s >= timing.silence_s):
                break
            if now >= give_up_at and waiting.reply is None:
                waiting.num_incomplete = parser.num_buffered
                break
            if now >= give_up_at + timing.settle_s:
                waiting.reply, waiting.is_babble = None, True
                break
        waiting.sort(parser.flush(), last_byte_at)
        if parser.num_trailing >= OVERHEAD:  # less is a glitch, as when a driver lets go of the bus
            waiting.reply = None
        waiting.num_damaged = parser.num_discarded - discarded
        self._silent_since = last_byte_at if waiting.num_damaged or self._tells_version else self._clock()
        self.counters.num_discarded_bytes += waiting.num_damaged
        self.counters.num_foreign += waiting.num_foreign
        self.counters.num_unexpected += waiting.num_unexpected

    def _failure(self, waiting: _Waiting) -> HandError:
        request = f"command {waiting.command:#04x} ({waiting.command.name.lower()})"
        if waiting.refusal is not None:
            content = waiting.refusal.hex(" ") or "nothing"
            return HandRefusedError(f"the hand refused {request}; its error reply holds {content}")
        if waiting.is_babble:
            return HandTimeoutError(_BABBLE)
        if waiting.num_damaged > waiting.num_incomplete:
            self.counters.num_damaged += 1
            return HandTimeoutError(f"the reply to {request} came damaged: {waiting.num_damaged} bytes are in no sound frame")
        self.counters.num_timeouts += 1
        within = f"within {1e3 * self.timing.reply_timeout_s:.0f} ms"
        message = f"no reply to {request} {within}"
        if waiting.foreign is not None and self._addresses is not None:
            expected = "from {:#04x} to {:#04x}".format(*self._addresses.reply)
            ends = f"from {waiting.foreign.source:#04x} to {waiting.foreign.destination:#04x}"
            message = f"a reply came {ends}, expected {expected}; if it is this hand's, set its reply addresses"
        elif waiting.is_early:
            took = f"sooner than {self.timing.baud} baud allow"
            message = f"a reply to {request} came {took}: an earlier one's, or set checks_wire_time=False"
        elif waiting.wrong_size is not None:
            message = f"the reply to {request} has {waiting.wrong_size} bytes, expected {waiting.reply_size}"
        elif waiting.num_incomplete:
            message = f"the reply to {request} was not complete {within}: {waiting.num_incomplete} bytes had come"
        return HandTimeoutError(message)
