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
from jaxtyping import AbstractArray, _array_types, _decorator, _import_hook, _storage, config
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
    _array_types._MetaAbstractArray.__instancecheck__ = is_instance

    def exec_module(self: Any, module: ModuleType) -> None:
        """Run a module; what it imports is taken from where Python keeps its bytecode, not from where jaxtyping keeps its own."""
        SourceFileLoader.exec_module(self, module)

    def get_code(self: Any, fullname: str) -> CodeType | None:
        kept_at = functools.partial(_import_hook._optimized_cache_from_source, self._typechecker.get_hash())
        with patch("importlib._bootstrap_external.cache_from_source", kept_at):
            return SourceFileLoader.get_code(self, fullname)

    _import_hook._JaxtypingLoader.exec_module = exec_module
    _import_hook._JaxtypingLoader.get_code = get_code


class Shape(NamedTuple):
    """What an array has to be like.

    Attributes:
        axes: Name of each axis that has one, and else the length that it is to have, if any; None if there are other axes.
        seen: Types and dtypes of arrays that were found to be right.
    """

    axes: list[str | int | None] | None
    seen: set[tuple[type, Any]]


_shapes: dict[Any, Shape] = {}
"""By annotation."""


def is_instance(cls: Any, value: Any) -> bool:
    """Return whether an array is as annotated: jaxtyping's own answer, which is not asked again for what it found right.

    Lengths of axes are looked at each time; what is not right, or is written in another way than by names and numbers, is
    jaxtyping's to judge.
    """
    axes, seen = _shapes.get(cls) or _shapes.setdefault(cls, Shape(_axes_of(cls), set()))
    kind = type(value), getattr(value, "dtype", None)
    if axes is not None and kind in seen:
        shape = value.shape
        if len(shape) == len(axes):
            stack = getattr(_storage._shape_storage, "memo_stack", None)
            lengths, added = stack[-1][0] if stack else {}, []
            for axis, length in zip(axes, shape, strict=True):
                if axis.__class__ is str:
                    known = lengths.get(axis)
                    if known is None:
                        lengths[axis] = length
                        added.append(axis)
                    elif known != length:
                        break
                elif axis is not None and axis != length:
                    break
            else:
                return True
            for axis in added:
                del lengths[axis]
    is_right = cls.__instancecheck_str__(value) == ""
    if is_right:
        seen.add(kind)
    return is_right


def _axes_of(cls: Any) -> list[str | int | None] | None:
    axes = []
    for dim in getattr(cls, "dims", ()) or ():
        if dim is _array_types._anonymous_dim:
            axes.append(None)
        elif isinstance(dim, _array_types._FixedDim) and not dim.broadcastable:
            axes.append(dim.size)
        elif isinstance(dim, _array_types._NamedDim) and not dim.broadcastable and not dim.treepath:
            axes.append(dim.name)
        else:
            return None
    return axes if hasattr(cls, "dims") and getattr(cls, "index_variadic", 0) is None else None


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
        parameters, own, has_axes, _ = _made.get(id(fn.__code__)) or _make(fn, typechecker)
        if has_axes:
            push_shape_memo({})
        try:
            if parameters is not None:
                parameters(*args, **kwargs)
            result = fn(*args, **kwargs)
            if own is not None:
                own(result)
            return result
        finally:
            if has_axes:
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
