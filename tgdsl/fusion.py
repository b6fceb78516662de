"""What a compiler that fuses is told: where to keep a result, and where a Triton kernel stands in for torch's operations."""

from __future__ import annotations

from importlib.util import find_spec

import torch
from torch import Tensor

HAS_TRITON = find_spec("triton") is not None
"""Whether Triton is installed, as it is with every build of torch for a GPU."""


def stored(tensor: Tensor) -> Tensor:
    """Return a tensor unchanged, as a view of its memory: so a compiler makes memory for it.

    What there is once per environment would else be formed anew for each taxel that uses it.

    Args:
        tensor: What an operation has just made, and no view of that: a compiler may pad the rows of what it stores, and then
            a view's strides would be wrong.
    """
    return tensor.as_strided(tensor.shape, tensor.stride())


def takes_kernel(*tensors: Tensor) -> bool:
    """Return whether a Triton kernel can take these: float32 on a GPU, and nobody asks for derivatives, which it lacks."""
    wants_derivatives = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return HAS_TRITON and tensors[0].is_cuda and tensors[0].dtype == torch.float32 and not wants_derivatives
