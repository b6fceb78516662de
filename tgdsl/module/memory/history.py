"""What a sensor read at its last calls: a window over them, in order.

A window is part of the state like any other: a pure function of the old one and the present reading. So it is compiled,
captured in a CUDA graph, and advanced for some environments alone.

Shapes: `env` environments, `step` calls, oldest first, `row` taxels or bodies, `channel` numbers per row.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

Window = Float[Tensor, "env step channel row"]


def pushed(window: Window, reading: Float[Tensor, "env row channel"], age: Int[Tensor, " env"]) -> Window:
    """Return the window after a call. Before there are enough calls since a reset, the first one stands for the missing.

    Args:
        window: The window before.
        reading: The present reading; its gradients are kept.
        age: Calls since each environment's reset, before this one.
    """
    newest = reading.transpose(1, 2)[:, None]
    moved = torch.cat([window[:, 1:], newest], dim=1)
    return torch.where((age == 0)[:, None, None, None], newest, moved)


def reduced(window: Window, reduce: str) -> Float[Tensor, "env *step row channel"]:
    """Return what is read of a window: all of it (`stack`), or the `mean` or `median` of each number."""
    if reduce == "stack":
        return window.transpose(2, 3)
    if reduce == "mean":
        return window.mean(dim=1).transpose(1, 2)
    ordered, count = window.sort(dim=1).values, window.shape[1]  # of an even number the mean of both middle ones
    return (0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2])).transpose(1, 2)


def last_step(reading: Float[Tensor, "env *step row channel"]) -> Float[Tensor, "env row channel"]:
    """Return the last one of stacked calls, or a reading that is of one call."""
    return reading[:, -1] if reading.ndim == 4 else reading
