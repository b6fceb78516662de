"""Hints for Inductor."""

from __future__ import annotations

from torch import Tensor


def materialised(tensor: Tensor) -> Tensor:
    """Materialise an intermediate: return it unchanged, as a view by strides, which Inductor does not fuse into what reads it.

    A number that there is once per environment is else recomputed for each taxel that uses it. The tensor must be no view:
    Inductor may pad the rows of what it materialises, and then the view's strides would be wrong.
    """
    return tensor.as_strided(tensor.shape, tensor.stride())
