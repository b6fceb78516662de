"""An emulated hand as a source: the scene of a module behind a pseudo-terminal, read as a real hand is."""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack

import numpy as np
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Emulator
from tgdsl.runtime.xhand1.emulator.hand import EmulatedHand
from tgdsl.runtime.xhand1.emulator.simulated_body import Lockstep, SimulatedBody
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.source import XHand1Source, is_chosen
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.errors import WatchdogError
from tgdsl.tensors.env_ids import EnvIds

PATIENT = SerialTiming(reply_timeout_s=5.0, silence_s=2.0)
"""For an emulator on a busy machine, where what is late is not lost: pseudo-terminals then take up to half a second."""


class EmulatedSource(XHand1Source):
    """A hand whose body is simulated.

    Attributes:
        emulator: The device.
        body: The simulation.
    """

    def __init__(
        self,
        body: SimulatedBody,
        *,
        control_step: float,
        calibration: Calibration,
        motion: MotionLimits | None = None,
        timing: SerialTiming | None = None,
        lockstep: bool = False,
    ):
        """Plug the hand in and open it.

        Args:
            body: The simulation, whose control step is the same.
            control_step: Duration of one control step [s].
            calibration: What its counts mean.
            motion: Leave to move it; default: none.
            timing: Times of the line; default: `PATIENT`.
            lockstep: Whether the simulation waits for `step`, and makes one control step then; else it runs in real time.

        Raises:
            HandError: If the hand does not answer.
        """
        self._is_lockstep = lockstep
        with ExitStack() as opened:
            opened.callback(body.close)
            emulator = opened.enter_context(Emulator(EmulatedHand(body=body)))
            hand = opened.enter_context(XHand1.open(emulator.device, motion=motion, timing=timing or PATIENT))
            if not lockstep:
                body.run()
            timer = Lockstep(body) if lockstep else None
            super().__init__(hand, control_step=control_step, calibration=calibration, timer=timer)
            self.emulator, self.body = emulator, body
            self._opened = opened.pop_all()
        self._told = False

    @property
    def age_s(self) -> float | None:
        """How old the sample is at most, now [s]; None in lockstep, where the scene waits."""
        return None if self._is_lockstep else super().age_s

    def step(self, control: Tensor | np.ndarray | None = None) -> None:
        """Step as a hand does.

        Raises:
            SimulationError: If the simulation ended, as it diverged.
            HandError: As with a real hand, or if the emulator ended.
        """
        try:
            super().step(control)
        finally:
            self._look_for_failures()
        if self.body.clipped and not self._told:
            self._told = True
            who = ", ".join(sorted(self.body.clipped))
            what = f"the emulated {who} felt more than counts of -128…127 along x and y and 0…255 along z can say"
            warnings.warn(f"{what}; see the calibration's scale and rotation", stacklevel=2)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Make the hand passive, then restart the scene.

        Raises:
            SimulationError: If the simulation ended, as it diverged.
            HandError: If no new reading comes, or the emulator ended.
        """
        if env_ids is not None and not is_chosen(env_ids):
            return
        try:
            self._start_anew()
        finally:
            self._look_for_failures()

    def _start_anew(self) -> None:
        super().reset()
        self._read(time.monotonic())  # the command of this one was made after the hand was told to be passive
        self.body.reset()
        self._velocity.reset()
        self._sample = self._read(time.monotonic())

    def _look_for_failures(self) -> None:
        """Raise what ended one of the threads, in the place of what follows from it.

        Raises:
            SimulationError: If the simulation ended.
            HandError: If the emulator ended.
        """
        if self.body.failure is not None:
            raise SimulationError(f"the emulated hand's simulation ended: {self.body.failure}") from self.body.failure
        self.emulator.check()

    def _command(self) -> None:
        """Repeat the step's command; where nothing runs in real time, a caller who took long to give it is not late."""
        try:
            super()._command()
        except WatchdogError:
            if not self._is_lockstep:
                raise
            self.hand.resume()
            super()._command()

    def close(self) -> None:
        """Close the hand, pull the plug and end the simulation."""
        self._opened.close()
