"""The hand as a source: stepped like a simulation of one environment, but in its own time, and with what a hand can know.

Shapes: `env` one, `joint`, `finger` and `taxel` as in `protocol`.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import StateError
from tgdsl.module.state import SceneState
from tgdsl.runtime.closable import Closable
from tgdsl.runtime.simulators.state_values import Control
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.wire.errors import HandError, HandTimeoutError, MotionError
from tgdsl.tensors.env_ids import EnvIds, env_indices

TIME_CONSTANT_S = 0.02  # of the filter of joint speeds; policies learn with `joint_vel: measured` what it does [s]


class VelocityFilter:
    """Differences of successive angles through a first-order low-pass filter: v ← v + (1 − exp(−Δt/τ)) (Δq/Δt − v).

    For angles that move evenly, the error of the speed decays as exp(−t/τ). Of a sine of angular frequency ω, much slower
    than the readings, 1/√(1 + ω²τ²) is left, late by arctan(ωτ).
    """

    def __init__(self, time_constant_s: float):
        """Start at rest, with a time constant τ [s]."""
        self._time_constant_s = time_constant_s
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self._time_s: float | None = None
        self._position = self._velocity = np.zeros(0)

    def update(self, time_s: float, position: Float[np.ndarray, " joint"]) -> Float[np.ndarray, " joint"]:
        """Take the angles [rad] at a time [s] and return the speeds [rad/s], 0 at the first reading.

        A time that is not later than the last changes nothing.
        """
        if self._time_s is None:
            self._velocity = np.zeros(len(position))
        elif time_s > self._time_s:
            elapsed = time_s - self._time_s
            share = -math.expm1(-elapsed / self._time_constant_s)
            self._velocity = self._velocity + share * ((position - self._position) / elapsed - self._velocity)
        else:
            return self._velocity
        self._time_s, self._position = time_s, position.astype(np.float64)
        return self._velocity


@dataclass(frozen=True, eq=False)
class HandSample:
    """What the hand said at one control step."""

    joint_pos: Float[Tensor, "env joint"]  # joint angles, by joint id [rad]
    joint_vel: Float[Tensor, "env joint"]  # their speeds, by `VelocityFilter` [rad/s]
    tip_force: Float[Tensor, "env finger 3"]  # force on each fingertip, along its link's axes [`units`]
    # whether a component of a fingertip's counts is at the end of its range: the force may be larger
    is_tip_saturated: Bool[Tensor, "env finger"]
    # each taxel's force as the hand gives it [counts]; where the taxels sit and their axes are unverified
    taxel_counts: Int[Tensor, "env finger taxel 3"]
    is_taxel_saturated: Bool[Tensor, "env finger taxel"]  # the same for each taxel
    joint_temperature: Int[Tensor, "env joint"]  # temperature of each drive [°C]
    tip_temperature: Int[Tensor, "env finger"]  # temperature of each fingertip [°C]
    joint_error: Int[Tensor, "env joint 3"]  # error codes of each joint's three boards; 0 is none
    units: Literal["counts", "N"]  # unit of `tip_force`
    reading: Reading  # the reading that all this comes from; it knows its age

    @classmethod
    def of(cls, reading: Reading, calibration: Calibration, velocity: VelocityFilter, time_s: float) -> HandSample:
        """Return what a reading says; the filter takes note of it, at the time when the joints were there [s]."""

        def row(values: np.ndarray, dtype: torch.dtype) -> Tensor:
            plain = values.astype(np.float64 if np.issubdtype(values.dtype, np.floating) else np.int64)
            return torch.from_numpy(plain).to(dtype).unsqueeze(0)

        state = reading.state
        return cls(
            joint_pos=row(state.position, torch.float32),
            joint_vel=row(velocity.update(time_s, state.position.astype(np.float64)), torch.float32),
            tip_force=row(calibration.apply(state.total_force), torch.float32),
            is_tip_saturated=row(np.asarray(state.is_total_saturated.any(axis=-1)), torch.bool),
            taxel_counts=row(state.taxel_force, torch.int16),
            is_taxel_saturated=row(np.asarray(state.is_taxel_saturated.any(axis=-1)), torch.bool),
            joint_temperature=row(state.joint_temperature & 0xFF, torch.int16),
            tip_temperature=row(state.total_temperature, torch.int16),
            joint_error=row(state.joint_error, torch.int32),
            units=calibration.units,
            reading=reading,
        )


class HandSource(Closable, ABC):
    """A hand, or the log of one, that steps as one environment."""

    NAME: str
    num_envs = 1
    num_late_steps = 0  # steps that began after they should have ended

    def __init__(self, calibration: Calibration | None):
        self.calibration = calibration or Calibration.none()
        self._velocity = VelocityFilter(TIME_CONSTANT_S)

    @property
    @abstractmethod
    def control_step(self) -> float:
        """Duration of one control step [s]."""

    @property
    def is_over(self) -> bool:
        """Whether there is nothing more to read."""
        return False

    @property
    @abstractmethod
    def age_s(self) -> float | None:
        """How old the sample is at most, now [s]; None where nothing runs in real time."""

    @abstractmethod
    def step(self, control: Control = None) -> None:
        """Advance by one control step, and read."""

    @abstractmethod
    def sample(self) -> HandSample:
        """Return what the hand said at the end of the last step, or after a reset."""

    def state(self) -> SceneState:
        """Refuse: a hand does not know where objects are, so no taxel reading can be computed from it."""
        able = "joint_pos, joint_vel, tip_force, taxel_counts, joint_temperature, tip_temperature, joint_error"
        raise StateError(f"{self.NAME} cannot give the poses and contacts of a SceneState; its sample() gives {able}")

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Forget the speeds and the last target, make a hand passive until the next command, and read it.

        Nothing moves a hand to where it started, and a log goes on in time. A hand that was stopped by an error stays so until
        `resume`.
        """
        if env_ids is None or is_chosen(env_ids):
            self._velocity.reset()
            self._restart()

    @abstractmethod
    def _restart(self) -> None:
        """Reset all except the speeds."""

    def resume(self) -> None:
        """Let a hand move again after an error made it passive."""


class XHand1Source(HandSource):
    """A hand that steps at a fixed rate. After a step that begins late, the next ones are counted from there."""

    NAME = "a real XHand1"

    def __init__(
        self,
        hand: XHand1,
        *,
        control_step: float,
        calibration: Calibration | None = None,
        read_timeout_s: float | None = None,
    ):
        """Take an open hand, which `close` closes.

        Args:
            hand: The hand.
            control_step: Duration of one control step [s].
            calibration: What its counts mean; default: they stay counts.
            read_timeout_s: How long to wait for a new reading after a step [s]; default: as `hand.read`.
        """
        if not 0 < control_step < math.inf:
            raise HandError(f"a control step of {control_step:g} s, expected a finite time above 0")
        refuse_beyond_watchdog(control_step, hand.watchdog_s)
        super().__init__(calibration)
        self.hand, self._control_step, self._read_timeout_s = hand, control_step, read_timeout_s
        self._step_ends_at = time.monotonic()
        self._target: np.ndarray | None = None
        self._sample: HandSample | None = self._read(-math.inf)

    @property
    def control_step(self) -> float:
        return self._control_step

    def step(self, control: Control = None) -> None:
        """Command the joints, wait until the control step is over, and read the hand.

        `control` is joint angles to go to by joint id, (joint,) or (1, joint) [rad]; default: as they were.

        Raises:
            HandError: If the hand may not go there, or no new reading comes.
        """
        if control is not None:
            values = control_array(control)
            self._target = values[0] if values.ndim == 2 and len(values) == 1 else values
        self._sample = None
        self._command()
        self._sample = self._read(self._wait())

    def sample(self) -> HandSample:
        """Return what the hand said at the end of the last step, or after a reset; if that failed, an error says so."""
        if self._sample is None:
            raise HandTimeoutError("the last step or reset gave no reading; step or reset again")
        return self._sample

    @property
    def age_s(self) -> float | None:
        return self.sample().reading.age_s()

    def resume(self) -> None:
        self.hand.resume()

    def close(self) -> None:
        self.hand.close()

    def _restart(self) -> None:
        self._target, self._sample = None, None
        self.hand.relax()
        self._step_ends_at = time.monotonic()
        self._sample = self._read(time.monotonic())

    def _command(self) -> None:
        if self._target is not None:
            self.hand.command(self._target)

    def _wait(self) -> float:
        """Wait until the control step is over; return when a reading must have been asked for at the earliest [s]."""
        now = time.monotonic()
        self._step_ends_at += self._control_step
        if self._step_ends_at < now:
            self.num_late_steps += 1
            self._step_ends_at = now
        time.sleep(self._step_ends_at - now)
        return -math.inf

    def _time_of(self, reading: Reading) -> float:
        return reading.requested_at

    def _read(self, requested_after: float) -> HandSample:
        while (reading := self.hand.read(self._read_timeout_s)).requested_at < requested_after:
            continue
        return HandSample.of(reading, self.calibration, self._velocity, self._time_of(reading))


def control_array(control: Tensor | np.ndarray) -> np.ndarray:
    """Return controls as an array on the host."""
    return control.detach().cpu().numpy() if isinstance(control, Tensor) else np.asarray(control)


def refuse_beyond_watchdog(control_step: float, watchdog_s: float | None) -> None:
    """Raise an error unless commands, one per control step, come before a watchdog bites."""
    if watchdog_s is not None and control_step >= watchdog_s:
        problem = f"a control step of {1e3 * control_step:g} ms, and the watchdog bites after {1e3 * watchdog_s:g} ms"
        raise MotionError(f"{problem}; expected a shorter step")


def is_chosen(env_ids: EnvIds) -> bool:
    """Return whether the one environment that a hand is, 0, is among indices or in a mask."""
    return bool(len(env_indices(env_ids, 1, HandError)))
