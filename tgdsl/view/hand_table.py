"""A hand as lines of text: forces on its fingertips with bars, joint angles, currents, temperatures, errors, age and rate."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from tgdsl.console.progress import LiveTable
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import Reading
from tgdsl.runtime.xhand1.log.log import Fault
from tgdsl.runtime.xhand1.wire.protocol import FINGERS, FORCE_MAX, JOINTS

BAR = 32  # width of a full bar [characters]
_PARTS = " ▏▎▍▌▋▊▉"
_RATE_OVER_S = 1.0


class StreamStats:
    """How readings and failures come."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()
        self.rate = math.nan  # readings per second, over the last second; NaN before the second reading
        self.num_faults = 0  # failures so far
        self.fault: Fault | None = None  # the failure since the last reading; None if there was none

    def add(self, event: Reading | Fault) -> None:
        """Count a reading or a failure."""
        if isinstance(event, Fault):
            self.fault, self.num_faults, now = event, self.num_faults + 1, event.time
        else:
            self.fault, now = None, event.received_at
            self._times.append(now)
        while self._times and self._times[0] < now - _RATE_OVER_S:
            self._times.popleft()
        elapsed = self._times[-1] - self._times[0] if self._times else 0.0
        self.rate = (len(self._times) - 1) / elapsed if elapsed > 0 else math.nan


class HandView:
    """Draws a hand over itself on a terminal as readings and failures come; elsewhere only its last state is printed."""

    def __init__(self, calibration: Calibration | None, title: str):
        """Start without a reading; without a calibration, counts stay counts."""
        self._calibration = calibration or Calibration.none()
        self._title = title
        self._table, self._stats = LiveTable(), StreamStats()
        self._lines = [title, "not one reading came"]
        self._reading: Reading | None = None

    def show(self, event: Reading | Fault, now: float | None = None) -> None:
        """Take a reading or a failure, and draw if it is time to; `now` is the time on its clock [s], default: this moment."""
        self._stats.add(event)
        if not isinstance(event, Fault):
            self._reading = event
        if self._reading is not None:
            lines = hand_lines(self._reading, self._calibration, self._stats, self._reading.age_s(now))
            self._lines = [self._title, *lines]
        self._table.show(self._lines)

    def end(self) -> None:
        """Draw the last state."""
        self._table.show(self._lines, is_last=True)


def bar(part: float, width: int = BAR) -> str:
    """Return a bar that is full at 1, in eighths of a character; beyond 1 it is full."""
    eighths = round(8 * width * min(max(part, 0.0), 1.0))
    return "█" * (eighths // 8) + (_PARTS[eighths % 8] if eighths % 8 else "")


def hand_lines(reading: Reading, calibration: Calibration, stats: StreamStats, age_s: float) -> list[str]:
    """Return a hand's newest reading, some seconds old, as lines of text.

    Bars are full at what 255 counts along the sensor's z mean.
    """
    state, fault = reading.state, stats.fault
    force, full = calibration.apply(state.total_force), float(FORCE_MAX[2]) * calibration.scale[:, 2]
    lines = [f"reading {reading.sequence}   age {1e3 * age_s:.0f} ms   {stats.rate:.0f}/s   {stats.num_faults} failures"]
    lines.append(f"NO NEW READING: {fault.kind}: {fault.message}" if fault is not None else "")
    lines.append(f"{'fingertip':<18}{'x':>9}{'y':>9}{'z':>9}{'|force|':>10} {calibration.units:<7}{'°C':>4}")
    for i, name in enumerate(FINGERS):
        size = float(np.linalg.norm(force[i]))
        flags = ["SATURATED"] if state.is_total_saturated[i].any() else []
        num_taxels = int(state.is_taxel_saturated[i].any(axis=-1).sum())
        flags += [f"{num_taxels} taxels saturated"] if num_taxels else []
        numbers = "".join(f"{value:>9.2f}" for value in force[i])
        end = f"{bar(size / full[i]):<{BAR}} {', '.join(flags)}"
        lines.append(f"{name:<18}{numbers}{size:>10.2f} {'':<7}{state.total_temperature[i]:>4}  {end}".rstrip())
    lines += ["", f"{'joint':<18}{'rad':>9}{'mA':>9}{'°C':>9}  errors of its three boards"]
    for i, name in enumerate(JOINTS):
        errors = "–" if not state.joint_error[i].any() else " ".join(f"{code:#06x}" for code in state.joint_error[i])
        numbers = f"{state.position[i]:>9.3f}{state.current[i]:>9}{state.joint_temperature[i] & 0xFF:>9}"
        lines.append(f"{name.replace('_joint', ' '):<18}{numbers}  {errors}")
    return lines
