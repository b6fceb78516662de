"""What a compiler that fuses is told: where to keep a result, and where a Triton kernel stands in for torch's operations."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from types import FunctionType, MethodType
from typing import Any

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


def of_its_own(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a bound method whose code is a copy.

    Dynamo keeps what it made of a method with its code, for all objects together, looks through all of that at each call, and
    refuses to make more than eight (`recompile_limit`).
    """
    assert isinstance(method, MethodType)
    known = method.__func__
    own = FunctionType(known.__code__.replace(), known.__globals__, known.__name__, known.__defaults__, known.__closure__)
    return MethodType(own, method.__self__)


def takes_kernel(*tensors: Tensor) -> bool:
    """Return whether a Triton kernel can take these: all float32 on a GPU, and nobody asks for derivatives, which it lacks."""
    are_fit = all(tensor.is_cuda and tensor.dtype == torch.float32 for tensor in tensors)
    return HAS_TRITON and are_fit and not wants_derivatives(*tensors)


def wants_derivatives(*tensors: Tensor) -> bool:
    """Return whether somebody asks for derivatives with respect to any of these."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
