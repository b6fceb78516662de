"""Pages generated at build time from what they describe: kinds, grammar, commands, API, observations, the READMEs as pages.

They are written to `generated/` of the source folder, before Sphinx looks for pages.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from tgdsl_docs.accuracy import Accuracy
from tgdsl_docs.api import api_pages, escape_docstring, hide_colons, is_external
from tgdsl_docs.commands import command_pages
from tgdsl_docs.grammar import grammar_pages
from tgdsl_docs.kinds import kind_pages
from tgdsl_docs.links import outside_pages, resolve_links
from tgdsl_docs.observations import observation_pages

FOLDER = "generated"
"""Folder of the generated pages, within the source folder."""


def generate(app: Sphinx) -> None:
    """Write all generated pages."""
    source = Path(app.srcdir)
    accuracy = Accuracy()
    pages: dict[str, str] = {"accuracy.md": accuracy.page()}
    groups = (
        kind_pages(source, accuracy),
        grammar_pages(),
        command_pages(),
        api_pages(),
        observation_pages(source),
        outside_pages(),
    )
    for group in groups:
        pages |= group
    shutil.rmtree(source / FOLDER, ignore_errors=True)
    for name, text in pages.items():
        path = source / FOLDER / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def read(app: Sphinx, docname: str, content: list[str]) -> None:
    """Turn links that leave the documentation into downloads."""
    if not str(app.env.doc2path(docname)).endswith(".rst"):
        content[0] = resolve_links(content[0], Path(app.srcdir) / f"{docname}.md", Path(app.srcdir))


def missing(app: Sphinx, env: Any, node: Any, content: Any) -> Any:
    """Show names of other packages, and types that have no page, as text; there is no network to look them up."""
    return content if is_external(node.get("reftype", ""), node.get("reftarget", "")) else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the hooks."""
    app.connect("builder-inited", generate)
    app.connect("source-read", read)
    app.connect("missing-reference", missing)
    app.connect("autodoc-process-docstring", hide_colons, priority=100)  # before Napoleon, whose priority is 500
    app.connect("autodoc-process-docstring", escape_docstring)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
