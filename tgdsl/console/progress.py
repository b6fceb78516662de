"""Progress of long work: the caller passes a function that takes the name of each job."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

LINE_PERIOD = 5.0  # time between lines where there is no terminal [s]
Progress = Callable[[str], None]  # called with the next job, such as "object mug: distance grid"


def silent(what: str) -> None:
    """Ignore the job."""


class StatusLine:
    """The current job: on a terminal one line that is wiped at the end; elsewhere a line every few seconds."""

    def __init__(self, stream: TextIO | None = None, period: float | None = None):
        """Write to a stream (default: standard error); where it is no terminal, at most once per period [s]."""
        self._stream, self._period = stream or sys.stderr, LINE_PERIOD if period is None else period
        self._is_shown = self._stream.isatty()
        self._what = ""
        self._is_over = threading.Event()
        self._printer: threading.Thread | None = None

    def __call__(self, what: str) -> None:
        """Show the current job instead of the last one."""
        if self._is_shown:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write(f"\r\x1b[K{what[:width]}")
            self._stream.flush()
            return
        self._what = what
        if self._printer is None:
            self._printer = threading.Thread(target=self._print_lines, daemon=True)
            self._printer.start()

    def _print_lines(self) -> None:
        """Print the current job once per period, if it is another one than before: a job may block its own thread for long."""
        last = ""
        while not self._is_over.wait(self._period):
            if self._what != last:
                last = self._what
                self._stream.write(f"{last}\n")
                self._stream.flush()

    def wipe(self) -> None:
        """Remove the line, so that something else can be printed."""
        if self._is_shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
        elif self._printer is not None:
            self._is_over.set()
            self._printer.join()
            self._printer = None
            self._is_over.clear()

    def __enter__(self) -> StatusLine:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.wipe()


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
