"""Few numbers on the host: those of a GPU without waiting for it, and operations by one thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class HostCopy:
    """A tensor's numbers on the host; of one on a GPU, which is not waited for, those that an earlier call found there."""

    def __init__(self) -> None:
        """Begin; nothing has been copied."""
        self._copy: Tensor | None = None
        self._copied: torch.cuda.Event | None = None

    def poll(self, values: Tensor) -> Tensor | None:
        """Return the numbers that have arrived, None if none have, and have the present ones copied."""
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
    """Have torch do operations of few numbers by one thread; afterwards it has as many as before.

    torch itself shares out no operation of less than 2¹⁵ numbers, but roots, exponentials and logarithms are MKL's, which wakes
    all threads for 256: to wake one that sleeps takes a tenth of a millisecond and more, and one that does not sleep is in the
    way of MuJoCo's.

    The number is the calling thread's, and that which Python threads begin with: one whose first work in torch falls into this
    block keeps one thread, until it calls `torch.set_num_threads`.
    """
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(num_threads)
