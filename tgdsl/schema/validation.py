"""Plain values to models: pydantic's errors in the document's terms; the document's valid rest is still read."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from tgdsl.errors import Problem, did_you_mean
from tgdsl.schema import yaml
from tgdsl.schema.yaml import Path, Source

M = TypeVar("M", bound=BaseModel)
ENTRY_DEPTH = {"sensors": 2, "objects": 2, "noise": 2, "groups": 2, "observations": 3, "resolutions": 3}
"""Depth of an entry under each of these keys: a faulty entry is left out, and the rest is still checked."""

DISCRIMINATORS = ("kind", "method", "type")
"""Keys whose value selects a mapping's model: pydantic's error locations contain that value as if it were a key."""


def validate(source: Source, prefix: Path, model: type[M], problems: list[Problem], required: tuple[str, ...]) -> M | None:
    """Read a mapping as a model; note every mistake, and read it without the faulty entries."""
    value = source.get(prefix)
    model_of: dict[int, type[BaseModel]] = {}
    try:
        return model.model_validate(value, context=model_of)
    except ValidationError as invalid:
        errors = invalid.errors()
    entries: set[Path] = set()
    for error in errors:
        path = _raw_path(value, error, model_of)
        if not _is_follow_up(error):
            problems.append(_problem(source, prefix, value, path, error, model_of))
        entries.add(path if error["type"] == "extra_forbidden" else _entry(path))
    return _rest(value, model, entries, required) if isinstance(value, dict) else None


def _rest(value: dict, model: type[M], entries: set[Path], required: tuple[str, ...]) -> M | None:
    """Read the mapping without some entries, and without entries that become faulty without them."""
    rest = copy.deepcopy(value)
    for entry in sorted(entries, key=lambda path: [f"{part:>9}" for part in path], reverse=True):
        _remove(rest, entry)
    if any(key not in rest for key in required):
        return None
    model_of: dict[int, type[BaseModel]] = {}
    try:
        return model.model_validate(rest, context=model_of)
    except ValidationError as invalid:
        more = {_entry(_raw_path(rest, error, model_of)) for error in invalid.errors()}
        return _rest(rest, model, more, required) if more and () not in more and rest != value else None


def _is_follow_up(error: ErrorDetails) -> bool:
    result, context = error["input"], error.get("ctx", {})
    return result is yaml.Unreadable or (error["type"] == "too_short" and len(result) >= context["min_length"])


def _raw_path(value: Any, error: ErrorDetails, known: Mapping[int, type[BaseModel]]) -> Path:
    """Return the path of pydantic's error in the plain value: without the tags of unions, which are no keys."""
    path: list[str | int] = []
    location: tuple[Any, ...] = error["loc"]
    is_tagged = False
    for i, part in enumerate(location):
        if i == len(location) - 1 and error["type"] in ("missing", "extra_forbidden"):
            return (*path, part)
        if isinstance(value, dict):
            model = known.get(id(value))
            if model is not None and not is_tagged and part in [value.get(key) for key in DISCRIMINATORS]:
                is_tagged = True
                continue
            is_key = part in value and (model is None or part in model.model_fields)
        else:
            is_key = isinstance(value, list) and isinstance(part, int) and part < len(value)
        if is_key:
            path.append(part)
            value, is_tagged = value[part], False
    return tuple(path)


def _entry(path: Path) -> Path:
    """Return the path of the entry that contains a path: without the entry the rest can be checked."""
    for i, part in enumerate(path):
        if part in ENTRY_DEPTH:
            return path[: i + ENTRY_DEPTH[str(part)]]
    return path[:1]


def _remove(value: Any, path: Path) -> None:
    """Remove an entry, and its list with it if that becomes empty."""
    try:
        for part in path[:-1]:
            parent, key, value = value, part, value[part]
        del value[path[-1]]
    except (KeyError, IndexError, TypeError):
        return
    if value == [] and len(path) > 1:
        del parent[key]


def _problem(
    source: Source, prefix: Path, value: Any, path: Path, error: ErrorDetails, known: Mapping[int, type[BaseModel]]
) -> Problem:
    """Return one of pydantic's errors in the document's terms."""
    kind, context, value_found = error["type"], error.get("ctx", {}), error["input"]
    full = (*prefix, *path)
    if kind == "extra_forbidden":
        parent = value
        for part in path[:-1]:
            parent = parent[part]
        fields = known[id(parent)].model_fields if id(parent) in known else {}
        return source.problem(full, f'unknown key "{path[-1]}"', did_you_mean(str(path[-1]), fields, "keys"), on_key=True)
    if error["loc"][-1:] == ("[key]",):
        problem = f'"{path[-1]}" is not a name, expected letters, digits, "_" and "-", first a letter or "_"'
        return source.problem(full, problem, on_key=True)
    if kind == "missing" and isinstance(path[-1], int):
        return source.problem(full[:-1], f"found {_brief(value_found)}, value {path[-1] + 1} is missing")
    if kind == "missing":
        return source.problem(full[:-1], f'missing key "{path[-1]}"', on_key=True)
    if kind == "union_tag_not_found":
        key = context["discriminator"].strip("'")
        near = get_close_matches(key, map(str, value_found) if isinstance(value_found, dict) else (), 1)
        return source.problem(full, f'missing key "{key}"', f'is "{near[0]}" meant to be it?' if near else "", on_key=True)
    if kind == "union_tag_invalid":
        key = context["discriminator"].strip("'")
        tags = [tag.strip(" '") for tag in context["expected_tags"].split(",")]
        hint = did_you_mean(context["tag"], tags, f"{key}s")
        if key == "kind" and hint.startswith("known"):
            hint += "; kinds of other packages are known once these are installed"
        return source.problem((*full, key), f'unknown {key} "{context["tag"]}"', hint)
    if kind == "value_error":
        return source.problem(full, str(context["error"]))
    if kind == "region":
        return source.problem(full, error["msg"])
    expected = {
        **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "a mapping"),
        "tuple_type": "a list",
        "string_type": "a string",
        "literal_error": context.get("expected"),
        "too_short": f"at least {context.get('min_length')} entry",
        "too_long": f"{context.get('max_length')} entries",
    }
    if kind in expected:
        return source.problem(full, f"found {_brief(value_found)}, expected {expected[kind]}")
    return source.problem(full, f"found {_brief(value_found)}: {error['msg'][0].lower()}{error['msg'][1:]}")


def _brief(found: Any) -> str:
    if isinstance(found, (dict, list, tuple)):
        return f"a {'mapping' if isinstance(found, dict) else 'list'} of {len(found)}"
    if isinstance(found, int) and abs(found) >= 10**20:
        return "a huge number"  # Python refuses to print more than 4300 digits
    return f'"{found}"' if isinstance(found, str) else "nothing" if found is None else str(found)
