"""Links of pages that are also read on a code host: links to other files become downloads, links to folders their names."""

from __future__ import annotations

import os
import re
from pathlib import Path

import tgdsl

ROOT = Path(tgdsl.__file__).resolve().parents[1]
"""The repository."""
PAGES = {"README.md": "overview", "examples/README.md": "gallery"}
"""Files outside the documentation that become pages of the folder `generated`."""
LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
"""A link that is no picture."""


def resolve_links(text: str, page: Path, source: Path) -> str:
    """Return a page with its links to files outside the documentation as downloads, and to folders as text.

    Args:
        text: The page's Markdown.
        page: Its file, from which links start.
        source: Sphinx's source folder.
    """

    def resolved(match: re.Match[str]) -> str:
        label, target = match[1], match[2]
        if re.match(r"[a-z]+:|#|<", target):
            return match[0]
        path, _, anchor = target.partition("#")
        place = Path(os.path.normpath(page.parent / path))
        if name := PAGES.get(os.path.relpath(place, source.parent)):
            home = os.path.relpath(source / "generated" / f"{name}.md", page.parent)
            return f"[{label}]({home}{'#' + anchor if anchor else ''})"
        if place.is_dir():
            return label if label.startswith("`") else f"{label} (`{os.path.relpath(place, source.parent)}`)"
        if place.is_relative_to(source) and (place.suffix == ".md" or place.is_relative_to(source / "generated")):
            return match[0]
        return f"{{download}}`{label.replace('`', '')} <{path}>`"

    parts = re.split(r"(^```.*?^```)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if i % 2 else LINK.sub(resolved, part) for i, part in enumerate(parts))


def outside_pages() -> dict[str, str]:
    """Return the files of `PAGES` as pages of the folder `generated`, by their names."""
    return {f"{name}.md": _moved(file) for file, name in PAGES.items()}


def _moved(file: str) -> str:
    """Return the text of a file of the repository, with links that start from docs/generated."""

    def target(match: re.Match[str]) -> str:
        return f"]({os.path.relpath(Path(file).parent / match[1], 'docs/generated')}"

    return re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)", target, (ROOT / file).read_text(encoding="utf-8"))
