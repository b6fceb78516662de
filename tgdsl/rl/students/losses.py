"""Losses of students: errors of their actions and of their decoders, one loss per student.

With a_s a student's action, a_t the teacher's, σ_t the standard deviation of the teacher's exploration (`inverse_variance`) or
actions (`normalise`), else 1, a_0 what the student asked for in the rollout (in an earlier one that is kept: would ask for when
the pass begins), a_c = a_0 + clamp(a_s − a_0, ±clip), and h(e) = e², or for `huber` e² up to |e| = 1 and 2|e| − 1 beyond:

    behaviour    mean of h((a_s − a_t)/σ_t);  with a clip, of max(h((a_s − a_t)/σ_t), h((a_c − a_t)/σ_t))
    decoder k    w_k · mean of (d_k − s_k y_k)²,  y_k being the privileged number

Source: Chung et al., *Tactile Genesis*, appendix. It names the loss, "inv-var MSE", and a clip parameter of 0.1; the formulas
are ours: σ_t² as the variance, and the clip as PPO bounds values. Normalised actions and Huber's loss are of the authors'
public code: see docs/paper.md; its bound of 1 is ours.

Shapes: `student` students of a stack, `row` rows of each, `joint` joints, `target` privileged numbers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

Actions = Float[Tensor, "student row joint"]
Targets = Float[Tensor, "student row target"]


def behaviour(
    action: Actions,
    label: Actions,
    before: Actions,
    std: Float[Tensor, " joint"] | None = None,
    clip: float | None = None,
    *,
    is_huber: bool = False,
) -> Float[Tensor, " student"]:
    """Return the error of actions."""
    error = (action - label).abs()
    if clip is not None:
        bounded = before + (action - before).clamp(-clip, clip)
        error = torch.maximum(error, (bounded - label).abs())
    if std is not None:
        error = error / std
    loss = torch.where(error <= 1.0, error.square(), 2.0 * error - 1.0) if is_huber else error.square()
    return loss.mean(dim=(1, 2))


def decoded(
    output: Targets, targets: Targets, scales: Float[Tensor, " target"], weights: Float[Tensor, " target"]
) -> Float[Tensor, " student"]:
    """Return the weighted error of the decoders; zeros if there are none."""
    return ((output - scales * targets).square().mean(dim=1) * weights).sum(dim=1)
