"""The XHand1's serial line: bytes, frames, replies, ports."""
