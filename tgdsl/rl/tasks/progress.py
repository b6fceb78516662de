"""How much a rate of progress pays: what is beyond bounds pays no more, and going back may cost more than going forth pays.

With ω the rate and b = clip(ω, ω_min, ω_max), it pays b where b ≥ 0, and κ b elsewhere.
"""

from __future__ import annotations

from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.fields.models import Positive, Quantity, SpecModel


class ProgressSpec(SpecModel):
    """Bounds of the rate that pays: part of a task's document."""

    max_spin: Positive = 4.0
    """ω_max: what is faster pays no more [rad/s]."""
    min_spin: Annotated[float, Quantity("number", le=0.0)] | None = None
    """ω_min, at most 0: what goes back faster costs no more [rad/s]; null: it always does."""
    backward: Positive = 1.0
    """κ, factor on what goes back."""

    def pay(self, rate: Float[Tensor, " env"]) -> Float[Tensor, " env"]:
        """Return what pays of a rate [rad/s]."""
        bounded = rate.clamp(max=self.max_spin)
        if self.min_spin is not None:
            bounded = bounded.clamp(min=self.min_spin)
        return torch.where(bounded < 0, self.backward * bounded, bounded)
