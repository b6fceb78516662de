"""An emulated hand that nothing touches, and what its fingertips read then."""

import numpy as np

from tgdsl.runtime.xhand1.emulator.emulator import TipForces

TARE = np.array([[5.0, -3.0, 8.0], [1.0, 2.0, 3.0], [-4.0, 0.0, 12.0], [0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])


def resting(time_s: float, position: np.ndarray) -> TipForces:
    return TipForces(TARE, np.zeros((5, 120, 3)))
