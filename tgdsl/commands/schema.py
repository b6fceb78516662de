"""`tgdsl schema`: the JSON Schema of what users write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tgdsl.commands.arguments import OUT


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of documents and layouts, or of tasks, with which editors complete and check them."""

    tasks: bool = False
    """Of tasks."""
    out: Annotated[Path | None, OUT] = None
    """The file to write; default: tgdsl.schema.json, or tgdsl.task.schema.json."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.write import atomic_write
        from tgdsl.rl.load import task_schema
        from tgdsl.schema.document import json_schema

        out = self.out or Path("tgdsl.task.schema.json" if self.tasks else "tgdsl.schema.json")
        schema = task_schema() if self.tasks else json_schema()
        atomic_write(out, (json.dumps(schema, indent=2, ensure_ascii=False) + "\n").encode())
        print(out)
