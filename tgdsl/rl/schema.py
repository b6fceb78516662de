"""The JSON Schema of tasks' documents, with which editors complete and check them."""

from __future__ import annotations

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
        definitions |= schema.pop("$defs", {})
        schema.pop("title", None)
        definitions[model.__name__] = schema
    own = definitions["TaskSpec"]
    own["additionalProperties"] = True
    own["properties"]["randomise"] = {"type": "object", "description": own["properties"]["randomise"]["description"]}
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
