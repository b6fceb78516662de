"""The XHand1's serial line: packets, checksums, replies, ports."""
