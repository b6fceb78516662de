"""A report as files: its rows as CSV, all of it as JSON, and one HTML file."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tgdsl.files.write import atomic_write_all, check_writable

SUFFIXES = (".csv", ".json", ".html")


def check_report_files(folder: Path, stem: str) -> None:
    """Check that a report's files can be written, before the work that leads to them.

    Raises:
        FileError: If one cannot.
    """
    for suffix in SUFFIXES:
        check_writable(folder / f"{stem}{suffix}")


def write_report_files(
    folder: Path, stem: str, rows: Sequence[Mapping[str, Any]], document: Mapping[str, Any], page: str
) -> list[Path]:
    """Write the files of a report, all or none, and return them.

    Args:
        folder: Their folder.
        stem: Stem of their names.
        rows: Rows of the CSV file; lists are left out.
        document: Content of the JSON file.
        page: Content of the HTML file.

    Raises:
        FileError: If one cannot be written.
    """
    flat = [{key: value for key, value in row.items() if not isinstance(value, list | tuple)} for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in flat for key in row)), restval="")
    writer.writeheader()
    writer.writerows(flat)
    contents = (text.getvalue(), json.dumps(document, indent=1, ensure_ascii=False), page)
    files = [folder / f"{stem}{suffix}" for suffix in SUFFIXES]
    atomic_write_all({file: content.encode() for file, content in zip(files, contents, strict=True)})
    return files
