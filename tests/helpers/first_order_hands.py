"""An emulated hand without a scene: joints that follow their set-points first-order, and fingertips that feel what a test says."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from tgdsl.runtime.xhand1.emulator.emulator import EmulatedHand, TipForces, is_driven
from tgdsl.runtime.xhand1.wire.protocol import NUM_JOINTS, PASSIVE, JointCommand

ForceField = Callable[[float, np.ndarray], TipForces]
"""Takes the time [s] and the joint angles [rad]; is called once per state that the hand sends."""


class FirstOrderBody:
    """Joints that follow with one time constant while they are driven; else they stay.

    Attributes:
        position: Joint angles [rad].
    """

    def __init__(self, forces: ForceField | None, time_constant_s: float):
        self.position = np.zeros(NUM_JOINTS)
        self._forces, self._time_constant_s = forces, time_constant_s
        self._joints: Sequence[JointCommand] = PASSIVE
        self._moved_at: float | None = None

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Move by the last command until now, then take this one."""
        elapsed = 0.0 if self._moved_at is None else time_s - self._moved_at
        self._moved_at = time_s
        share = 1.0 - math.exp(-elapsed / self._time_constant_s)
        for i, joint in enumerate(self._joints):
            if is_driven(joint):
                self.position[i] += share * (joint.position - self.position[i])
        self._joints = joints

    def felt(self, time_s: float) -> tuple[np.ndarray, TipForces]:
        position = self.position.copy()
        return position, TipForces.zero() if self._forces is None else self._forces(time_s, position)


def first_order_hand(hand_id: int = 0, forces: ForceField | None = None, time_constant_s: float = 0.05) -> EmulatedHand:
    """Return a hand whose joints go 63 % of the way to their set-points in a time constant [s]."""
    return EmulatedHand(hand_id, FirstOrderBody(forces, time_constant_s))
