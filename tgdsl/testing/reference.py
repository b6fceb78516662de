"""What it means that a module agrees with its kind's float64 reference.

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


def assert_agrees(found: Tensor, reference: ReferenceModule, state: SceneState, tolerance: float) -> None:
    """Assert that readings equal the reference's, at ties that of one side; the reference then remembers this state."""
    shifts = [np.zeros(3)] + [sign * TIE_SHIFT * axis for axis in np.eye(3) for sign in (1, -1)]
    worst = np.full(tuple(found.shape[:-1]), np.inf)
    memory = None
    for shift in shifts:
        expected, after = reference(state, shift)
        memory = memory or after
        worst = np.minimum(worst, full_scale_error(found, expected).max(axis=-1))
        if worst.max() <= tolerance:
            break
    reference.remember(memory or {})
    env, *_, row = np.unravel_index(int(worst.argmax()), worst.shape)
    assert worst.max() <= tolerance, f"error {worst.max():.2e} of full scale in environment {env}, row {row}"
