"""`tgdsl verify`: an exported file against the module."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import FILE, module_of
from tgdsl.console.progress import StatusLine


@dataclass(frozen=True)
class Verify:
    """Compare an exported file with the module on random states, in a process without tgdsl; exit code 1 if they differ."""

    file: Annotated[tyro.conf.Positional[Path], FILE]
    """The file that `tgdsl export` wrote."""
    of: Annotated[Path | None, FILE] = None
    """The document or artefact; default: where it was when the file was exported."""
    calls: int = 100
    """Calls of each batch, through which memory is carried."""

    def run(self) -> None:
        """Compare, and print the largest differences."""
        from tgdsl.errors import ArtifactError
        from tgdsl.module.export.program import read_signature
        from tgdsl.module.export.verify import TOLERANCE, verify

        signature = read_signature(self.file)
        if self.of is None and not signature.source:
            raise ArtifactError(f"{self.file}: does not say what it was exported from; name it with --of")
        with StatusLine() as progress:
            touch = module_of(self.of or Path(signature.source), () if self.of else signature.overrides, progress)
            progress("comparing")
            verdict = verify(self.file, touch, self.calls)
        for num_envs, differences in verdict.differences.items():
            print(f"{num_envs} environments, {self.calls} calls")
            for name, value in differences.items():
                print(f"  {name:<40}{value:.1e}")
        refused = "refused" if verdict.refuses_other_dtypes else "NOT refused"
        print(f"largest difference {verdict.worst:.1e} of full scale (at most {TOLERANCE:g})")
        print(f"inputs of a wrong dtype are {refused}")
        if not verdict.is_equal:
            sys.exit(1)
