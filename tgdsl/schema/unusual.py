"""Values that are possible but were most likely meant in another unit: a warning says where they stand."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import get_type_hints

from pydantic import BaseModel

from tgdsl.fields.materials import Material
from tgdsl.fields.models import Usual
from tgdsl.schema.yaml import Path, Source


def warn_of_unusual(source: Source, spec: BaseModel) -> None:
    """Warn of each unusual value, at its place.

    Args:
        source: A document, or a file of its own, as found.
        spec: What it was read as.
    """
    found = {}
    for path, usual, value in _marked(spec, ()):
        if (what := usual.doubt(value)) is not None:
            path = _place(source, path)
            found[path, what] = str(source.problem(path, *what))
    for message in found.values():
        warnings.warn(message, stacklevel=4)


def _place(source: Source, path: Path) -> Path:
    """Return where a value stands in the file: a number may stand for a range, and a region for a list of one."""
    shorter = [path[:i] + path[i + 1 :] for i, part in enumerate(path) if isinstance(part, int)]
    for place in (path, *reversed(shorter)):
        if source.get(place) is not None:
            return place
    while path and source.get(path) is None:
        path = path[:-1]
    return path


def _marked(value: object, path: Path) -> Iterator[tuple[Path, Usual, float]]:
    """Yield the numbers of all fields that are marked, their places and marks."""
    if isinstance(value, (BaseModel, Material)):
        for name, metadata in _fields(value):
            inner = getattr(value, name)
            usual = next((part for part in metadata if isinstance(part, Usual)), None)
            if usual is None or isinstance(inner, BaseModel):
                yield from _marked(inner, (*path, name))
            else:
                yield from ((place, usual, number) for place, number in _numbers(inner, (*path, name)))
    elif isinstance(value, (tuple, list)):
        for i, part in enumerate(value):
            yield from _marked(part, (*path, i))
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _marked(part, (*path, name))


def _fields(value: BaseModel | Material) -> Iterator[tuple[str, Sequence[object]]]:
    """Yield the fields of a model, or of a material that it was read as, and what is said of each."""
    if isinstance(value, BaseModel):
        yield from ((name, field.metadata) for name, field in type(value).model_fields.items())
    else:
        hints = get_type_hints(type(value), include_extras=True)
        yield from ((name, getattr(hint, "__metadata__", ())) for name, hint in hints.items())


def _numbers(value: object, path: Path) -> Iterator[tuple[Path, float]]:
    if isinstance(value, (int, float)):
        yield path, float(value)
    elif isinstance(value, (tuple, list)):
        for i, part in enumerate(value):
            yield from _numbers(part, (*path, i))
