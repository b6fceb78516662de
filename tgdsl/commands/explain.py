"""`tgdsl explain`: what a document computes, and at what cost."""

from __future__ import annotations

from dataclasses import dataclass

from tgdsl.commands.arguments import DocumentOrArtefact, Overrides, module_of
from tgdsl.console.progress import StatusLine


@dataclass(frozen=True)
class Explain:
    """Say what a document or an artefact computes, what it leaves out and why, and what it costs."""

    document: DocumentOrArtefact
    set: Overrides = ()

    def run(self) -> None:
        """Print the account."""
        with StatusLine() as progress:
            text = module_of(self.document, self.set, progress).explain()
        print(text)
