"""Run-time checks of types and shapes in less time: the same checks, made once for each function that is written.

The import hook decorates functions inside of functions whenever the outer one is called. beartype then writes and compiles
their checks anew, which took a third of the time of some tests.
"""

from collections.abc import Callable
from typing import Any

from jaxtyping import _decorator


def prepare() -> None:
    """Have the parts of jaxtyping's decorator that depend on a signature alone remember their results."""
    _decorator._make_fn_with_signature = _remembered(_decorator._make_fn_with_signature, lambda *_: True)
    _decorator._apply_typechecker = _remembered(_decorator._apply_typechecker, lambda *_: True)
    # A name that is not defined yet is `Any`, and may be defined when the next function is decorated.
    _decorator._destring_annotation = _remembered(_decorator._destring_annotation, lambda hint: hint is not Any)


def _remembered(function: Callable[..., Any], is_final: Callable[[Any], bool]) -> Callable[..., Any]:
    """Return a function that makes each result once; dictionaries are told apart by which they are."""
    results: dict[Any, tuple[Any, Any]] = {}

    def call(*args: Any, **kwargs: Any) -> Any:
        key = (tuple(id(value) if isinstance(value, dict) else value for value in args), *sorted(kwargs.items()))
        try:
            known = results.get(key)
        except TypeError:  # a default value that cannot be hashed
            return function(*args, **kwargs)
        if known is None:
            known = function(*args, **kwargs), args  # held, so that no other dictionary gets its number
            if is_final(known[0]):
                results[key] = known
        return known[0]

    return call
