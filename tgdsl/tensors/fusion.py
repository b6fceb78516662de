"""Hints for Inductor: where to materialise an intermediate."""

from __future__ import annotations

from torch import Tensor


def stored(tensor: Tensor) -> Tensor:
    """Return a tensor unchanged, as a view of its memory: so a compiler makes memory for it.

    What there is once per environment would else be formed anew for each taxel that uses it.

    Args:
        tensor: What an operation has just made, and no view of that: a compiler may pad the rows of what it stores, and then
            a view's strides would be wrong.
    """
    return tensor.as_strided(tensor.shape, tensor.stride())
