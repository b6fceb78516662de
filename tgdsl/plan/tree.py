"""Trees of frozen dataclasses with arrays as leaves: flattened to names once, in the artefact, and built again from them.

A leaf's name is the path to it: names of fields, keys of mappings, of members of tuples their `key` or `name` or else their
number. A mapping whose field says `inline` adds nothing of its own. An array that stands in several places has one name.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from tgdsl.errors import ArtifactError

LEAF = "array"
"""Key of what stands for an array in JSON: its name."""
INLINE = {"inline": True}
"""Metadata of a dataclass's field for a mapping whose keys follow on the path of what holds it."""
DTYPES = (np.float64, np.float32, np.int64, np.int32)
"""Dtypes that arrays of the Plan have."""


def flatten(value: Any, path: str = "") -> tuple[Any, dict[str, np.ndarray]]:
    """Return a tree as plain values that JSON can hold, and its arrays by name."""
    names: dict[int, str] = {}
    arrays: dict[str, np.ndarray] = {}

    def plain(value: Any, path: str) -> Any:
        if isinstance(value, np.ndarray):
            name = names.setdefault(id(value), path)
            arrays[name] = value
            return {LEAF: name}
        if _is_record(value):
            return {f.name: plain(getattr(value, f.name), below(path, f)) for f in dataclasses.fields(value)}
        if isinstance(value, Mapping):
            return {str(key): plain(part, _joined(path, str(key))) for key, part in value.items()}
        if isinstance(value, (tuple, list)):
            return [plain(part, _joined(path, _key(part, i))) for i, part in enumerate(value)]
        return value.item() if isinstance(value, np.generic) else value

    return plain(value, path), arrays


def named(plain: Any) -> set[str]:
    """Return the names of the arrays that a tree which was made plain has."""
    if isinstance(plain, dict):
        if set(plain) == {LEAF} and isinstance(plain[LEAF], str):
            return {plain[LEAF]}
        return set().union(*map(named, plain.values()))
    return set().union(*map(named, plain)) if isinstance(plain, list) else set()


def mapped(value: Any, change: Callable[[np.ndarray], Any], is_kept: Callable[[Any], bool] = lambda record: False) -> Any:
    """Return a tree with other leaves; what has none stays as it is. An array that stands in several places is changed once.

    Args:
        value: The tree.
        change: Returns what stands for an array.
        is_kept: Whether a dataclass keeps its arrays.
    """
    made: dict[int, Any] = {}

    def walk(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if id(value) not in made:
                made[id(value)] = change(value)
            return made[id(value)]
        if _is_record(value):
            if is_kept(value):
                return value
            parts = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            new = {name: walk(part) for name, part in parts.items()}
            return value if all(new[name] is part for name, part in parts.items()) else type(value)(**new)
        if isinstance(value, Mapping):
            result = {key: walk(part) for key, part in value.items()}
            return value if all(result[key] is part for key, part in value.items()) else result
        if isinstance(value, (tuple, list)):
            parts = tuple(walk(part) for part in value)
            return value if all(a is b for a, b in zip(parts, value, strict=True)) else parts
        return value

    return walk(value)


def members(parts: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the members of a tuple or mapping, each after its name."""
    if isinstance(parts, Mapping):
        yield from ((_joined(path, str(key)), part) for key, part in parts.items())
    else:
        yield from ((_joined(path, _key(part, i)), part) for i, part in enumerate(parts))


def records(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the dataclasses of a tree, those that hold others first, each after its name."""
    if _is_record(value):
        yield path, value
        for field in dataclasses.fields(value):
            yield from records(getattr(value, field.name), below(path, field))
    elif isinstance(value, (Mapping, tuple, list)):
        for name, part in members(value, path):
            yield from records(part, name)


def frozen(array: np.ndarray) -> np.ndarray:
    """Return an array in one of the Plan's dtypes, row by row in memory and read-only: float64 or float32, int64 or int32."""
    kept = (np.float32, np.int32)
    kind = array.dtype if array.dtype in kept else np.int64 if array.dtype.kind in "iub" else np.float64
    array = np.ascontiguousarray(array, dtype=kind).reshape(array.shape)
    array.flags.writeable = False
    return array


def restored(kind: Any, plain: Any, arrays: Mapping[str, np.ndarray], path: str = "plan") -> Any:
    """Return the tree of a type that `flatten` made plain.

    Args:
        kind: The type: a dataclass, maybe generic, or what its fields may be.
        plain: What JSON held.
        arrays: The arrays by name.
        path: Where it stands, for messages.

    Raises:
        ArtifactError: If the values are not of the type.
    """
    origin = get_origin(kind) or kind
    if isinstance(kind, TypeVar) or _is_array(origin):
        return _leaf(plain, arrays, path)
    if kind is Any:
        return plain
    if origin in (Union, types.UnionType):
        return _one_of(get_args(kind), plain, arrays, path)
    if origin is Literal:
        if plain not in get_args(kind):
            raise _wrong(path, plain, f"one of {', '.join(map(str, get_args(kind)))}")
        return plain
    if dataclasses.is_dataclass(origin):
        return _record(origin, plain, arrays, path)
    if origin is tuple:
        return _members(get_args(kind), plain, arrays, path)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(plain, dict):
            raise _wrong(path, plain, "a mapping")
        return {key: restored(get_args(kind)[1], part, arrays, _joined(path, key)) for key, part in plain.items()}
    if origin is float and isinstance(plain, int) and not isinstance(plain, bool):
        return float(plain)
    if not isinstance(plain, origin) or (isinstance(plain, bool) and origin is not bool):
        raise _wrong(path, plain, getattr(origin, "__name__", str(origin)))
    return plain


def _is_record(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _is_array(origin: Any) -> bool:
    return origin is np.ndarray or hasattr(origin, "array_type")


def below(path: str, field: dataclasses.Field) -> str:
    """Return the name of a field of what is at a path."""
    return path if field.metadata.get("inline") else _joined(path, field.name)


def _joined(path: str, name: str) -> str:
    return f"{path}/{name}" if path else name


def _key(part: Any, i: int) -> str:
    return str(getattr(part, "key", None) or getattr(part, "name", None) or i)


def _leaf(plain: Any, arrays: Mapping[str, np.ndarray], path: str) -> np.ndarray:
    if not isinstance(plain, dict) or set(plain) != {LEAF} or plain[LEAF] not in arrays:
        raise _wrong(path, plain, "the name of an array")
    return arrays[plain[LEAF]]


def _one_of(kinds: tuple[Any, ...], plain: Any, arrays: Mapping[str, np.ndarray], path: str) -> Any:
    """Return the value of the one type of a union that it can be of: none, or the record with its fields."""
    if plain is None and type(None) in kinds:
        return None
    kinds = tuple(kind for kind in kinds if kind is not type(None))
    if len(kinds) > 1 and isinstance(plain, dict):
        kinds = tuple(kind for kind in kinds if _fields(get_origin(kind) or kind) == set(plain))
    if len(kinds) != 1:
        raise _wrong(path, plain, "another value")
    return restored(kinds[0], plain, arrays, path)


def _fields(kind: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()


def _record(kind: Any, plain: Any, arrays: Mapping[str, np.ndarray], path: str) -> Any:
    if not isinstance(plain, dict) or set(plain) != _fields(kind):
        raise _wrong(path, plain, f"the fields {', '.join(sorted(_fields(kind)))}")
    hints = get_type_hints(kind)
    return kind(**{name: restored(hints[name], part, arrays, _joined(path, name)) for name, part in plain.items()})


def _members(kinds: tuple[Any, ...], plain: Any, arrays: Mapping[str, np.ndarray], path: str) -> tuple[Any, ...]:
    if not isinstance(plain, list):
        raise _wrong(path, plain, "a list")
    each = [kinds[0]] * len(plain) if kinds[-1] is Ellipsis else list(kinds)
    if len(each) != len(plain):
        raise _wrong(path, plain, f"{len(each)} values")
    return tuple(restored(k, part, arrays, _joined(path, str(i))) for i, (k, part) in enumerate(zip(each, plain, strict=True)))


def _wrong(path: str, plain: Any, expected: str) -> ArtifactError:
    found = repr(plain)
    return ArtifactError(f"not a plan: {path}: found {found if len(found) <= 80 else f'{found[:77]}…'}, expected {expected}")
