"""`tgdsl compile`: a document to an artefact."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OUT, Document, Overrides, in_working_folder, parsed_overrides
from tgdsl.console.progress import StatusLine


@dataclass(frozen=True)
class Compile:
    """Compile a document to an artefact that `tgdsl.load` and `tgdsl run` take."""

    document: Document
    """The YAML document."""
    out: Annotated[Path | None, OUT] = None
    """The artefact; default: the document's name with the ending .safetensors, in the working folder."""
    set: Annotated[Overrides, tyro.conf.arg(help="Override a value, as in `--set resolution=high`; may be repeated.")] = ()

    def run(self) -> None:
        """Compile, write and say what came of it."""
        from tgdsl.files.write import check_writable, with_folder
        from tgdsl.module.artifact import save_plan
        from tgdsl.tuning.compile import compile_plan

        start = time.perf_counter()
        out = check_writable(self.out or in_working_folder(self.document, ".safetensors"))
        with StatusLine() as progress:
            plan = compile_plan(self.document, parsed_overrides(self.set), progress=progress)
        size = save_plan(plan, with_folder(out))
        layout = plan.layout
        sensors = ", ".join(f"{s.name} ({s.kind}, {s.rows[1] - s.rows[0]})" for s in plan.sensors)
        print(f"{layout.num_taxels} taxels on {len(layout.links)} links{plan.origin.at_resolution}")
        print(f"sensors: {sensors}")
        print(f"{out}: {size} bytes in {time.perf_counter() - start:.1f} s")
