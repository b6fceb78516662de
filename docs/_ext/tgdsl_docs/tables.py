"""Markdown tables, and types as JSON Schema gives them in words."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

UNIT = re.compile(r" ?\[([^\[\],`]+)\]")
"""A unit in a description, such as `[N/m]`."""
Link = Callable[[str], str]


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell(text) for text in line) + " |" for line in lines) + "\n"


def cell(text: str) -> str:
    """Return a text as the content of a cell: on one line, with its bars escaped."""
    return re.sub(r"(?<!\\)\|", r"\\|", " ".join(text.split()))


def split_unit(description: str) -> tuple[str, str]:
    """Return a description without its unit, and the unit; with none or several units nothing is split off."""
    units = UNIT.findall(description)
    if len(units) != 1:
        return description, ""
    return UNIT.sub("", description, count=1), "–" if units[0] == "1" else units[0]


def fields_table(schema: Mapping[str, Any], names: Iterable[str], link: Link) -> str:
    """Return the table of a model's fields.

    Args:
        schema: JSON Schema of the model.
        names: The fields.
        link: Returns the text that stands for a `$defs` entry.
    """
    required = set(schema.get("required", ()))
    rows = []
    for name in names:
        field = schema["properties"][name]
        meaning, unit = split_unit(field.get("description", ""))
        rows.append((f"`{name}`", type_text(field, link), default_text(name, field, required), unit, inline(meaning)))
    return table(("name", "type", "default", "unit", "meaning"), rows)


def default_text(name: str, field: Mapping[str, Any], required: set[str]) -> str:
    """Return a field's default: "required", nothing where it is null, or the value."""
    if name in required:
        return "required"
    value = field.get("default")
    if value is None:
        return ""
    text = f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)
    return f"`{text}`"


def type_text(field: Mapping[str, Any], link: Link) -> str:
    """Return a JSON Schema's type in words."""
    if "$ref" in field:
        return link(field["$ref"].rsplit("/", 1)[1])
    if "const" in field:
        return f"`{field['const']}`"
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    if "anyOf" in field or "oneOf" in field:
        parts = [part for part in field.get("anyOf", field.get("oneOf")) if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(type_text(part, link) for part in parts))
    if "allOf" in field:
        return " and ".join(type_text(part, link) for part in field["allOf"])
    kind = field.get("type", "anything")
    if kind == "array":
        return _list_text(field, link)
    if kind == "object":
        inner = field.get("additionalProperties") or next(iter(field.get("patternProperties", {}).values()), None)
        named = f" of {type_text(inner, link)} by name" if isinstance(inner, Mapping) else ""
        return f"mapping{named}"
    if kind == "string":
        return _text_text(field)
    return {"integer": "integer", "boolean": "true or false"}.get(str(kind), str(kind)) + _bounds(field)


def _list_text(field: Mapping[str, Any], link: Link) -> str:
    if "prefixItems" in field:
        parts = dict.fromkeys(type_text(part, link) for part in field["prefixItems"])
        return f"list of {len(field['prefixItems'])}: {', '.join(parts)}"
    least, most = field.get("minItems"), field.get("maxItems")
    count = f" of {least}" if least is not None and least == most else ""
    inner = type_text(field["items"], link) if field.get("items") else "anything"
    return f"list{count}: {inner}"


def _text_text(field: Mapping[str, Any]) -> str:
    units = re.search(r"\\s\*\((.*)\)\?\\s\*\$$", field.get("pattern", ""))
    if not units:
        return "text"
    names = (re.sub(r"\\(.)", r"\1", name) for name in re.split(r"(?<!\\)\|", units[1]))
    return "text in " + ", ".join(f"`{name}`" for name in names)


def _bounds(field: Mapping[str, Any]) -> str:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    bounds = [f"{sign} {field[name]:g}" for name, sign in signs.items() if name in field]
    return f" {', '.join(bounds)}" if bounds else ""


def inline(text: str) -> str:
    """Return a docstring's text as Markdown: angle brackets outside code are no HTML."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(parts))
