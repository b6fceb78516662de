"""How many threads torch shares its operations out among."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
