"""An emulated hand: it takes frames and gives frames, on a pseudo-terminal that opens like a serial port. POSIX only.

Its body says how joints move and what fingertips feel. Shapes: `joint`, `finger` and `taxel` as in `protocol`.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.closable import Closable
from tgdsl.runtime.xhand1.wire.client import BAUD
from tgdsl.runtime.xhand1.wire.errors import HandError, ProtocolError
from tgdsl.runtime.xhand1.wire.protocol import (
    FINGERS,
    FORCE_MAX,
    FORCE_MIN,
    NUM_JOINTS,
    NUM_TAXELS,
    OVERHEAD,
    PASSIVE,
    Command,
    Frame,
    FrameParser,
    HandState,
    JointCommand,
    Mode,
    Register,
    decode_command,
    encode_frame,
    encode_state,
    hand_address,
)

VERSION = b"tgdsl emulator"
_ROOM_TEMPERATURE = 25
_COUNTS_PER_TURN = 4096
_IDLE_S = 0.05
_KEPT_REQUESTS = 20_000
_BYTE_S = 10 / BAUD  # 10 bits carry a byte
_CHUNK = 124  # bytes that come out of the line at a time: 0.4 ms at 3 Mbaud


class TipForces(NamedTuple):
    """What the fingertips feel [counts]; rounded and cut to a byte, as a sensor would."""

    total: Float[np.ndarray, "finger 3"]  # force of each fingertip
    taxel: Float[np.ndarray, "finger taxel 3"]  # force of each taxel

    @classmethod
    def zero(cls) -> TipForces:
        """Return fingertips that feel nothing."""
        return cls(np.zeros((len(FINGERS), 3)), np.zeros((len(FINGERS), NUM_TAXELS, 3)))


class Body:
    """Joints and fingertips; these stay at zero and feel nothing."""

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Take the joints' commands at a time [s]."""

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return the joint angles [rad] and the fingertips' forces at that time [s]; called once per state."""
        return np.zeros(NUM_JOINTS), TipForces.zero()


def is_driven(joint: JointCommand) -> bool:
    """Return whether a drive goes to its set-point: with the mode for it, a gain and a current."""
    return joint.mode == Mode.POSITION and joint.kp > 0 and joint.current_limit > 0


class EmulatedHand:
    """The hand behind the line."""

    def __init__(self, hand_id: int = 0, body: Body | None = None):
        """Switch it on."""
        self.address = hand_address(hand_id)
        self.commands: tuple[JointCommand, ...] = PASSIVE  # the last ones of its joints
        self.position: Float[np.ndarray, " joint"] = np.zeros(NUM_JOINTS)  # joint angles that it last sent [rad]
        self.registers: dict[int, bytes] = {Register.HAND_ID: bytes([hand_id]), Register.NAME: b"emulated"}
        self._body = body or Body()

    @property
    def is_passive(self) -> bool:
        """Whether the last commands hold or move no joint."""
        return all(joint.mode == Mode.PASSIVE and not joint.kp and not joint.current_limit for joint in self.commands)

    def answer(self, frame: Frame, now: float) -> Frame | None:
        """Return the hand's reply to a frame at a time [s]; None if it is for another."""
        if frame.destination != self.address:
            return None
        try:
            command, payload = self._answer(frame, now)
        except ProtocolError:
            command, payload = Command.ERROR, bytes([frame.command])
        return Frame(self.address, frame.source, command, payload)

    def _answer(self, frame: Frame, now: float) -> tuple[int, bytes]:
        if frame.command == Command.EXCHANGE:
            commands = decode_command(frame.payload)
            self._body.command(now, commands)
            self.position, forces = self._body.felt(now)
            self.commands = commands
            return frame.command, encode_state(self._state(forces))
        if frame.command == Command.VERSION:
            return frame.command, VERSION
        number = int.from_bytes(frame.payload, "little")
        if frame.command == Command.READ_REGISTER and number in self.registers:
            return frame.command, self.registers[number]
        return Command.ERROR, bytes([frame.command])

    def _state(self, forces: TipForces) -> HandState:
        setpoint, gain, limit = np.array([(joint.position, joint.kp, joint.current_limit) for joint in self.commands]).T
        raw_position = np.round(self.position * _COUNTS_PER_TURN / (2 * math.pi)).astype(np.int64) % 0x10000
        return HandState(
            joint_id=np.arange(NUM_JOINTS, dtype=np.uint8),
            sensor_id=np.zeros(NUM_JOINTS, dtype=np.uint8),
            position=self.position.astype(np.float32),
            current=np.minimum(abs((setpoint - self.position) * gain), limit).astype(np.uint16),
            raw_position=raw_position.astype(np.uint16),
            joint_temperature=np.full(NUM_JOINTS, _ROOM_TEMPERATURE, dtype=np.uint16),
            joint_error=np.zeros((NUM_JOINTS, 3), dtype=np.uint16),
            reserved=np.zeros((NUM_JOINTS, 3), dtype=np.uint16),
            total_force=_counts(forces.total),
            taxel_force=_counts(forces.taxel),
            taxel_temperature=np.full((len(FINGERS), 20), _ROOM_TEMPERATURE, dtype=np.uint8),
            total_temperature=np.full(len(FINGERS), _ROOM_TEMPERATURE, dtype=np.uint8),
        )


def _counts(force: Float[np.ndarray, "*batch 3"]) -> np.ndarray:
    return np.clip(np.round(force), FORCE_MIN, FORCE_MAX).astype(np.int16)


class EmulatedLine:
    """The line between a host and an emulated hand: bytes in, bytes out at the speed of its baud rate. Time is passed in."""

    def __init__(self, hand: EmulatedHand, *, turnaround_s: float = 0.0002):
        """Connect a hand that answers `turnaround_s` after a request's last byte [s], on a line of `BAUD`."""
        self.hand = hand
        self.requests: deque[tuple[float, Frame]] = deque(maxlen=_KEPT_REQUESTS)  # the latest that arrived, and when [s]
        self._turnaround_s = turnaround_s
        self.cut()

    def hear(self, data: bytes, now: float) -> None:
        """Take bytes that the host has sent; the hand answers its requests."""
        for frame in self._parser.feed(data):
            self.requests.append((now, frame))
            self.answer(frame, now + (OVERHEAD + len(frame.payload)) * _BYTE_S)

    def answer(self, frame: Frame, arrived_at: float) -> None:
        """Let the hand answer a request that arrived at a time [s]."""
        if (reply := self.hand.answer(frame, arrived_at)) is not None:
            self.send(encode_frame(reply), arrived_at + self._turnaround_s)

    def send(self, raw: bytes, ready_at: float) -> None:
        """Queue bytes for the line, sent at `ready_at` [s] or after all queued bytes.

        Bytes that follow others without a gap join their chunk, so that reads do not reveal the boundary.
        """
        start = max(ready_at, self._free_at)
        if self._chunks and start == self._free_at and len(self._chunks[-1][1]) < _CHUNK:
            _, begun = self._chunks.pop()
            start -= len(begun) * _BYTE_S
            raw = begun + raw
        for at in range(0, len(raw), _CHUNK):
            chunk = raw[at : at + _CHUNK]
            self._chunks.append((start + (at + len(chunk)) * _BYTE_S, chunk))
        self._free_at = start + len(raw) * _BYTE_S

    def due(self, now: float) -> bytes:
        """Return, and forget, the bytes that have reached the host by now."""
        out = []
        while self._chunks and self._chunks[0][0] <= now:
            out.append(self._chunks.popleft()[1])
        return b"".join(out)

    def next_due(self) -> float | None:
        """Return when more reaches it [s], or None if nothing is on its way."""
        return self._chunks[0][0] if self._chunks else None

    def cut(self) -> None:
        """Lose all bytes on their way, in both directions."""
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._free_at = 0.0
        self._parser = FrameParser()


class Emulator(Closable):
    """A thread that lets an emulated hand answer on a pseudo-terminal, as fast as a line of its baud rate would."""

    def __init__(self, hand: EmulatedHand | None = None, *, line: EmulatedLine | None = None):
        """Plug a hand in, by default one with id 0 that feels nothing, or a line with a hand, and switch it on."""
        self.line = line or EmulatedLine(hand or EmulatedHand())
        self.num_lost_bytes = 0  # that nobody read in time
        self.failure: Exception | None = None  # the error that ended its thread; the port is then gone
        self._folder = tempfile.TemporaryDirectory(prefix="xhand1-")
        self.device = str(Path(self._folder.name) / "ttyXHAND1")
        self._ends: tuple[int, int] | None = None
        self._lock, self._is_serving = threading.Lock(), True
        self._plug()
        self._thread = threading.Thread(target=self._run, name="xhand1-emulator", daemon=True)
        self._thread.start()

    @property
    def hand(self) -> EmulatedHand:
        return self.line.hand

    @property
    def requests(self) -> deque[tuple[float, Frame]]:
        """The latest requests that arrived, with the time of `time.monotonic` [s]."""
        return self.line.requests

    def check(self) -> None:
        """Raise the error that ended its thread, if one did."""
        if self.failure is not None:
            raise HandError(f"the emulator's thread ended: {self.failure!r}") from self.failure

    def close(self) -> None:
        """Switch the hand off and remove the port; raise the error that ended its thread before, if one did."""
        if self._is_serving:
            self._is_serving = False
            self._thread.join()
            self._unplug()
            self._folder.cleanup()
            self.check()

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
            self.line.cut()

    def _run(self) -> None:
        try:
            while self._is_serving:
                self._turn()
        except Exception as error:
            with self._lock:
                self.failure = error
                self._unplug()

    def _turn(self) -> None:
        """Wait until bytes come or are due; then take and give them."""
        with self._lock:
            ends, next_due = self._ends, self.line.next_due()
        wait = _IDLE_S if next_due is None else max(next_due - time.monotonic(), 0.0)
        ready: list[int] = []
        with contextlib.suppress(OSError):  # the cable was pulled meanwhile
            ready = select.select([*(ends or ())[:1]], [], [], min(wait, _IDLE_S))[0]
        with self._lock:
            if self._ends is None:
                return
            if self._ends[0] in ready:
                data = b""
                with contextlib.suppress(OSError):
                    data = os.read(self._ends[0], 65536)
                self.line.hear(data, time.monotonic())
            if data := self.line.due(time.monotonic()):
                sent = 0
                with contextlib.suppress(OSError):
                    sent = os.write(self._ends[0], data)
                self.num_lost_bytes += len(data) - sent
