"""A recorded hand as a source: a log that steps as the hand did.

Shapes: as in `xhand1.source`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from tgdsl.errors import TgdslError
from tgdsl.runtime.simulators.state_values import Control
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import MAX_AGE_S, READ_TIMEOUT_S, Reading
from tgdsl.runtime.xhand1.log.log import Fault, open_log
from tgdsl.runtime.xhand1.source import HandSample, HandSource
from tgdsl.runtime.xhand1.wire.errors import HandTimeoutError


class ReplayOverError(TgdslError):
    """A step beyond the end of a log. `ReplaySource.is_over` says before that it would come."""


class ReplaySource(HandSource):
    """A log that steps like `XHand1Source`, as one environment.

    With a control step, a step delivers the live source's reading: the newest one at the end of the step, or the first one
    within 80 ms after; else it raises the failure of that time. Without one, each step delivers the next reading or failure of
    the log, so that a log of a source's readings reproduces its samples.
    """

    NAME = "the log of an XHand1"

    def __init__(
        self,
        path: str | Path,
        *,
        control_step: float | None = None,
        speed: float = 1.0,
        calibration: Calibration | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """Open a log, and take its first reading.

        Args:
            path: The log.
            control_step: Duration of one control step, on the log's clock [s]; default: one reading per step.
            speed: How much faster than it was: 1 is the original timing, `math.inf` as fast as possible.
            calibration: What the counts mean; default: what the log says, and counts if it says nothing.
            clock: Seconds that only go forward.
            sleep: Waits for some seconds.
        """
        if not speed > 0:
            raise TgdslError(f"speed is {speed:g}, expected more than 0")
        if not (control_step is None or 0 < control_step < math.inf):
            raise TgdslError(f"control_step is {control_step:g} s, expected more than 0, and a finite time")
        self.log = open_log(path)
        super().__init__(calibration or self.log.calibration)
        self._speed, self._control_step = speed, control_step
        self._clock, self._sleep = clock, sleep
        self._fault_times = np.array([fault.time for fault in self.log.faults])
        self._start = float(self.log.received_at[0])
        self._end = self._start + self.log.seconds
        self.rewind()

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]; with one reading per step, the median of the times between them."""
        if self._control_step is not None:
            return self._control_step
        return float(np.median(np.diff(self.log.received_at))) if self.log.num_readings > 1 else math.nan

    @property
    def now(self) -> float:
        """The time on the log's clock [s]; `sample().reading.age_s(source.now)` is how old that reading was."""
        return self._now

    @property
    def age_s(self) -> float | None:
        """How old the sample was at most, on the log's clock, when it was delivered [s]."""
        return self._sample.reading.age_s(self._now)

    @property
    def is_over(self) -> bool:
        """Whether the log is at its end: the next step raises `ReplayOverError`."""
        if self._control_step is None:
            return self._next_reading == self.log.num_readings and self._next_fault == len(self.log.faults)
        return self._now >= self._end

    def step(self, control: Control = None) -> None:
        """Advance by one control step, and wait until it is over, unless as fast as possible; `control` is ignored.

        Raises:
            ReplayOverError: If the log is at its end.
            HandError: The recorded failure.
        """
        self._expect_more()
        if self._control_step is None:
            self._next_event()
        else:
            self._next_instant(self._control_step)

    def sample(self) -> HandSample:
        """Return what the hand said at the end of the last step that delivered a reading; its times are the log's."""
        return self._sample

    def rewind(self) -> None:
        """Restart with the log's first reading."""
        self._velocity.reset()
        self.num_late_steps = 0
        self._readings: Iterator[Reading] = self.log.readings()
        self._next_reading = 0
        self._next_fault = int(np.searchsorted(self.log.fault_reading, 1))
        self._now = self._due = self._start
        self._began_at = self._clock()
        self._take(0)

    def close(self) -> None:
        self._readings = iter(())
        self._now = self._end
        self._next_reading, self._next_fault = self.log.num_readings, len(self.log.faults)

    def _restart(self) -> None:
        """Count steps from now, and deliver the first reading requested from then on."""
        self._expect_more()
        if self._control_step is None:
            self._next_event()
            return
        now = self._due = max(self._now, self._log_time())
        coming = max(int(np.searchsorted(self.log.requested_at, now)), self._next_reading)
        self._await(coming, max(now, float(self.log.received_at[coming - 1])) + READ_TIMEOUT_S)

    def _expect_more(self) -> None:
        if self.is_over:
            raise ReplayOverError(f"{self.log.path}: the log is over, {self.log.seconds:.3f} s after its first reading")

    def _next_event(self) -> None:
        """Deliver the next reading or failure, whichever was first."""
        log = self.log
        if self._next_fault < len(log.faults) and log.fault_reading[self._next_fault] <= self._next_reading:
            self._next_fault += 1
            self._fail(log.faults[self._next_fault - 1])
        self._wait_until(float(log.received_at[self._next_reading]))
        self._take(self._next_reading)

    def _next_instant(self, control_step: float) -> None:
        """Deliver what a live source would have had after one control step."""
        self._due += control_step
        now = max(self._now, self._log_time())
        if self._due < now:
            self.num_late_steps += 1
            self._due = now
        due = self._due
        newest = int(np.searchsorted(self.log.received_at, due, side="right")) - 1
        if newest >= self._next_reading and due - self.log.requested_at[newest] <= MAX_AGE_S:
            self._wait_until(due)
            self._take(newest)
            return
        self._await(newest + 1, due + READ_TIMEOUT_S)

    def _await(self, coming: int, give_up_at: float) -> None:
        """Wait for a reading until some time, and deliver it or why it did not come."""
        if coming < self.log.num_readings and self.log.received_at[coming] <= give_up_at:
            self._wait_until(float(self.log.received_at[coming]))
            self._take(coming)
        else:
            self._fail(self._failure(coming - 1, give_up_at))

    def _failure(self, newest: int, now: float) -> Fault:
        """Return why there was no reading after the newest one up to a time: the last failure, or that none came."""
        last = int(np.searchsorted(self._fault_times, now, side="right")) - 1
        if last >= 0 and self._fault_times[last] > self.log.received_at[newest]:
            return self.log.faults[last]._replace(time=now)
        age = 1e3 * (now - float(self.log.requested_at[newest]))
        return Fault.of(HandTimeoutError(f"no new reading came in time; the newest is {age:.0f} ms old"), now)

    def _fail(self, fault: Fault) -> NoReturn:
        self._wait_until(fault.time)
        raise fault.error()

    def _log_time(self) -> float:
        if math.isinf(self._speed):
            return self._now
        return self._start + (self._clock() - self._began_at) * self._speed

    def _wait_until(self, log_time: float) -> None:
        self._now = max(log_time, self._now)
        if not math.isinf(self._speed):
            self._sleep(max(self._now - self._log_time(), 0.0) / self._speed)

    def _take(self, index: int) -> None:
        """Deliver a reading; those before it that were not delivered are skipped, as a slow reader would."""
        while self._next_reading <= index:
            reading = next(self._readings)
            self._next_reading += 1
        self._sample = HandSample.of(reading, self.calibration, self._velocity, reading.requested_at)
