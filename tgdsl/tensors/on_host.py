"""Small tensors on the host: copies from a GPU without a wait, and operations on one thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class HostCopy:
    """A tensor's values on the host. For a tensor on a GPU they are from an earlier call, so no call waits."""

    def __init__(self) -> None:
        """Start without a copy."""
        self._copy: Tensor | None = None
        self._copied: torch.cuda.Event | None = None

    def poll(self, values: Tensor) -> Tensor | None:
        """Return the last values that have arrived, None if none have, and start a copy of the present ones."""
        if values.device.type != "cuda":
            return values.detach()
        if torch.cuda.is_current_stream_capturing() or (self._copied is not None and not self._copied.query()):
            return None
        arrived = None if self._copied is None or self._copy is None else self._copy.clone()
        with torch.inference_mode(False), torch.no_grad():
            if self._copy is None:
                self._copy = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            self._copy.copy_(values, non_blocking=True)
        self._copied = torch.cuda.Event()
        self._copied.record(torch.cuda.current_stream(values.device))
        return arrived


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's operations on one thread within the block, for small tensors.

    torch itself splits no operation of less than 2¹⁵ elements, but roots, exponentials and logarithms are MKL's, which uses all
    threads from 256 elements on. Waking a sleeping thread takes a tenth of a millisecond or more, and a spinning one slows
    MuJoCo's threads.

    The setting applies to the calling thread, and is the initial value for Python threads: a thread whose first work in torch
    falls into this block keeps one thread, until it calls `torch.set_num_threads`.
    """
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(num_threads)
