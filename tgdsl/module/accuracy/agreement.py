"""How far readings are from a kind's float64 reference, at ties from the nearer side.

Shapes: `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from tgdsl.module.accuracy.reference import ReferenceModule
from tgdsl.module.state import SceneState

TIE_SHIFT = 1e-7
"""Shift of an object [m] that covers float32 rounding: on which side of a tie a reading falls is not defined closer."""


def full_scale_error(found: Tensor, expected: np.ndarray) -> np.ndarray:
    """Return |found − expected| over the largest magnitude of each channel in the batch (env, *sample, row, channel)."""
    scale = np.abs(expected).max(axis=tuple(range(expected.ndim - 1)), keepdims=True)
    error = np.abs(found.detach().double().numpy() - expected)
    return error / np.where(scale > 0, scale, 1.0)


def row_errors(found: Tensor, reference: ReferenceModule, state: SceneState, enough: float = 0.0) -> np.ndarray:
    """Return the error of each row over full scale (env, *sample, row); the reference then remembers this state.

    Args:
        found: Readings.
        reference: The reference of the sensor.
        state: What was read.
        enough: Errors up to this need no look at the other sides of ties.
    """
    shifts = [np.zeros(3)] + [sign * TIE_SHIFT * axis for axis in np.eye(3) for sign in (1, -1)]
    worst = np.full(tuple(found.shape[:-1]), np.inf)
    memory = None
    for shift in shifts:
        expected, after = reference(state, shift)
        memory = memory or after
        worst = np.minimum(worst, full_scale_error(found, expected).max(axis=-1))
        if worst.max() <= enough:
            break
    reference.remember(memory or {})
    return worst
