"""A Plan's arrays as the buffers of a module."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tgdsl.tensors.devices import check_dtype
from tgdsl.tensors.torch_internals import HookedModule, buffers_of, mark_static


class Constants(HookedModule):
    """Arrays as buffers, by name. A change of dtype starts from the arrays' own float64, so no value is rounded twice.

    Attributes:
        tree: The result of `bind` on the buffers; rebuilt when they are replaced.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], dtype: torch.dtype, bind: Callable[[Callable[[str], Tensor]], Any]):
        """Make a buffer of each array, floats in `dtype`; `bind` makes of a function from names to tensors what calls read."""
        check_dtype(dtype)
        super().__init__()
        with torch.inference_mode(False):  # whoever builds a module there may want derivatives later
            self._exact = {name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}
            for name, exact in self._exact.items():
                self.register_buffer(name, exact.to(dtype) if exact.is_floating_point() else exact.clone(), persistent=False)
        self._like = torch.empty(0, dtype=dtype)
        self._bind = bind
        self._rebind()

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the floats, or what it would be if there are none."""
        for buffer in buffers_of(self).values():
            if buffer is not None and buffer.is_floating_point():
                return buffer.dtype
        return self._like.dtype

    @property
    def device(self) -> torch.device:
        """Device of all arrays."""
        return next(b.device for b in buffers_of(self).values() if b is not None)

    def __getitem__(self, name: str) -> Tensor:
        """Return the array of a path."""
        return buffers_of(self)[name]  # type: ignore[return-value]

    def __contains__(self, name: str) -> bool:
        """Return whether there is an array of a path."""
        return name in buffers_of(self)

    def overwrite(self, name: str, value: np.ndarray) -> None:
        """Put other numbers in the place of an array, of its shape: captured graphs go on with them."""
        with torch.inference_mode(False), torch.no_grad():
            self._exact[name] = torch.from_numpy(np.array(value))
            self[name].copy_(self._exact[name])

    def refresh(self) -> None:
        """Bind again if some buffer is another tensor than before, as under `torch.func.functional_call`."""
        if not all(map(operator.is_, buffers_of(self).values(), self._bound.values())):  # at each call, so in C
            self._rebind()

    def _rebind(self) -> None:
        self._bound = dict(buffers_of(self))
        for tensor in self._bound.values():
            if tensor is not None:
                mark_static(tensor)  # Dynamo sees them in the tree, where it does not know them for buffers
        self.tree = self._bind(self.__getitem__)

    def on_move(self, fn: Callable[[Tensor], Tensor], move: Callable[[], object]) -> None:
        """Move or cast all buffers, from the Plan's float64 where nobody has changed them."""
        held = buffers_of(self)
        old_buffers = dict(held)
        self._like = fn(self._like)
        move()
        for name, exact in self._exact.items():
            old, new = old_buffers[name], held[name]
            assert old is not None and new is not None
            is_untouched = new.dtype != old.dtype and torch.equal(old.detach().cpu(), exact.to(old.dtype))
            if is_untouched:
                held[name] = exact.to(device=new.device, dtype=new.dtype)
        self._rebind()
