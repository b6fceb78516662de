"""Joint speeds, which the hand does not report, from its joint angles."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float


class VelocityFilter:
    """Differences of successive angles through a first-order low-pass filter: v ← v + (1 − exp(−Δt/τ)) (Δq/Δt − v).

    For angles that move evenly, the error of the speed decays as exp(−t/τ). Of a sine of angular frequency ω, much slower
    than the readings, 1/√(1 + ω²τ²) is left, late by arctan(ωτ).
    """

    def __init__(self, time_constant_s: float):
        """Start at rest.

        Args:
            time_constant_s: The filter's time constant τ [s]; 0: plain differences.
        """
        self._time_constant_s = time_constant_s
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self._time_s: float | None = None
        self._position = self._velocity = np.zeros(0)

    def update(self, time_s: float, position: Float[np.ndarray, " joint"]) -> Float[np.ndarray, " joint"]:
        """Take the angles [rad] at a time [s] and return the speeds [rad/s]; those of the first reading are 0.

        A time that is not later than the last changes nothing.
        """
        if self._time_s is None:
            self._velocity = np.zeros(len(position))
        elif time_s > self._time_s:
            elapsed = time_s - self._time_s
            share = 1.0 if self._time_constant_s == 0 else -math.expm1(-elapsed / self._time_constant_s)
            self._velocity = self._velocity + share * ((position - self._position) / elapsed - self._velocity)
        else:
            return self._velocity
        self._time_s, self._position = time_s, position.astype(np.float64)
        return self._velocity
