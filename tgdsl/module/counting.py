"""Elementary operations of what torch computes, counted: the same on each machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from tgdsl.geometry.bvh import query_operations
from tgdsl.tensors.torch_internals import TorchDispatchMode

_FREE = frozenset(
    [
        "view",
        "select",
        "slice",
        "t",
        "transpose",
        "permute",
        "unsafe_view",
        "as_strided",
        "split",
        "split_with_sizes",
        "unsqueeze",
        "squeeze",
        "detach",
        "alias",
        "expand",
        "clone",
        "unbind",
        "to_copy",
    ]
)
"""Operations that compute nothing."""
_FFT = 2.5
"""Operations of a real fast Fourier transform of n numbers: this by n log2 n."""


class OperationCounter(TorchDispatchMode):
    """Counts what an eager run computes.

    A matrix product takes its additions and multiplications, a Fourier transform of n numbers 2.5 n log2 n, the nearest of some
    triangles what `geometry.bvh.query_operations` says; anything else one operation for each element that it writes.

    Attributes:
        elements: What was counted so far.
    """

    def __init__(self) -> None:
        from torch.utils.flop_counter import flop_registry  # which imports Triton

        super().__init__()
        self.elements = 0
        self._products: Mapping[Any, Callable[..., Any]] = flop_registry

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.elements += self._operations(func, args, kwargs or {}, result)
        return result

    def _operations(self, func: Any, args: Any, kwargs: Any, result: Any) -> int:
        name = func.__name__.split(".")[0].lstrip("_")
        written = [own for own in (result if isinstance(result, (tuple, list)) else [result]) if isinstance(own, torch.Tensor)]
        if name in _FREE or not written:
            return 0
        if func._overloadpacket in self._products:
            return int(self._products[func._overloadpacket](*args, **kwargs, out_val=result))
        if name == "mesh_distance":
            return query_operations(args[0], args[1], args[2])
        if name.startswith("fft_"):
            size = math.prod(max(args[0].shape[dim], written[0].shape[dim]) for dim in args[1])
            return int(_FFT * max(args[0].numel(), written[0].numel()) * math.log2(max(size, 2)))
        return written[0].numel()
