"""Text that is drawn over itself on a terminal."""

from __future__ import annotations

import sys
import time
from typing import TextIO


class LiveTable:
    """A table that is drawn over itself on a terminal; elsewhere only its last state is printed."""

    def __init__(self, stream: TextIO | None = None, period: float = 0.1):
        """Draw to a stream (default: standard output), at most once per period [s]."""
        self._stream = stream or sys.stdout
        self._period = period
        self._drawn = 0
        self._last = 0.0

    def show(self, lines: list[str], is_last: bool = False) -> None:
        """Draw the table if it is time to, or if it is the last one."""
        is_terminal = self._stream.isatty()
        if not is_last and (not is_terminal or time.monotonic() - self._last < self._period):
            return
        self._last = time.monotonic()
        if is_terminal and self._drawn:
            self._stream.write(f"\x1b[{self._drawn}A\x1b[J")
        self._stream.write("\n".join(lines) + "\n")
        self._stream.flush()
        self._drawn = len(lines)
