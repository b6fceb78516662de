"""Oracles of the XHand1's protocol that share no code with it: a bitwise checksum, and a parser that sees the whole stream."""

from functools import lru_cache

MAX_PAYLOAD = 8224


@lru_cache(maxsize=256)
def bitwise_crc16(data: bytes) -> int:
    """Return CRC-16/XMODEM by long division, one bit at a time."""
    register = 0
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1) ^ 0x1021 if register & 0x8000 else register << 1
        register &= 0xFFFF
    return register


def frame_bytes(source: int, destination: int, command: int, payload: bytes) -> bytes:
    """Return a frame's bytes, whatever its command."""
    head = bytes([0x55, 0xAA, source, destination, command]) + len(payload).to_bytes(2, "little")
    return head + payload + bitwise_crc16(head + payload).to_bytes(2, "little")


def frames_of(stream: bytes) -> list[tuple[int, int, int, bytes]]:
    """Return the frames of a whole stream, leftmost first and none within another, as (source, destination, command, payload)."""
    found, at = [], 0
    while at + 9 <= len(stream):
        length = int.from_bytes(stream[at + 5 : at + 7], "little")
        end = at + 9 + length
        if (
            stream[at : at + 2] == b"\x55\xaa"
            and length <= MAX_PAYLOAD
            and end <= len(stream)
            and bitwise_crc16(stream[at : end - 2]).to_bytes(2, "little") == stream[end - 2 : end]
        ):
            found.append((stream[at + 2], stream[at + 3], stream[at + 4], stream[at + 7 : end - 2]))
            at = end
        else:
            at += 1
    return found
