"""What an emulated hand is made of: joints that move, and fingertips that feel.

Shapes: `joint`, `finger` and `taxel` as in `payloads`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.xhand1.wire.payloads import FINGERS, NUM_JOINTS, NUM_TAXELS, PASSIVE, JointCommand, Mode


@dataclass(frozen=True, eq=False)
class TipForces:
    """What the fingertips feel [counts]; rounded and cut to what a byte holds, as a sensor would.

    Attributes:
        total: Force of each fingertip.
        taxel: Force of each taxel.
    """

    total: Float[np.ndarray, "finger 3"]
    taxel: Float[np.ndarray, "finger taxel 3"]


ForceField = Callable[[float, Float[np.ndarray, " joint"]], TipForces]
"""Takes the time [s] and the joint angles [rad]; is called once per state that the hand sends."""


def no_forces(time_s: float, position: Float[np.ndarray, " joint"]) -> TipForces:
    """Return fingertips that feel nothing."""
    return TipForces(np.zeros((len(FINGERS), 3)), np.zeros((len(FINGERS), NUM_TAXELS, 3)))


@runtime_checkable
class Body(Protocol):
    """Joints and fingertips."""

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Take what the joints are told at a time [s]."""
        ...

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return the joint angles [rad], and what the fingertips feel, at that time [s]; called once per state."""
        ...


class FirstOrderBody:
    """Joints that follow first-order, with one time constant, while they are driven; else they stay.

    Attributes:
        position: Joint angles [rad].
    """

    def __init__(self, forces: ForceField, time_constant_s: float):
        """Start with all joints at zero."""
        self.position = np.zeros(NUM_JOINTS)
        self._forces = forces
        self._time_constant_s = time_constant_s
        self._joints: Sequence[JointCommand] = PASSIVE
        self._moved_at: float | None = None

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Move as the last command said until now, then take this one."""
        elapsed = 0.0 if self._moved_at is None else time_s - self._moved_at
        self._moved_at = time_s
        share = 1.0 - math.exp(-elapsed / self._time_constant_s)
        for i, joint in enumerate(self._joints):
            if is_driven(joint):
                self.position[i] += share * (joint.position - self.position[i])
        self._joints = joints

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return angles and forces."""
        return self.position.copy(), self._forces(time_s, self.position.copy())


def is_driven(joint: JointCommand) -> bool:
    """Return whether a drive goes to its set-point: with the mode for it, a gain and a current."""
    return joint.mode == Mode.POSITION and joint.kp > 0 and joint.current_limit > 0
