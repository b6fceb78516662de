"""The thread that owns the line: one exchange after another, so that there is always a reading, and one that knows its age."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tgdsl.runtime.xhand1.motion import Motion
from tgdsl.runtime.xhand1.wire.client import Reply, SerialClient, SerialCounters
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandDisconnectedError, HandError, ProtocolError
from tgdsl.runtime.xhand1.wire.payloads import (
    JOINTS,
    PASSIVE,
    STATE_SIZE,
    HandState,
    JointCommand,
    decode_state,
    encode_command,
)
from tgdsl.runtime.xhand1.wire.protocol import Command

_RECONNECT_S = 0.02
_LAST_TRIES = 6


@dataclass(frozen=True, eq=False)
class Reading:
    """One state of the hand.

    Attributes:
        sequence: Number of the exchange that brought it; each is larger than the one before.
        requested_at: When it was asked for, on the clock of `time.monotonic` [s]: what it says is not older than this.
        received_at: When it was here [s].
        state: What the hand said.
    """

    sequence: int
    requested_at: float
    received_at: float
    state: HandState

    def age_s(self, now: float | None = None) -> float:
        """Return how old it can be at most [s], now or at a time of `time.monotonic`."""
        return (time.monotonic() if now is None else now) - self.requested_at


class HandReader(threading.Thread):
    """Exchanges without end, and notifies `changed` of every reading and failure.

    Attributes:
        changed: Lock of all that follows.
        reading: The newest reading, or None.
        failure: The newest failure, and when; None if there was none.
        ended: Why no more readings will come; None while they may.
        motion: What may move, or None.
        counters: What happened on the line.
        num_connects: How often the port was reopened.
        left_driven: Why the hand did not confirm, at the end, that it is passive; None if it did or never moved.
    """

    def __init__(self, client: SerialClient, connect: Callable[[SerialCounters], SerialClient], motion: Motion | None):
        super().__init__(name="xhand1", daemon=True)
        self.changed = threading.Condition()
        self.reading: Reading | None = None
        self.failure: tuple[HandError, float] | None = None
        self.ended: HandClosedError | None = None
        self.motion = motion
        self.counters = client.counters
        self.num_connects = 0
        self.left_driven: HandError | None = None
        self._client: SerialClient | None = client
        self._connect = connect
        self._stopping = threading.Event()
        self._is_driven = False

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
            if self._client is None:
                self._client = self._connect(self.counters)
                self.num_connects += 1
            with self.changed:
                joints = PASSIVE if self.motion is None else self.motion.joints(time.monotonic())
            reply = self._exchange(self._client, joints)
            state = _plausible(decode_state(reply.payload))
        except HandError as error:
            self._fail(error)
            return
        reading = Reading(self.counters.num_requests, reply.requested_at, reply.received_at, state)
        with self.changed:
            self.reading = reading
            self.changed.notify_all()

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
            if self.motion is not None:
                self.motion.fail(error)
            self.failure = error, time.monotonic()
            self.changed.notify_all()
        if self._client is None:
            self._stopping.wait(_RECONNECT_S)

    def _leave(self) -> None:
        """Make the hand passive, if it may not be, and close the port."""
        for _ in range(_LAST_TRIES):
            if not self._is_driven:
                break
            try:
                if self._client is None:
                    self._client = self._connect(self.counters)
                self._exchange(self._client, PASSIVE)
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
    """Return a state, or raise an error if its numbers cannot be those of a hand."""
    if state.joint_id.tolist() != list(range(len(JOINTS))):
        raise ProtocolError(f"the joints of a reply are numbered {state.joint_id.tolist()}, expected 0 to 11")
    if not np.isfinite(state.position).all():
        raise ProtocolError(f"the joint angles of a reply are {state.position.tolist()} rad, expected finite ones")
    return state
