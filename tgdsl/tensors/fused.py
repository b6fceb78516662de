"""Methods that do many small things to tensors, compiled by torch into a few kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, ParamSpec, TypeVar

import torch

from tgdsl.tensors.torch_internals import with_own_code

P = ParamSpec("P")
T = TypeVar("T")


class FusedCall(Generic[P, T]):
    """A method whose first call runs eagerly; later calls are compiled, if `is_compiled`.

    The first call fills caches, such as tensors copied from the host and hashes of names, for the compiled calls. Parts that
    torch cannot compile run eagerly.

    The method may change tensors in place, but must not copy one that it changes afterwards as it is: after
    `before.copy_(now); now.copy_(new)` Inductor has `new` in both (https://github.com/pytorch/pytorch/issues/198131).
    """

    def __init__(self, method: Callable[P, T], is_compiled: bool, has_fixed_shapes: bool = True):
        """Take a bound method; its tensors may have the same shapes at each call."""
        self._method, self._is_compiled, self._has_fixed_shapes = method, is_compiled, has_fixed_shapes
        self._compiled: Callable[P, T] | None = None
        self._has_begun = False

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        """Call the method."""
        if not self._is_compiled or not self._has_begun:
            self._has_begun = True
            return self._method(*args, **kwargs)
        if self._compiled is None:
            compiled: Any = torch.compile(with_own_code(self._method), dynamic=not self._has_fixed_shapes)
            self._compiled = compiled
        assert self._compiled is not None
        return self._compiled(*args, **kwargs)
