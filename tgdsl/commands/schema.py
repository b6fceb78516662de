"""`tgdsl schema`: the JSON Schema of what users write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tgdsl.commands.arguments import OUT


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of documents and layouts, with which editors complete and check them."""

    out: Annotated[Path, OUT] = Path("tgdsl.schema.json")
    """The file to write."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.write import atomic_write
        from tgdsl.schema.document import json_schema

        atomic_write(self.out, (json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n").encode())
        print(self.out)
