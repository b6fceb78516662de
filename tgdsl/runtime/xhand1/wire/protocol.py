"""The XHand1's serial protocol: frames, their checksum, the search for them in a stream of bytes, and what they carry.

A frame is `55 AA | source | destination | command | length u16 | payload | crc u16`, all little-endian; the checksum is
CRC-16/XMODEM over all that stands before it. The exchange (command 0x02) is the only request whose reply is known. It carries a
set-point for every joint, so to read is also to command: `PASSIVE` is the command that asks nothing.

Source: the facts that a republished vendor header, a PNDbotics wiki and an open driver tested on hardware agree on. Our
assumptions, where they leave something open, are marked *unverified*: the payloads of every command but the exchange, and the
addresses in replies.

Shapes: `joint` the 12 joints by their id, `finger` thumb, index, middle, ring, pinky; `taxel` the 120 of a fingertip.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from tgdsl.runtime.xhand1.wire.errors import ProtocolError

HEADER = b"\x55\xaa"
HOST_ADDRESS = 0xFE
HAND_ADDRESS = 0x80  # a hand's address is this with its id in the low seven bits
HEAD_SIZE = 7
OVERHEAD = HEAD_SIZE + 2
MAX_PAYLOAD = 8224
FIRMWARE_COMMANDS = frozenset({0xA1, 0xA2, 0xA3, 0xA4, 0xB0})  # they write firmware, and are never sent


class Command(IntEnum):
    """Commands that are sent or answered, by name."""

    ERROR = 0x00
    EXCHANGE = 0x02
    VERSION = 0x13
    READ_REGISTER = 0x15


class Register(IntEnum):
    """Registers that say which hand it is."""

    SIDE = 20
    SERIAL_NUMBER = 21
    HAND_ID = 53
    NAME = 54


@dataclass(frozen=True)
class Frame:
    """One frame, without header, length and checksum."""

    source: int  # address of who sent it
    destination: int  # address of whom it is for
    command: int  # what it asks or answers: a `Command`, or a number that has no name here
    payload: bytes = b""  # at most `MAX_PAYLOAD`


def hand_address(hand_id: int) -> int:
    """Return the address of a hand, whose id is 0 to 127."""
    if not 0 <= hand_id < 0x80:
        raise ProtocolError(f"hand id {hand_id}: expected 0 to 127")
    return HAND_ADDRESS | hand_id


def crc16(data: bytes | bytearray | memoryview) -> int:
    """Return CRC-16/XMODEM: polynomial 0x1021, start 0, not reflected, no final exclusive or."""
    return binascii.crc_hqx(data, 0)


def encode_frame(frame: Frame) -> bytes:
    """Return a frame's bytes; a command that writes firmware is refused."""
    if frame.command in FIRMWARE_COMMANDS:
        raise ProtocolError(f"command {frame.command:#04x} writes firmware; it is never sent")
    head = struct.pack("<2sBBBH", HEADER, frame.source, frame.destination, frame.command, len(frame.payload))
    body = head + frame.payload
    return body + struct.pack("<H", crc16(body))


_SLICE = 4096


class FrameParser:
    """Takes bytes as they come and gives the frames whose checksum is right.

    The frames depend on the bytes alone, not on how they were split. A header without a valid frame costs one byte: the
    search continues right behind it, and so finds a frame inside an apparent one. The buffer holds at most one frame of the
    largest size and one slice of 4 KiB.
    """

    def __init__(self) -> None:
        self.num_discarded = 0  # bytes so far that belonged to no frame
        self.num_trailing = 0  # number of them after the last frame
        self._buffer = bytearray()

    @property
    def num_buffered(self) -> int:
        """Bytes that wait for the rest of a frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes and return the frames that they complete, in order."""
        frames: list[Frame] = []
        for start in range(0, len(data), _SLICE):
            self._buffer += data[start : start + _SLICE]
            frames += self._scan(is_end=False)
        return frames

    def flush(self) -> list[Frame]:
        """Give up waiting, because the line fell silent; return the frames that hid behind what looked like a longer one."""
        return self._scan(is_end=True)

    def _scan(self, is_end: bool) -> list[Frame]:
        frames: list[Frame] = []
        buffer, at = self._buffer, 0
        while (start := buffer.find(HEADER, at)) >= 0:
            self._discard(start - at)
            at, size = start, _size(buffer, start)
            is_whole = start + size <= len(buffer)
            if not is_whole and not is_end:
                break
            raw = bytes(buffer[start : start + size])
            if is_whole and size and crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little"):
                frames.append(Frame(*raw[2:5], payload=raw[HEAD_SIZE:-2]))
                self.num_trailing = 0
                at += size
            else:
                self._discard(1)
                at += 1
        if start < 0:
            end = len(buffer) - (not is_end and buffer.endswith(HEADER[:1], at))
            self._discard(end - at)
            at = end
        del buffer[:at]
        return frames

    def _discard(self, count: int) -> None:
        self.num_discarded += count
        self.num_trailing += count


def _size(buffer: bytearray, start: int) -> int:
    """Return how many bytes must be there to go on: of the head, or of the whole frame; 0 if no frame is as long."""
    if len(buffer) < start + HEAD_SIZE:
        return HEAD_SIZE
    length = int.from_bytes(buffer[start + HEAD_SIZE - 2 : start + HEAD_SIZE], "little")
    return OVERHEAD + length if length <= MAX_PAYLOAD else 0


NUM_JOINTS = 12
NUM_TAXELS = 120
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
JOINTS = (
    *("thumb_bend_joint", "thumb_rota_joint1", "thumb_rota_joint2", "index_bend_joint", "index_joint1", "index_joint2"),
    *("mid_joint1", "mid_joint2", "ring_joint1", "ring_joint2", "pinky_joint1", "pinky_joint2"),
)
"""The joints' names by id, without the `right_hand_` or `left_hand_` that they have in robot files."""


class Mode(IntEnum):
    """What a joint's drive does."""

    PASSIVE = 0
    POSITION = 3
    FORCE = 5


class JointCommand(NamedTuple):
    """What one joint's drive shall do."""

    position: float = 0.0  # set-point [rad]
    kp: int = 0  # proportional gain [hand's unit]
    ki: int = 0  # integral gain [hand's unit]
    kd: int = 0  # derivative gain [hand's unit]
    current_limit: int = 0  # largest motor current [mA]
    mode: int = Mode.PASSIVE  # what the drive does


_JOINT_COMMAND = struct.Struct("<Hhhhf6H")
COMMAND_SIZE = NUM_JOINTS * _JOINT_COMMAND.size
PASSIVE = (JointCommand(),) * NUM_JOINTS  # mode 0, no gain, no current: the request that reads, and asks no joint to move


def encode_command(joints: Sequence[JointCommand]) -> bytes:
    """Return the exchange's request, 288 bytes, of one command per joint in the order of their ids."""
    if len(joints) != NUM_JOINTS:
        raise ProtocolError(f"{len(joints)} joint commands, expected {NUM_JOINTS}")
    parts = []
    for i, joint in enumerate(joints):
        position, kp, ki, kd, current_limit, mode = joint
        if not math.isfinite(position):
            raise ProtocolError(f"joint {i}: position is {position}, expected a finite angle in rad")
        try:
            parts.append(_JOINT_COMMAND.pack(i, kp, ki, kd, position, current_limit, mode, 0, 0, 0, 0))
        except (struct.error, OverflowError) as error:
            raise ProtocolError(f"joint {i}: {joint} does not fit the protocol's fields: {error}") from error
    return b"".join(parts)


def decode_command(payload: bytes) -> tuple[JointCommand, ...]:
    """Return the joint commands of an exchange's request."""
    _expect_size("a command", payload, COMMAND_SIZE)
    joints = []
    for i, (id_, kp, ki, kd, position, current_limit, mode, *_) in enumerate(_JOINT_COMMAND.iter_unpack(payload)):
        if id_ != i:
            raise ProtocolError(f"joint command {i} is of joint {id_}")
        joints.append(JointCommand(position, kp, ki, kd, current_limit, mode))
    return tuple(joints)


_FORCE = np.dtype([("x", "i1"), ("y", "i1"), ("z", "u1")])
_JOINT = np.dtype(
    [("joint_id", "u1"), ("sensor_id", "u1"), ("position", "<f4"), ("current", "<u2"), ("raw_position", "<u2")]
    + [("joint_temperature", "<u2"), ("joint_error", "<u2", (3,)), ("reserved", "<u2", (3,))]
)
_TIP = np.dtype(
    [("total_force", _FORCE), ("taxel_force", _FORCE, (NUM_TAXELS,)), ("taxel_temperature", "u1", (20,))]
    + [("total_temperature", "u1")]
)
_STATE = np.dtype([("joint", _JOINT, (NUM_JOINTS,)), ("tip", _TIP, (len(FINGERS),))])
STATE_SIZE = _STATE.itemsize
_PARTS = [(part, name) for part in ("joint", "tip") for name in _STATE[part].base.names or ()]
_FORCES = ("total_force", "taxel_force")
FORCE_MIN = np.array([-128, -128, 0])
FORCE_MAX = np.array([127, 127, 255])  # what a force component can hold [counts]


@dataclass(frozen=True, eq=False)
class HandState:
    """The reply to an exchange: what the hand says of itself. Forces are in counts, whose unit is not published."""

    joint_id: UInt8[np.ndarray, " joint"]  # id that each joint gives itself
    sensor_id: UInt8[np.ndarray, " joint"]  # meaning not published
    position: Float[np.ndarray, " joint"]  # joint angles [rad]
    current: UInt16[np.ndarray, " joint"]  # motor current [mA]
    raw_position: UInt16[np.ndarray, " joint"]  # encoder counts
    joint_temperature: UInt16[np.ndarray, " joint"]  # its low byte is in °C; the high byte's meaning is not published
    joint_error: UInt16[np.ndarray, "joint 3"]  # codes of the communication, joint and fingertip boards; 0 is none
    reserved: UInt16[np.ndarray, "joint 3"]  # three words without published meaning
    total_force: Int[np.ndarray, "finger 3"]  # fingertip force as the hand itself sums it up [counts]
    taxel_force: Int[np.ndarray, "finger taxel 3"]  # force of each taxel [counts]
    taxel_temperature: UInt8[np.ndarray, "finger 20"]  # 20 thermometers of each fingertip [°C]
    total_temperature: UInt8[np.ndarray, " finger"]  # the fingertip's own temperature [°C]

    @property
    def is_total_saturated(self) -> Bool[np.ndarray, "finger 3"]:
        """Whether a component of the fingertip's force is at the end of its range, so that it may stand for more."""
        return saturated(self.total_force)

    @property
    def is_taxel_saturated(self) -> Bool[np.ndarray, "finger taxel 3"]:
        """Whether a component of a taxel's force is at the end of its range."""
        return saturated(self.taxel_force)


def saturated(force: Int[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch 3"]:
    """Return which components are at the end of their range: 127 or more either way for x and y, 255 for z."""
    return np.greater_equal(abs(force), FORCE_MAX)


def decode_state(payload: bytes) -> HandState:
    """Return the state that an exchange's reply of 2208 bytes holds, value for value."""
    _expect_size("a state", payload, STATE_SIZE)
    record = np.frombuffer(payload, dtype=_STATE)[0]
    values = {name: record[part][name] for part, name in _PARTS}
    for name in _FORCES:
        values[name] = np.stack([values[name][axis].astype(np.int16) for axis in "xyz"], axis=-1)
        values[name].setflags(write=False)
    return HandState(**values)


def encode_state(state: HandState) -> bytes:
    """Return a state's 2208 bytes."""
    record = np.zeros((), dtype=_STATE)
    for part, name in _PARTS:
        value = getattr(state, name)
        if name not in _FORCES:
            record[part][name] = value
            continue
        if ((value < FORCE_MIN) | (value > FORCE_MAX)).any():
            label = name.replace("_", " ")
            raise ProtocolError(f"{label}s from {value.min()} to {value.max()}: expected x, y in -128…127, z in 0…255")
        for i, axis in enumerate("xyz"):
            record[part][name][axis] = value[..., i]
    return record.tobytes()


def encode_register_request(number: int) -> bytes:
    """Return the payload that asks for a register: its number as u16 (*unverified*)."""
    return struct.pack("<H", number)


def _expect_size(what: str, payload: bytes, size: int) -> None:
    if len(payload) != size:
        raise ProtocolError(f"{what} of {len(payload)} bytes, expected {size}")
