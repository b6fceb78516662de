"""What students are taught by: errors of their actions, and of what their decoders tell; a loss per student.

With a_s a student's action, a_t the teacher's, σ_t the standard deviation of the teacher's (1 for `mse`), a_0 what the student
asked for in the rollout (in an earlier one that is kept: would ask for when the pass begins), and
a_c = a_0 + clamp(a_s − a_0, ±clip):

    behaviour    mean of (a_s − a_t)²/σ_t²;  with a clip, of max((a_s − a_t)², (a_c − a_t)²)/σ_t²
    decoder k    w_k · mean of (d_k − s_k y_k)²,  y_k being the privileged number

Source: Chung et al., *Tactile Genesis*, appendix. It names the loss, "inv-var MSE", and a clip parameter of 0.1; the formulas
are ours: σ_t² as the variance, and the clip as PPO bounds values.

Shapes: `student` students of a stack, `row` rows of each, `joint` joints, `target` privileged numbers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

Actions = Float[Tensor, "student row joint"]
Told = Float[Tensor, "student row target"]


def behaviour(
    action: Actions, label: Actions, before: Actions, std: Float[Tensor, " joint"] | None = None, clip: float | None = None
) -> Float[Tensor, " student"]:
    """Return the error of actions.

    Args:
        action: a_s.
        label: a_t.
        before: a_0.
        std: σ_t; None: 1.
        clip: Bound of a_s − a_0; None: there is none.
    """
    error = (action - label).square()
    if clip is not None:
        bounded = before + (action - before).clamp(-clip, clip)
        error = torch.maximum(error, (bounded - label).square())
    if std is not None:
        error = error / std.square()
    return error.mean(dim=(1, 2))


def decoded(
    told: Told, targets: Told, scales: Float[Tensor, " target"], weights: Float[Tensor, " target"]
) -> Float[Tensor, " student"]:
    """Return the weighted error of what decoders tell; zeros if there are none."""
    return ((told - scales * targets).square().mean(dim=1) * weights).sum(dim=1)
