"""The XHand1 on a serial port: a thread that owns the line and always has a reading, and moves only where limits allow."""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.closable import Closable
from tgdsl.runtime.xhand1.motion import Motion, MotionLimits
from tgdsl.runtime.xhand1.wire.client import Addresses, Port, Reply, SerialClient, SerialCounters, SerialPort, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandDisconnectedError, HandError, HandTimeoutError, ProtocolError
from tgdsl.runtime.xhand1.wire.protocol import (
    JOINTS,
    PASSIVE,
    STATE_SIZE,
    Command,
    HandState,
    JointCommand,
    decode_state,
    encode_command,
)

MAX_AGE_S = 0.1  # largest age of a reading that is returned [s], unless replies may take longer
READ_TIMEOUT_S = 0.08  # how long a call waits for a new reading [s], unless replies may take longer
_RECONNECT_S = 0.02
_LAST_TRIES = 6
_PATIENCE_S = 1.0
_CLOSE_TIMEOUT_S = 5.0


@dataclass(frozen=True, eq=False)
class Reading:
    """One state of the hand."""

    sequence: int  # number of its exchange; each is larger than the previous one
    requested_at: float  # time of the request, on the clock of `time.monotonic` [s]: the state is not older
    received_at: float  # time of its arrival [s]
    state: HandState  # state that the hand reported

    def age_s(self, now: float | None = None) -> float:
        """Return how old it can be at most [s], now or at a time of `time.monotonic`."""
        return (time.monotonic() if now is None else now) - self.requested_at


class HandReader(threading.Thread):
    """Exchanges until it is stopped, and notifies `changed` of every reading and of its end."""

    def __init__(self, client: SerialClient, connect: Callable[[SerialCounters], SerialClient], motion: Motion):
        super().__init__(name="xhand1", daemon=True)
        self.changed = threading.Condition()  # lock of all that follows
        self.reading: Reading | None = None  # the newest
        self.failure: tuple[HandError, float] | None = None  # the newest, and when
        self.ended: HandClosedError | None = None  # why no more readings will come; None while they may
        self.motion = motion  # what may move
        self.counters = client.counters  # what happened on the line
        self.num_connects = 0  # how often the port was reopened
        self.left_driven: HandError | None = None  # why the hand did not confirm, at the end, that it is passive
        self._client: SerialClient | None = client
        self._connect, self._stopping, self._is_driven = connect, threading.Event(), False

    def stop(self) -> None:
        """Ask the thread to make the hand passive and to end."""
        self._stopping.set()

    def run(self) -> None:
        """Exchange until stopped."""
        reason = HandClosedError("this hand was closed")
        try:
            while not self._stopping.is_set():
                self._turn()
        except Exception as error:
            reason = HandClosedError(f"the reader ended: {error!r}")
        try:
            self._leave()
        finally:
            with self.changed:
                self.ended = reason
                self.changed.notify_all()

    def _turn(self) -> None:
        try:
            client = self._connected()
            with self.changed:
                joints = self.motion.joints(time.monotonic())
            reply = self._exchange(client, joints)
            state = _plausible(decode_state(reply.payload))
        except HandError as error:
            self._fail(error)
            return
        reading = Reading(self.counters.num_requests, reply.requested_at, reply.received_at, state)
        with self.changed:
            self.reading = reading
            self.changed.notify_all()

    def _connected(self) -> SerialClient:
        if self._client is None:
            self._client = self._connect(self.counters)
            self.num_connects += 1
        return self._client

    def _exchange(self, client: SerialClient, joints: tuple[JointCommand, ...]) -> Reply:
        is_driven = joints is not PASSIVE
        self._is_driven = self._is_driven or is_driven
        reply = client.exchange(Command.EXCHANGE, encode_command(joints), STATE_SIZE)
        self._is_driven = is_driven
        return reply

    def _fail(self, error: HandError) -> None:
        self._drop_if_gone(error)
        self._post_passive()
        with self.changed:
            self.motion.fail(error)
            self.failure = error, time.monotonic()
        if self._client is None:
            self._stopping.wait(_RECONNECT_S)

    def _leave(self) -> None:
        """Make the hand passive, if it may not be, and close the port."""
        for _ in range(_LAST_TRIES):
            if not self._is_driven:
                break
            try:
                self._exchange(self._connected(), PASSIVE)
                self.left_driven = None
            except HandError as error:
                self.left_driven = error
                self._drop_if_gone(error)
                self._post_passive()
        if self._client is not None:
            self._client.close()

    def _post_passive(self) -> None:
        """Tell a hand that moves to be passive, also where its replies cannot be understood."""
        if self._is_driven and self._client is not None:
            try:
                self._client.post(Command.EXCHANGE, encode_command(PASSIVE))
            except HandError as error:
                self._drop_if_gone(error)

    def _drop_if_gone(self, error: HandError) -> None:
        if isinstance(error, HandDisconnectedError) and self._client is not None:
            self._client.close()
            self._client = None


def _plausible(state: HandState) -> HandState:
    """Return a state, or raise an error if its numbers are impossible for a hand."""
    if state.joint_id.tolist() != list(range(len(JOINTS))):
        raise ProtocolError(f"the joints of a reply are numbered {state.joint_id.tolist()}, expected 0 to 11")
    if not np.isfinite(state.position).all():
        raise ProtocolError(f"the joint angles of a reply are {state.position.tolist()} rad, expected finite ones")
    return state


class Tare(NamedTuple):
    """What the fingertips read while nothing touches them."""

    mean: Float[np.ndarray, "finger 3"]  # mean of the frames [counts]
    spread: Float[np.ndarray, "finger 3"]  # largest less least of the frames [counts]
    num_frames: int


class XHand1(Closable):
    """A hand that is being read. Use it as a context manager, or call `close`.

    A thread exchanges with the hand all the time. Unless motion limits were given, every exchange asks for mode 0 with no gain
    and no current. With them, the hand moves only while commands keep coming; any failure on the line, a command beyond the
    limits, a missed watchdog and `close` make it passive, until `resume`.

    What this cannot do: if the process is killed or the cable is pulled, no more is sent, and what the hand then does with its
    last command is not published.
    """

    def __init__(self, reader: HandReader, timing: SerialTiming, max_age_s: float | None = None):
        self._reader = reader
        two_replies_s = 2 * timing.reply_timeout_s
        self._max_age_s = max(MAX_AGE_S, two_replies_s) if max_age_s is None else max_age_s
        self._read_timeout_s = max(READ_TIMEOUT_S, two_replies_s)
        self._patience_s = _PATIENCE_S + 2 * two_replies_s  # three requests for the version, and another
        self._last_sequence = 0
        atexit.register(self._leave)

    @classmethod
    def open(
        cls,
        device: str,
        addresses: Addresses | None = None,
        *,
        motion: MotionLimits | None = None,
        timing: SerialTiming | None = None,
        max_age_s: float | None = None,
        open_port: Callable[[str, int], Port] = SerialPort,
    ) -> XHand1:
        """Open a hand on a serial port, such as `/dev/ttyUSB0`, and wait for its first reading; without limits it is only read.

        Readings that are older than `max_age_s` are not returned; default: 0.1 s, or as long as two replies may take.

        Raises:
            HandError: If the port cannot be opened, or the hand does not answer, or not as expected.
        """
        timing = timing or SerialTiming()
        addresses = addresses or Addresses()

        def connect(counters: SerialCounters) -> SerialClient:
            return SerialClient(open_port(device, timing.baud), addresses, timing, counters)

        reader = HandReader(connect(SerialCounters()), connect, Motion(motion))
        reader.start()
        hand = cls(reader, timing, max_age_s)
        try:
            with reader.changed:
                reader.changed.wait_for(lambda: reader.reading or reader.ended, hand._patience_s)
                if reader.reading is None:
                    raise hand._why_no_reading()
        except BaseException:
            hand.close()
            raise
        return hand

    def read(self, timeout_s: float | None = None) -> Reading:
        """Return the newest reading, each once; wait for it if need be: by default 0.08 s, or as long as two replies may take.

        Raises:
            HandError: Why there is no new reading: `HandTimeoutError`, `HandClosedError` and so on.
        """
        reader, wait_s = self._reader, self._read_timeout_s if timeout_s is None else timeout_s
        with reader.changed:
            reader.changed.wait_for(lambda: self._is_new(reader.reading) or reader.ended, wait_s)
            reading = reader.reading
            if reader.ended is not None or reading is None or not self._is_new(reading):
                raise self._why_no_reading()
            self._last_sequence = reading.sequence
            return reading

    def command(self, target: Sequence[float] | Float[np.ndarray, " joint"]) -> None:
        """Set the joint angles to go to [rad]; to be called again within the watchdog's time, also to stay there.

        Raises:
            MotionError: If the hand was opened for reading alone, was stopped, or a target is outside its range.
            WatchdogError: If the last command is too long ago.
            HandClosedError: If the hand was closed.
        """
        reader, now = self._reader, time.monotonic()
        with reader.changed:
            if reader.ended is not None:
                raise reader.ended
            reading = reader.reading
            is_known = reading is not None and reading.age_s(now) <= self._max_age_s
            measured = reading.state.position.astype(np.float64) if reading and is_known else None
            reader.motion.command(np.asarray(target, dtype=np.float64), now, measured)

    def relax(self) -> None:
        """Make the hand passive until the next command; one that was stopped stays so until `resume`."""
        with self._reader.changed:
            self._reader.motion.relax()

    def resume(self) -> None:
        """Allow commands again after the hand was stopped; it stays passive until the next command."""
        with self._reader.changed:
            self._reader.motion.resume()

    @property
    def stopped(self) -> HandError | None:
        """Why the hand was stopped and is passive; None if it was not."""
        with self._reader.changed:
            return self._reader.motion.stopped

    @property
    def watchdog_s(self) -> float | None:
        """Time within which commands must follow one another [s]; None if the hand was opened for reading alone."""
        limits = self._reader.motion.limits
        return None if limits is None else limits.watchdog_s

    @property
    def counters(self) -> SerialCounters:
        """What happened on the line so far."""
        return replace(self._reader.counters)

    @property
    def num_reconnects(self) -> int:
        """How often the port went away and was reopened."""
        return self._reader.num_connects

    def tare(self, num_frames: int = 20) -> Tare:
        """Return what the fingertips read now, while nothing touches them. Nothing is sent to the hand for it.

        Raises:
            HandError: If a reading fails, a force is at the end of its range, or fewer than 5 frames are asked for.
        """
        if num_frames < 5:
            raise HandError(f"a tare over {num_frames} frames, expected at least 5")
        states = [self.read().state for _ in range(num_frames)]
        if any(state.is_total_saturated.any() for state in states):
            raise HandError("a fingertip's force is at the end of its range; nothing may touch the hand while it is tared")
        forces = np.array([state.total_force for state in states], dtype=np.float64)
        return Tare(forces.mean(axis=0), np.ptp(forces, axis=0), num_frames)

    def close(self) -> None:
        """Make the hand passive, if it is not, and release the port.

        Raises:
            HandError: If the hand was moving and did not confirm that it is passive.
        """
        self._leave()
        if self._reader.is_alive():
            problem = f"the hand's reader did not end within {_CLOSE_TIMEOUT_S:g} s"
            raise HandError(f"{problem}: switch the hand's power off if it moves")
        if (error := self._reader.left_driven) is not None:
            raise HandError(f"the hand did not confirm that it is passive: switch its power off ({error})") from error

    def _is_new(self, reading: Reading | None) -> bool:
        return reading is not None and reading.sequence > self._last_sequence and reading.age_s() <= self._max_age_s

    def _why_no_reading(self) -> HandError:
        reading, failure = self._reader.reading, self._reader.failure
        if self._reader.ended is not None:
            return self._reader.ended
        if failure is not None and (reading is None or failure[1] > reading.received_at):
            return type(failure[0])(str(failure[0]))
        if reading is None:
            return HandTimeoutError("the hand has not answered yet")
        return HandTimeoutError(f"no new reading came in time; the newest is {1e3 * reading.age_s():.0f} ms old")

    def _leave(self) -> None:
        atexit.unregister(self._leave)
        self._reader.stop()
        self._reader.join(_CLOSE_TIMEOUT_S)
