"""A Plan's arrays as the buffers of a module."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from tgdsl.tensors.devices import check_dtype
from tgdsl.tensors.torch_internals import HookedModule, buffers_of


class Constants(HookedModule):
    """The Plan's arrays as buffers. A change of dtype starts from the Plan's float64, so that nothing is rounded twice."""

    def __init__(self, arrays: Mapping[str, np.ndarray], dtype: torch.dtype):
        """Make a buffer of each array, floats in `dtype`.

        Raises:
            TgdslError: If no module can be of that dtype.
        """
        check_dtype(dtype)
        super().__init__()
        self._counts = {name: tuple(array[0].tolist()) for name, array in arrays.items() if name.endswith("/num")}
        with torch.inference_mode(False):  # whoever builds a module there may want derivatives later
            self._exact = {name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}
            for name, exact in self._exact.items():
                self.register_buffer(name, exact.to(dtype) if exact.is_floating_point() else exact.clone(), persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the floats."""
        return next((b.dtype for b in buffers_of(self).values() if b is not None and b.is_floating_point()), torch.float32)

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

    def counts(self, name: str) -> tuple[int, int, int]:
        """Return the first row of a table of node counts, `<path>/num`, as numbers that become part of compiled code."""
        return self._counts[name]

    def under(self, prefix: str, names: Sequence[str]) -> dict[str, Tensor]:
        """Return some of the arrays below a path, by their own names."""
        return {name: self[f"{prefix}/{name}"] for name in names}

    def on_move(self, fn: Callable[[Tensor], Tensor], move: Callable[[], object]) -> None:
        """Move or cast all buffers, from the Plan's float64 where nobody has changed them."""
        held = buffers_of(self)
        before = dict(held)
        move()
        for name, exact in self._exact.items():
            old, new = before[name], held[name]
            assert old is not None and new is not None
            is_untouched = new.dtype != old.dtype and torch.equal(old.detach().cpu(), exact.to(old.dtype))
            if is_untouched:
                held[name] = exact.to(device=new.device, dtype=new.dtype)
