"""Run-time checks of types and shapes in a third of the time: those of jaxtyping and beartype, less what their messages need.

At each call jaxtyping binds arguments to their names, for messages and for shapes that are written as f-strings, and checks
them twice; and it has checks of inner functions written and compiled anew whenever the outer one is called. Here parameters are
checked once, then the result; and checks are made when a function is first called, once for each that is written. Names that
stand further below in its file are known by then, which jaxtyping takes for anything; others mean what they do at first.
"""

import functools
import typing
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from inspect import Parameter, Signature, signature
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple, NoReturn
from unittest.mock import patch

import jaxtyping
from jaxtyping import AbstractArray, _decorator, _import_hook, config
from jaxtyping._storage import pop_shape_memo, push_shape_memo

ANYTHING = (Any, NoReturn, Parameter.empty)
"""Annotations of which nothing is to be checked."""


class Checks(NamedTuple):
    """What checks a function's calls.

    Attributes:
        parameters: Is called with the arguments; None if any will do.
        result: Is called with the result; likewise.
        has_axes: Whether there are arrays, whose axes of one name are to be of one length.
        code: The function's code, held so that no other gets its number.
    """

    parameters: Callable[..., Any] | None
    result: Callable[[Any], Any] | None
    has_axes: bool
    code: CodeType


_made: dict[int, Checks] = {}
"""By number of the code: constructors of data classes have codes that are equal, and other annotations."""
_signatures: dict[int, tuple[Signature, CodeType]] = {}
"""Likewise, from when a function is defined."""


def prepare() -> None:
    """Have the import hook decorate functions with `checked`."""
    whole = _decorator.jaxtyped

    def jaxtyped(fn: Any = None, *, typechecker: Any) -> Any:
        if fn is None:
            return functools.partial(jaxtyped, typechecker=typechecker)
        # Of classes, class methods and properties jaxtyping comes back here with their functions.
        return checked(fn, typechecker) if isinstance(fn, FunctionType) else whole(fn, typechecker=typechecker)

    _decorator.jaxtyped = jaxtyping.jaxtyped = jaxtyped

    def exec_module(self: Any, module: ModuleType) -> None:
        """Run a module; what it imports is taken from where Python keeps its bytecode, not from where jaxtyping keeps its own."""
        SourceFileLoader.exec_module(self, module)

    def get_code(self: Any, fullname: str) -> CodeType | None:
        kept_at = functools.partial(_import_hook._optimized_cache_from_source, self._typechecker.get_hash())
        with patch("importlib._bootstrap_external.cache_from_source", kept_at):
            return SourceFileLoader.get_code(self, fullname)

    _import_hook._JaxtypingLoader.exec_module = exec_module
    _import_hook._JaxtypingLoader.get_code = get_code


def checked(fn: FunctionType, typechecker: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that checks its parameters and its result, unless jaxtyping is disabled."""
    if hasattr(fn, "__checked__"):  # a constructor that a class inherits
        return fn
    _signature_of(fn)

    @functools.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        if config.jaxtyping_disable:
            return fn(*args, **kwargs)
        checks = _made.get(id(fn.__code__)) or _make(fn, typechecker)
        if checks.has_axes:
            push_shape_memo({})
        try:
            if checks.parameters is not None:
                checks.parameters(*args, **kwargs)
            result = fn(*args, **kwargs)
            if checks.result is not None:
                checks.result(result)
            return result
        finally:
            if checks.has_axes:
                pop_shape_memo()

    call.__checked__ = True  # pyright: ignore[reportFunctionMemberAccess]
    return call


def _make(fn: FunctionType, typechecker: Callable[..., Any]) -> Checks:
    """Return what checks a function, and remember it for the inner functions of the same code."""
    own = _signature_of(fn)
    known = [p.replace(annotation=_known(p.annotation, fn)) for p in own.parameters.values()]
    value = Parameter("result", Parameter.POSITIONAL_OR_KEYWORD, annotation=_known(own.return_annotation, fn))

    def check_of(parameters: list[Parameter]) -> Callable[..., Any] | None:
        if all(p.annotation in ANYTHING for p in parameters):
            return None
        names, wanted = (fn.__name__, fn.__qualname__, fn.__module__), own.replace(parameters=parameters, return_annotation=Any)
        return typechecker(_decorator._make_fn_with_signature(*names, wanted, output=False))

    has_axes = any(_has_array(p.annotation) for p in (*known, value))
    made = _made[id(fn.__code__)] = Checks(check_of(known), check_of([value]), has_axes, fn.__code__)
    return made


def _signature_of(fn: FunctionType) -> Signature:
    """Return a function's signature, with what its annotations mean by now; those that name what is not known stay text."""
    if id(fn.__code__) not in _signatures:
        own = signature(fn)
        parameters = [p.replace(annotation=_known(p.annotation, fn, p.annotation)) for p in own.parameters.values()]
        result = _known(own.return_annotation, fn, own.return_annotation)
        _signatures[id(fn.__code__)] = own.replace(parameters=parameters, return_annotation=result), fn.__code__
    return _signatures[id(fn.__code__)][0]


def _known(hint: Any, fn: FunctionType, unknown: Any = Any) -> Any:
    """Return what an annotation means."""
    if not isinstance(hint, str):
        return hint
    found = _decorator._destring_annotation(hint, fn.__globals__)
    return found if found is not Any or hint == "Any" else unknown


def _has_array(hint: Any) -> bool:
    if isinstance(hint, list | tuple):
        return any(map(_has_array, hint))
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(map(_has_array, typing.get_args(hint)))
