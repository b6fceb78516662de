"""What it means that a module agrees with its kind's float64 reference."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from tgdsl.module.accuracy.reference import ReferenceModule, full_scale_error, row_errors
from tgdsl.module.state import SceneState

__all__ = ["assert_agrees", "full_scale_error"]


def assert_agrees(found: Tensor, reference: ReferenceModule, state: SceneState, tolerance: float) -> None:
    """Assert that readings equal the reference's, at ties that of one side; the reference then remembers this state."""
    worst = row_errors(found, reference, state, tolerance)
    env, *_, row = np.unravel_index(int(worst.argmax()), worst.shape)
    assert worst.max() <= tolerance, f"error {worst.max():.2e} of full scale in environment {env}, row {row}"
