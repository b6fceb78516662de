"""The hand as a source: stepped like a simulation of one environment, but in its own time, and with what a hand can know.

Shapes: `env` one, `joint`, `finger` and `taxel` as in `payloads`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import StateError
from tgdsl.module.state import SceneState
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.reader import Reading
from tgdsl.runtime.xhand1.velocity import VelocityFilter
from tgdsl.runtime.xhand1.wire.errors import HandError, MotionError, StaleReadingError
from tgdsl.tensors.env_ids import EnvIds


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


@dataclass(frozen=True, eq=False)
class HandSample:
    """What the hand said at one control step.

    Attributes:
        joint_pos: Joint angles, by joint id [rad].
        joint_vel: Their speeds, by `VelocityFilter` [rad/s].
        tip_force: Force on each fingertip, along its link's axes [`units`].
        is_tip_saturated: Whether a component of a fingertip's counts is at the end of its range: the force may be larger.
        taxel_counts: Each taxel's force as the hand gives it [counts]; where the taxels sit and their axes are unverified.
        is_taxel_saturated: The same for each taxel.
        joint_temperature: Temperature of each drive [°C].
        tip_temperature: Temperature of each fingertip [°C].
        joint_error: Error codes of each joint's three boards; 0 is none.
        units: Unit of `tip_force`.
        reading: The reading that all this comes from; it knows its age.
    """

    joint_pos: Float[Tensor, "env joint"]
    joint_vel: Float[Tensor, "env joint"]
    tip_force: Float[Tensor, "env finger 3"]
    is_tip_saturated: Bool[Tensor, "env finger"]
    taxel_counts: Int[Tensor, "env finger taxel 3"]
    is_taxel_saturated: Bool[Tensor, "env finger taxel"]
    joint_temperature: Int[Tensor, "env joint"]
    tip_temperature: Int[Tensor, "env finger"]
    joint_error: Int[Tensor, "env joint 3"]
    units: Literal["counts", "N"]
    reading: Reading

    @classmethod
    def of(cls, reading: Reading, calibration: Calibration, velocity: VelocityFilter, time_s: float) -> HandSample:
        """Return what a reading says.

        Args:
            reading: The reading.
            calibration: What its counts mean.
            velocity: The filter of joint speeds, which takes note of it.
            time_s: When the joints were where it says [s].
        """
        state = reading.state
        speeds = velocity.update(time_s, state.position.astype(np.float64))
        return cls(
            joint_pos=_row(state.position, torch.float32),
            joint_vel=_row(speeds, torch.float32),
            tip_force=_row(calibration.apply(state.total_force), torch.float32),
            is_tip_saturated=_row(np.asarray(state.is_total_saturated.any(axis=-1)), torch.bool),
            taxel_counts=_row(state.taxel_force, torch.int16),
            is_taxel_saturated=_row(np.asarray(state.is_taxel_saturated.any(axis=-1)), torch.bool),
            joint_temperature=_row(state.joint_temperature & 0xFF, torch.int16),
            tip_temperature=_row(state.total_temperature, torch.int16),
            joint_error=_row(state.joint_error, torch.int32),
            units=calibration.units,
            reading=reading,
        )


class XHand1Source:
    """A hand that steps at a fixed rate, as one environment.

    Attributes:
        hand: The hand.
        calibration: What its counts mean.
    """

    def __init__(
        self,
        hand: XHand1,
        *,
        control_step: float,
        calibration: Calibration | None = None,
        velocity_time_constant: float = 0.02,
        timer: StepTimer | None = None,
        read_timeout_s: float | None = None,
    ):
        """Take an open hand.

        Args:
            hand: The hand; `close` closes it.
            control_step: Duration of one control step [s].
            calibration: What its counts mean; default: they stay counts.
            velocity_time_constant: Time constant of the filter of joint speeds [s].
            timer: What control steps wait for; default: that their time is over.
            read_timeout_s: How long to wait for a new reading after a step [s]; default: as `hand.read`.

        Raises:
            HandError: If the control step is not positive, or no new reading comes.
            MotionError: If the hand may move, and its watchdog bites between two steps.
        """
        if not 0 < control_step < math.inf:
            raise HandError(f"a control step of {control_step:g} s, expected a finite time above 0")
        refuse_beyond_watchdog(control_step, hand.watchdog_s)
        self.hand = hand
        self.calibration = calibration or Calibration.none()
        self._velocity = VelocityFilter(velocity_time_constant)
        self._control_step = control_step
        self._read_timeout_s = read_timeout_s
        self._timer = RealTime(control_step) if timer is None else timer
        self._target: np.ndarray | None = None
        self._sample: HandSample | None = self._read(-math.inf)

    @property
    def num_envs(self) -> int:
        """One: there is one hand."""
        return 1

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        return self._control_step

    @property
    def is_over(self) -> bool:
        """Never: there is always more to read."""
        return False

    @property
    def num_late_steps(self) -> int:
        """Steps that began after they should have ended."""
        return self._timer.num_late_steps

    def step(self, control: Tensor | np.ndarray | None = None) -> None:
        """Command the joints, wait until the control step is over, and read the hand.

        After a step that begins later than it should have ended, the next ones are counted from there.

        Args:
            control: Joint angles to go to by joint id, (joint,) or (1, joint) [rad]; default: as they were.

        Raises:
            MotionError: If the hand may not go there, or not move at all.
            HandError: If no new reading comes.
        """
        if control is not None:
            values = control.detach().cpu().numpy() if isinstance(control, Tensor) else np.asarray(control)
            self._target = values[0] if values.ndim == 2 and len(values) == 1 else values
        self._sample = None
        self._command()
        self._sample = self._read(self._timer.wait(self._target, self._command))

    def sample(self) -> HandSample:
        """Return what the hand said at the end of the last step, or after a reset.

        Raises:
            StaleReadingError: If that step or reset failed: what was said before is not handed out as if it were new.
        """
        if self._sample is None:
            raise StaleReadingError("the last step or reset gave no reading; step or reset again")
        return self._sample

    @property
    def age_s(self) -> float | None:
        """How old the sample is at most, now [s]."""
        return self.sample().reading.age_s()

    def state(self) -> SceneState:
        """Refuse: a hand does not know where objects are, so no taxel reading can be computed from it.

        Raises:
            StateError: Always; it lists what the hand can give.
        """
        raise no_scene_state("a real XHand1")

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Forget the speeds and the last target, make the hand passive until the next command, and read it.

        Nothing moves it to where it started. One that was stopped by an error stays so until `hand.resume()`.

        Args:
            env_ids: Indices, or a boolean mask over environments, of which there is one; default: it.

        Raises:
            HandError: If no new reading comes, or there are no such environments.
        """
        if env_ids is not None and not is_chosen(env_ids):
            return
        self._velocity.reset()
        self._target, self._sample = None, None
        self.hand.relax()
        self._timer.restart()
        self._sample = self._read(time.monotonic())

    def resume(self) -> None:
        """Allow a hand that was made passive by an error to move again."""
        self.hand.resume()

    def close(self) -> None:
        """Close the hand.

        Raises:
            HandError: If it was moving and did not confirm that it is passive.
        """
        self.hand.close()

    def _command(self) -> None:
        if self._target is not None:
            self.hand.command(self._target)

    def _read(self, requested_after: float) -> HandSample:
        while (reading := self.hand.read(self._read_timeout_s)).requested_at < requested_after:
            continue
        return HandSample.of(reading, self.calibration, self._velocity, self._timer.time_of(reading))


def refuse_beyond_watchdog(control_step: float, watchdog_s: float | None) -> None:
    """See that commands, one per control step, come before a watchdog bites.

    Raises:
        MotionError: If they do not.
    """
    if watchdog_s is not None and control_step >= watchdog_s:
        what = f"a control step of {1e3 * control_step:g} ms, and the watchdog bites after {1e3 * watchdog_s:g} ms"
        raise MotionError(f"{what}; expected a shorter step")


def no_scene_state(who: str) -> StateError:
    """Return the error of a source that does not know where objects are; it lists what a `HandSample` holds."""
    able = "joint_pos, joint_vel, tip_force, taxel_counts, joint_temperature, tip_temperature, joint_error"
    return StateError(f"{who} cannot give the poses and contacts of a SceneState; its sample() gives {able}")


def is_chosen(env_ids: EnvIds) -> bool:
    """Return whether the one environment that a hand is, 0, is among indices or in a mask.

    Raises:
        HandError: If there are no such environments.
    """
    found = np.asarray(torch.as_tensor(env_ids).cpu())
    if found.dtype == bool and found.shape == (1,):
        return bool(found[0])
    if found.size and (found.dtype.kind not in "iu" or found.any()):
        raise HandError(f"env_ids: found {found.tolist()}, expected index 0, or a mask of 1")
    return bool(found.size)


def _row(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    is_float = np.issubdtype(values.dtype, np.floating)
    plain = values.astype(np.float64 if is_float else np.int64)
    return torch.from_numpy(plain).to(dtype).unsqueeze(0)
