"""Trees of frozen dataclasses with arrays as leaves: flattened to names once, in the artefact, and built again from them.

A leaf's name is its path: names of fields, keys of mappings, and for members of tuples their `key`, `name` or number. A mapping
whose field has the metadata `inline` adds no name to the path. An array that stands in several places has one name.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

LEAF = "array"  # key of what stands for an array in JSON: its name
INLINE = {"inline": True}  # metadata of a dataclass's field for a mapping whose keys follow on the path of what holds it


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
            return {
                field.name: plain(getattr(value, field.name), path if field.metadata == INLINE else _joined(path, field.name))
                for field in dataclasses.fields(value)
            }
        if isinstance(value, Mapping):
            return {str(key): plain(part, _joined(path, str(key))) for key, part in value.items()}
        if isinstance(value, (tuple, list)):
            return [plain(part, _joined(path, _key(part, i))) for i, part in enumerate(value)]
        return value.item() if isinstance(value, np.generic) else value

    return plain(value, path), arrays


def mapped(value: Any, change: Callable[[np.ndarray], Any], is_kept: Callable[[Any], bool] = lambda record: False) -> Any:
    """Return a tree with other leaves; a dataclass that `is_kept` keeps its arrays.

    Parts without arrays stay the same objects. An array that stands in several places is changed once.
    """
    results: dict[int, Any] = {}

    def walk(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if id(value) not in results:
                results[id(value)] = change(value)
            return results[id(value)]
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


def frozen(array: np.ndarray) -> np.ndarray:
    """Return an array in one of the Plan's dtypes, row by row in memory and read-only: float64 or float32, int64 or int32."""
    narrow = (np.float32, np.int32)
    kind = array.dtype if array.dtype in narrow else np.int64 if array.dtype.kind in "iub" else np.float64
    array = np.ascontiguousarray(array, dtype=kind).reshape(array.shape)
    array.flags.writeable = False
    return array


def restored(kind: Any, plain: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the tree of a type, a dataclass, maybe generic, or what its fields may be, that `flatten` made plain."""
    origin = get_origin(kind) or kind
    if plain is None:
        return None
    if isinstance(kind, TypeVar) or origin is np.ndarray or hasattr(origin, "array_type"):
        return arrays[plain[LEAF]]
    if origin in (Union, types.UnionType):
        kinds = [part for part in get_args(kind) if part is not type(None)]
        if len(kinds) > 1 and isinstance(plain, dict):
            kinds = [part for part in kinds if _fields(get_origin(part) or part) == set(plain)]
        (one,) = kinds
        return restored(one, plain, arrays)
    if dataclasses.is_dataclass(origin):
        hints = get_type_hints(origin)
        return cast(Any, origin)(**{name: restored(hints[name], part, arrays) for name, part in plain.items()})
    if origin is tuple:
        first, *rest = get_args(kind)
        each = [first] * len(plain) if rest[-1:] == [Ellipsis] else [first, *rest]
        return tuple(restored(part_kind, part, arrays) for part_kind, part in zip(each, plain, strict=True))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: restored(get_args(kind)[1], part, arrays) for key, part in plain.items()}
    return float(plain) if origin is float else plain


def _is_record(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _fields(kind: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()


def _joined(path: str, name: str) -> str:
    return f"{path}/{name}" if path else name


def _key(part: Any, i: int) -> str:
    return str(getattr(part, "key", None) or getattr(part, "name", None) or i)
