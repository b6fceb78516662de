"""JSON Schema with `if`, `then` and `else` in the place of `anyOf`, so that an editor shows a mistake where it is.

Of `anyOf` all that a validator can say is that no branch fits, at the whole value: a misspelt key somewhere in a sensor then
underlines the sensor. Of `if` and `then` it says what is wrong in the one branch that is meant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Schema = dict[str, Any]


def conditional(schema: Any, definitions: Mapping[str, Schema]) -> Any:
    """Return a schema that accepts the same values, its alternatives told apart by JSON type, by a key's value or by a key.

    Args:
        schema: The schema, or a part of one.
        definitions: What its references lead to.
    """
    if isinstance(schema, list):
        return [conditional(part, definitions) for part in schema]
    if not isinstance(schema, dict):
        return schema
    branches = _branches(schema)
    result = {
        key: conditional(value, definitions) for key, value in schema.items() if not branches or key not in ("anyOf", "oneOf")
    }
    if not branches:
        return result
    by_type: dict[str, list[Schema]] = {"object": [], "array": [], "": []}
    for branch in branches:
        kind = str(_target(branch, definitions).get("type"))
        by_type[kind if kind in by_type else ""].append(branch)
    if len(by_type["array"]) > 1 or not (by_type["object"] or by_type["array"]):
        return result | {"anyOf": [conditional(branch, definitions) for branch in branches]}
    objects = _of_objects(by_type["object"], definitions, _discriminator(schema))
    chain: Schema = {"anyOf": [conditional(leaf, definitions) for leaf in by_type[""]]} if by_type[""] else {}
    if by_type["array"]:
        chain = _if({"type": "array"}, conditional(by_type["array"][0], definitions), chain or {"type": "object"})
    return result | (_if({"type": "object"}, objects, chain) if chain and by_type["object"] else objects or chain)


def _branches(schema: Schema) -> list[Schema]:
    own = schema.get("anyOf") or schema.get("oneOf") or []
    inner = [(_branches(part) if not part.keys() - {"anyOf", "oneOf", "discriminator"} else []) or [part] for part in own]
    return [part for parts in inner for part in parts]


def _discriminator(schema: Schema) -> Mapping[str, Any]:
    own = schema.get("anyOf") or schema.get("oneOf") or []
    inner = (_discriminator(part) for part in own if isinstance(part, dict))
    return schema.get("discriminator") or next((result for result in inner if result), {})


def _target(schema: Schema, definitions: Mapping[str, Schema]) -> Schema:
    return definitions[schema["$ref"].removeprefix("#/$defs/")] if "$ref" in schema else schema


def _of_objects(branches: Sequence[Schema], definitions: Mapping[str, Schema], discriminator: Mapping[str, Any]) -> Schema:
    """Return one schema of several of mappings, told apart by the value of a key, or by a key that only one of them needs."""
    if len(branches) < 2:
        return conditional(branches[0], definitions) if branches else {}
    chain: Schema = {}
    if key := discriminator.get("propertyName"):
        mapping: Mapping[str, str] = discriminator["mapping"]
        for value, reference in reversed(list(mapping.items())):
            chain = _if({"properties": {key: {"const": value}}, "required": [key]}, {"$ref": reference}, chain)
        return {"type": "object", "properties": {key: {"enum": list(mapping)}}, "required": [key]} | chain
    needed = [set(_target(branch, definitions).get("required", ())) for branch in branches]
    for i, branch in reversed(list(enumerate(branches))):
        only = sorted(needed[i].difference(*needed[:i], *needed[i + 1 :]))
        if not only:
            return {"anyOf": [conditional(part, definitions) for part in branches]}
        named = {"anyOf": [{"required": [key]} for key in only]} if len(only) > 1 else {"required": only}
        chain = _if(named, conditional(branch, definitions), chain or {"anyOf": list(branches)})
    return {"type": "object"} | chain


def _if(condition: Schema, then: Schema, other: Schema) -> Schema:
    return {"if": condition, "then": then, "else": other}
