"""The XHand1's serial protocol: frames, their checksum, and the search for them in a stream of bytes.

A frame is `55 AA | source | destination | command | length u16 | payload | crc u16`, all little-endian; the checksum is
CRC-16/XMODEM over all that stands before it. Source: the facts that a republished vendor header, a PNDbotics wiki and an open
driver tested on hardware agree on. Our assumptions, where they leave something open, are marked *unverified* below:
the payloads of every command but the exchange, and the addresses in replies.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum

from tgdsl.runtime.xhand1.wire.errors import ProtocolError

HEADER = b"\x55\xaa"
HOST_ADDRESS = 0xFE
HAND_ADDRESS = 0x80  # a hand's address is this with its id in the low seven bits
HEAD_SIZE = 7
OVERHEAD = HEAD_SIZE + 2
MAX_PAYLOAD = 8224

FIRMWARE_COMMANDS = frozenset({0xA1, 0xA2, 0xA3, 0xA4, 0xB0})  # commands that write firmware: they are never sent


class Command(IntEnum):
    """Commands by name."""

    ERROR = 0x00
    EXCHANGE = 0x02
    READ_PARAMETERS = 0x03
    WRITE_PARAMETERS = 0x04
    SAVE = 0x05
    READ_LOOP_PARAMETERS = 0x06
    WRITE_LOOP_PARAMETERS = 0x07
    SET_MODE = 0x08
    READ_MODE = 0x09
    QUERY_PRESSURE = 0x11
    CLEAR_PRESSURE = 0x12
    VERSION = 0x13
    RESET = 0x14
    READ_REGISTER = 0x15
    WRITE_REGISTER = 0x16
    CALIBRATE = 0x17


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
    payload: bytes = b""  # its bytes, at most `MAX_PAYLOAD`


def hand_address(hand_id: int) -> int:
    """Return the address of a hand, whose id is 0 to 127."""
    if not 0 <= hand_id < 0x80:
        raise ProtocolError(f"hand id {hand_id}: expected 0 to 127")
    return HAND_ADDRESS | hand_id


def crc16(data: bytes | bytearray | memoryview) -> int:
    """Return CRC-16/XMODEM: polynomial 0x1021, start 0, not reflected, no final exclusive or."""
    return binascii.crc_hqx(data, 0)


def encode_frame(frame: Frame) -> bytes:
    """Return a frame's bytes.

    Raises:
        ProtocolError: If a number does not fit a byte, the payload is too long, or the command writes firmware.
    """
    for name, value in (("source", frame.source), ("destination", frame.destination), ("command", frame.command)):
        if not 0 <= value <= 0xFF:
            raise ProtocolError(f"{name} is {value}, expected 0 to 255")
    if len(frame.payload) > MAX_PAYLOAD:
        raise ProtocolError(f"the payload has {len(frame.payload)} bytes, expected at most {MAX_PAYLOAD}")
    if frame.command in FIRMWARE_COMMANDS:
        raise ProtocolError(f"command {frame.command:#04x} writes firmware; it is never sent")
    head = struct.pack("<2sBBBH", HEADER, frame.source, frame.destination, frame.command, len(frame.payload))
    body = head + frame.payload
    return body + struct.pack("<H", crc16(body))


_SLICE = 4096


class FrameParser:
    """Takes bytes as they come and gives the frames whose checksum is right.

    The frames depend on the bytes alone, not on how they were cut. A header that leads to no frame costs one byte: the
    search goes on right behind it, so that it finds a frame inside what looked like another. At most one frame of the
    largest size and one slice of 4 KiB are kept.

    Attributes:
        num_discarded: Bytes so far that belonged to no frame.
        num_trailing: Those of them that came after the last frame.
    """

    def __init__(self) -> None:
        self.num_discarded = self.num_trailing = 0
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
            frame = _frame(buffer, start, size) if is_whole else None
            if frame is None:
                self._discard(1)
                at += 1
            else:
                frames.append(frame)
                self.num_trailing = 0
                at += size
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


def _frame(buffer: bytearray, start: int, size: int) -> Frame | None:
    """Return the frame of this size that starts here, or None if its checksum is wrong."""
    if not size:
        return None
    raw = bytes(buffer[start : start + size])
    if crc16(raw[:-2]) != int.from_bytes(raw[-2:], "little"):
        return None
    source, destination, command = raw[2:5]
    return Frame(source, destination, command, raw[HEAD_SIZE:-2])
