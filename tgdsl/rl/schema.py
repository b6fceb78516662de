"""The JSON Schema of tasks' documents, with which editors complete and check them."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.tasks import TASKS
from tgdsl.schema.conditional import conditional


def task_schema() -> dict[str, Any]:
    """Return the schema of all tasks of tgdsl by name; of one's own task it knows what all tasks have in common."""
    specs: dict[str, type[TaskSpec]] = {
        name: getattr(import_module(place), class_).Spec for name, (place, class_) in TASKS.items()
    }
    definitions: dict[str, Any] = {}
    for model in (TaskSpec, *dict.fromkeys(specs.values())):
        schema = model.model_json_schema(ref_template="#/$defs/{model}")
        parts = schema.pop("$defs", {})
        others = {name: f"{model.__name__}.{name}" for name, part in parts.items() if definitions.get(name, part) != part}
        definitions |= _renamed({others.get(name, name): part for name, part in parts.items()}, others)
        schema.pop("title", None)
        definitions[model.__name__] = _renamed(schema, others)
    task_spec = definitions["TaskSpec"]
    task_spec["additionalProperties"] = True
    description = task_spec["properties"]["randomise"]["description"]
    task_spec["properties"]["randomise"] = {"type": "object", "description": description}
    definitions = {name: conditional(definition, definitions) for name, definition in definitions.items()}
    chain: dict[str, Any] = {"$ref": "#/$defs/TaskSpec"}
    for name, model in reversed(specs.items()):
        is_named = {"properties": {"task": {"const": name}}, "required": ["task"]}
        chain = {"if": is_named, "then": {"$ref": f"#/$defs/{model.__name__}"}, "else": chain}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "tgdsl task",
        "type": "object",
        "properties": {"task": {"anyOf": [{"enum": list(TASKS)}, {"type": "string", "pattern": ":"}]}},
        **chain,
        "$defs": dict(sorted(definitions.items())),
    }


def _renamed(schema: Any, others: Mapping[str, str]) -> Any:
    """Return a schema whose references name definitions as `others` renames them."""
    if isinstance(schema, list):
        return [_renamed(part, others) for part in schema]
    if not isinstance(schema, dict):
        return schema
    result = {name: _renamed(part, others) for name, part in schema.items()}
    if isinstance(result.get("$ref"), str):
        folder, _, name = result["$ref"].rpartition("/")
        result["$ref"] = f"{folder}/{others.get(name, name)}"
    return result
