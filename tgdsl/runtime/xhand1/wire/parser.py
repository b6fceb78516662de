"""From a stream of bytes, cut anywhere and with anything in between, to frames."""

from __future__ import annotations

from tgdsl.runtime.xhand1.wire.protocol import HEAD_SIZE, HEADER, MAX_PAYLOAD, OVERHEAD, Frame, crc16

_SLICE = 4096


class FrameParser:
    """Takes bytes as they come and gives the frames whose checksum is right.

    What is found depends on the bytes alone, not on how they were cut. A header that leads to no frame costs one byte: the
    search goes on right behind it, so that a frame that hides in what looked like another is found. At most one frame of the
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
