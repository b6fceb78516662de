"""Timing of a hand's control steps: in real time, or as a simulated body makes them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.xhand1.reader import Reading


@runtime_checkable
class StepTimer(Protocol):
    """Waits for the end of control steps."""

    num_late_steps: int
    """Steps that began after they should have ended."""

    def wait(self, target: Float[np.ndarray, " joint"] | None, command: Callable[[], None]) -> float:
        """Wait until the control step is over.

        Args:
            target: Where the joints are told to go, by joint id [rad]; None if they are not told.
            command: Repeats the step's command, for who keeps a hand with a watchdog waiting for long.

        Returns:
            When a reading must have been asked for at the earliest, to be one of the end of this step; on the clock of
            `time.monotonic` [s].
        """
        ...

    def time_of(self, reading: Reading) -> float:
        """Return when the joints were where a reading says that they were [s]."""
        ...

    def restart(self) -> None:
        """Count steps from now."""
        ...


class RealTime:
    """Steps of one duration. After one that begins later than it should have ended, the next ones are counted from there."""

    def __init__(self, control_step: float):
        """Start counting."""
        self.num_late_steps = 0
        self._control_step = control_step
        self.restart()

    def wait(self, target: Float[np.ndarray, " joint"] | None, command: Callable[[], None]) -> float:
        """Sleep until the step is over; any new reading is then one of its end."""
        now = time.monotonic()
        self._next_step_at += self._control_step
        if self._next_step_at < now:
            self.num_late_steps += 1
            self._next_step_at = now
        time.sleep(self._next_step_at - now)
        return -math.inf

    def time_of(self, reading: Reading) -> float:
        """Return when it was asked for."""
        return reading.requested_at

    def restart(self) -> None:
        """Count steps from now."""
        self._next_step_at = time.monotonic()
