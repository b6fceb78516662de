"""torch.compile in less time: what it compiles stays as it is, to the byte.

Most of the time that a test of compiled kernels takes is Inductor's and sympy's, in Python. A third of it is spared by caches
that hold all expressions of a module, where theirs hold the last 128 or 1,000, and by a garbage collector that runs seldom and
does not look at what was imported. What is kept is forgotten after each file of tests that compiles: memory does not grow.
"""

import functools
import gc
import os
from functools import cache
from types import ModuleType
from typing import Any

SYMPY_CACHE = "200000"
"""Results that sympy keeps of each of its functions; it reads the number when it is imported."""
COLLECTED_AFTER = (100_000, 10, 10)
"""Objects made and not freed before the collector looks at them; 700, 10 and 10 are Python's own."""


def prepare() -> None:
    """Set what has to be set before torch and sympy are imported; processes that tests start inherit the first."""
    os.environ.setdefault("SYMPY_CACHE_SIZE", SYMPY_CACHE)
    gc.set_threshold(*COLLECTED_AFTER)


def settle() -> None:
    """Have the collector leave alone what is there by now, some million objects: it lives as long as the process."""
    gc.collect()
    gc.freeze()


@cache
def _settle_once() -> None:
    settle()


_widened: list[functools._lru_cache_wrapper] = []


def forget() -> None:
    """Free what was kept for graphs of modules that are gone, and these, if anything was compiled."""
    if not any(wide.cache_info().currsize for wide in _widened):
        return
    import torch
    from sympy.core.cache import clear_cache
    from torch._subclasses.fake_tensor import FakeTensorMode

    for wide in _widened:
        wide.cache_clear()
    torch.compiler.reset()
    FakeTensorMode.cache_clear()
    clear_cache()
    _settle_once() or gc.collect()


@cache
def quicken() -> None:
    """Widen the caches of Inductor's functions of strides, and fill its table of dtypes once instead of for each operation."""
    from torch._inductor import sizevars
    from torch._inductor.codegen import cpp
    from torch._inductor.dtype_propagation import DtypePropagationOpsHandler

    _leave_polynomials(sizevars)
    for name in ("stride_at", "simplify_index_in_vec_range", "stride_at_vec_range"):
        known = getattr(sizevars, name, None)
        if known is None:  # in torch 2.11 these are elsewhere: there it takes longer, that is all
            continue
        wide = functools.lru_cache(maxsize=None)(getattr(known, "__wrapped__", known))
        _widened.append(wide)
        setattr(sizevars, name, wide)
        if hasattr(cpp, name):
            setattr(cpp, name, wide)

    fill = DtypePropagationOpsHandler.__init__
    filled = set()

    def fill_once(self: DtypePropagationOpsHandler) -> None:
        """The handler is a singleton, whose rules torch sets again whenever it is asked for."""
        if id(self) not in filled:
            fill(self)
            filled.add(id(self))

    DtypePropagationOpsHandler.__init__ = fill_once


def _leave_polynomials(sizevars: ModuleType) -> None:
    """Have strides taken of sums and products as they are, and simplified themselves alone, when they are no single number.

    Before Inductor takes a stride, it looks for divisions that do not change within a vector. Where there are none, it has sympy
    simplify an index all the same, which takes a seventh of all its time.
    """
    from sympy import Add, Integer, Mul, Symbol, expand, preorder_traversal

    def is_plain(index: Any) -> bool:
        return all(isinstance(part, Add | Mul | Symbol | Integer) for part in preorder_traversal(index))

    simplified = getattr(sizevars, "simplify_index_in_vec_range", None)
    stride = getattr(sizevars, "stride_at", None)
    if simplified is None or stride is None:
        return
    simplified, stride = simplified.__wrapped__, stride.__wrapped__

    def simplify_index_in_vec_range(index: Any, var: Any, vec_length: int) -> Any:
        return index if is_plain(index) else simplified(index, var, vec_length)

    def stride_at(index: Any, var: Any) -> Any:
        if is_plain(index):
            difference = expand(index.xreplace({var: var + 1}) - index)
            if isinstance(difference, Integer | Symbol):
                return difference
        return stride(index, var)

    sizevars.simplify_index_in_vec_range = simplify_index_in_vec_range  # pyright: ignore[reportAttributeAccessIssue]
    sizevars.stride_at = stride_at  # pyright: ignore[reportAttributeAccessIssue]
