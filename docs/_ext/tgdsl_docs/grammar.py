"""The grammar of documents, layouts and tasks, from their pydantic models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pkgutil import resolve_name
from typing import Any

from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.tasks import TASKS
from tgdsl.schema.document import document_model
from tgdsl.schema.placement import LayoutSpec
from tgdsl.sensors import KINDS
from tgdsl_docs.tables import fields_table, inline

Schema = Mapping[str, Any]
INDEX = """# Grammar

Every key of documents, layouts and tasks, with type, default and unit, from the models that read them. The same stands in the
JSON Schemas `tgdsl.schema.json` and `tgdsl.task.schema.json`, with which editors complete and check documents (`tgdsl schema`
writes them). Numbers are SI; a number may be given with a unit, as in `4 mm`. Keys that are not listed are refused.

```{toctree}
document
layout
task
```
"""


def grammar_pages() -> dict[str, str]:
    """Return the pages by name."""
    kinds = {kind.spec.__name__: kind.name for kind in KINDS}
    document = document_model(KINDS).model_json_schema()
    layout = LayoutSpec.model_json_schema()
    pages = {
        "document": _page(
            "Documents", "A document names the robot, the scene, the objects and the sensors.", [("Document", document)], kinds
        ),
        "layout": _page(
            "Layouts", "Where taxels sit. A file, or the document's `robot.layout` in line.", [("Layout", layout)], {}
        ),
        "task": _page(
            "Tasks", "A task's document says what a policy learns: see [tasks](../../how-to/tasks.md).", _tasks(), {}
        ),
    }
    return {"grammar/index.md": INDEX} | {f"grammar/{name}.md": text for name, text in pages.items()}


def _tasks() -> list[tuple[str, Schema]]:
    named: list[tuple[str, Schema]] = [("Every task", TaskSpec.model_json_schema())]
    for name, place in TASKS.items():
        named.append((f"`{name}`", resolve_name(place).Spec.model_json_schema()))
    return named


def _page(title: str, about: str, roots: Iterable[tuple[str, Schema]], kinds: Mapping[str, str]) -> str:
    """Return a page with a table per model; sensors of a kind are linked to its page."""
    roots = list(roots)
    parts: dict[str, Schema] = {}
    for _, root in roots:
        parts |= root.get("$defs", {})
    parts = {name: part for name, part in sorted(parts.items()) if name not in kinds}

    def link(name: str) -> str:
        if name in kinds:
            return f"[`{kinds[name]}`](../kinds/{kinds[name]}.md)"
        return f"[{name}](#{_anchor(title, name)})"

    text = [f"# {title}\n\n{about}\n"]
    common = set(roots[0][1]["properties"]) if len(roots) > 1 else set()
    for heading, root in roots:
        names = [name for name in root["properties"] if root is roots[0][1] or name not in common or name == "task"]
        text.append(f"\n## {heading}\n\n{inline(root.get('description', ''))}\n\n{fields_table(root, names, link)}")
    for name, part in parts.items():
        text.append(f"\n({_anchor(title, name)})=\n\n### {name}\n\n{inline(part.get('description', ''))}\n\n")
        if "properties" in part:
            text.append(fields_table(part, part["properties"], link))
        elif "enum" in part:
            text.append("One of " + ", ".join(f"`{value}`" for value in part["enum"]) + ".\n")
    return "".join(text)


def _anchor(page: str, name: str) -> str:
    return f"{page}-{name}".lower()
