"""The index: every page is in a section, those that no section names in the last one."""

from __future__ import annotations

import re
from pathlib import Path

OTHERS = "@others"
"""Line of the index that stands for the pages that no section names."""


def add_others(index: str, source: Path) -> str:
    """Return the index with the pages that no section names in the place of `@others`.

    Raises:
        ValueError: If the index has no such line.
    """
    if OTHERS not in index.splitlines():
        raise ValueError(f"docs/index.md: found no line {OTHERS}, expected one in the toctree of further pages")
    blocks = re.findall(r"```\{toctree\}(.*?)```", index, re.DOTALL)
    listed = {re.sub(r".*<(.*)>$", r"\1", line.strip()) for block in blocks for line in block.splitlines()}
    pages = sorted(page.stem for page in source.glob("*.md"))
    return index.replace(OTHERS, "\n".join(page for page in pages if page not in listed | {"index"}))
