"""Whether the indices that a Plan holds are of things that are there: looked at once, when an artefact is loaded.

A hash only says that a file is whole. One that was edited by hand, and rehashed, may hold any number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from tgdsl.errors import ArtifactError
from tgdsl.fields.indices import KEY, Indices
from tgdsl.plan import tree


def check(plan: Any) -> None:
    """Refuse a Plan with an index of nothing: the fields that `fields.indices.indices` declares.

    Raises:
        ArtifactError: With the name of the array or value, what it holds and what it may.
    """
    for top in dataclasses.fields(plan):
        parts = getattr(plan, top.name)
        for path, part in tree.members(parts, top.name) if isinstance(parts, (tuple, Mapping)) else [(top.name, parts)]:
            for place, record in tree.records(part, path):
                for field in dataclasses.fields(record):
                    if KEY in field.metadata:
                        name, value = tree.below(place, field), getattr(record, field.name)
                        _check_field(name, value, field.metadata[KEY], (record, part, plan))


def check_constants(name: str, constants: Mapping[str, np.ndarray], counts: Mapping[str, Any]) -> None:
    """Refuse constants of a kind that are indices of nothing: see `Kind.indices`.

    Raises:
        ArtifactError: With the name of the array, what it holds and what it may.
    """
    _check(name, constants, counts, 0)


def _check_field(name: str, value: Any, declared: Indices, around: tuple[Any, Any, Any]) -> None:
    try:
        count = None if declared.count is None else declared.count(*around)
        _check(name, value, count, declared.least)
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise ArtifactError(f"not a plan: {name} does not fit the rest of it: {error}") from error


def _check(name: str, value: Any, count: Any, least: int) -> None:
    if value is None:
        return
    if isinstance(count, Mapping):
        for key in sorted(value.keys() & count.keys()):
            _check(f"{name}/{key}", value[key], count[key], least)
    elif isinstance(count, tuple):
        for i, (own, bound) in enumerate(zip(value, count, strict=True)):
            _check(f"{name}/{i}", own, bound, least)
    else:
        _check_array(name, np.asarray(value), count, least)


def _check_array(name: str, array: np.ndarray, count: Any, least: int) -> None:
    if not array.size:
        return
    if array.dtype.kind not in "iu":
        raise ArtifactError(f'the array "{name}" is {array.dtype}, expected integers')
    ends = np.broadcast_to(np.inf if count is None else np.asarray(count), array.shape)
    is_wrong = (array < least) | (array >= ends)
    if is_wrong.any():
        found, end = int(array[is_wrong][0]), float(ends[is_wrong][0])
        range_ = f"at least {least}" if np.isinf(end) else f"{least} to {int(end) - 1}" if end > least else "none"
        raise ArtifactError(f'the array "{name}" holds {found}, expected {range_}')
