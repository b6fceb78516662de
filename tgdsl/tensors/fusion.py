"""Hints for torch.compile: where to materialise an intermediate, and what to compile apart."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any

from torch import Tensor


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
