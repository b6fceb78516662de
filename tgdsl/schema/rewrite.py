"""A document with other values, its comments and order kept."""

from __future__ import annotations

from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap


def with_values(file: Path, values: Mapping[tuple[str, ...], tuple[Any, str]]) -> str:
    """Return a document's text with some values set.

    Args:
        file: The document.
        values: By path the value, and a comment that stands behind it.
    """
    yaml = YAML(typ="rt")
    yaml.preserve_quotes, yaml.width = True, 1000
    root = yaml.load(file.read_text(encoding="utf-8"))
    for path, (value, comment) in values.items():
        parent = root
        for part in path[:-1]:
            parent = parent.setdefault(part, CommentedMap())
        parent[path[-1]] = value
        if not parent.fa.flow_style():
            parent.yaml_add_eol_comment(comment, path[-1])
    out = StringIO()
    yaml.dump(root, out)
    return out.getvalue()
