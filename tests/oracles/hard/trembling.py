"""Scenes at rest that tremble, as a solver leaves them."""

from __future__ import annotations

from typing import Any

import torch

from tgdsl.module.state import SceneState

JITTER = 1e-9
"""What a solver leaves of motion at rest [m, and of a unit quaternion]."""
NUM_STEPS = 10_000
"""Steps that tests look at."""


def repeated(scene: SceneState, num: int) -> SceneState:
    """Return an environment many times over."""
    names = ("body_pos", "body_quat", "body_linvel", "body_angvel", "contact_found")
    values: dict[str, Any] = {name: getattr(scene, name) for name in names}
    return SceneState(**{k: v.expand(num, *v.shape[1:]).clone() for k, v in values.items() if v is not None})


def jittered(scene: SceneState, num: int, seed: int = 0) -> SceneState:
    """Return as many steps of a scene at rest, all poses trembling."""
    steps = repeated(scene, num)
    generator = torch.Generator().manual_seed(seed)
    assert steps.body_pos is not None and steps.body_quat is not None
    for tensor in (steps.body_pos, steps.body_quat):
        tensor += JITTER * torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
    return steps
