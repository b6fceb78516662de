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
        task_spec = schema.pop("$defs", {})
        others = {name: f"{model.__name__}.{name}" for name, made in task_spec.items() if definitions.get(name, made) != made}
        schema, task_spec = (
            _renamed(schema, others),
            _renamed({others.get(name, name): made for name, made in task_spec.items()}, others),
        )
        definitions |= task_spec
        schema.pop("title", None)
        definitions[model.__name__] = schema
    task_spec = definitions["TaskSpec"]
    task_spec["additionalProperties"] = True
    task_spec["properties"]["randomise"] = {
        "type": "object",
        "description": task_spec["properties"]["randomise"]["description"],
    }
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
    if isinstance(schema, dict):
        return {name: _reference(part, others) if name == "$ref" else _renamed(part, others) for name, part in schema.items()}
    return [_renamed(part, others) for part in schema] if isinstance(schema, list) else schema


def _reference(place: str, others: Mapping[str, str]) -> str:
    folder, _, name = place.rpartition("/")
    return f"{folder}/{others.get(name, name)}"
