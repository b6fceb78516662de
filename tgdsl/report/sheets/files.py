"""A sheet as files: CSV, JSON, and one HTML file."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

from tgdsl.files.write import atomic_write_all, check_writable
from tgdsl.report.sheets.page import sheet_page
from tgdsl.report.sheets.sheet import Sheet

SUFFIXES = (".csv", ".json", ".html")


def check_sheet_files(stem: str, folder: Path) -> None:
    """See that a sheet's files can be written, before the work that leads to them.

    Raises:
        FileError: If one cannot.
    """
    for suffix in SUFFIXES:
        check_writable(folder / f"{stem}{suffix}")


def write_sheet(sheet: Sheet, folder: Path) -> list[Path]:
    """Write the files of a sheet, all or none, and return them.

    Raises:
        FileError: If one cannot be written.
    """
    told = [
        {"section": section.name, "title": entry.title, "holds": entry.holds, "defects": list(entry.defects), **entry.record}
        for section in sheet.sections
        for entry in section.entries
    ]
    rows = [{key: value for key, value in row.items() if not isinstance(value, list | tuple)} for row in told]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), restval="")
    writer.writeheader()
    writer.writerows(rows)
    left_out = [{"section": s.name, "title": name, "why": why} for s in sheet.sections for name, why in s.left_out]
    whole = json.dumps({"title": sheet.title, "entries": told, "left_out": left_out}, indent=1, ensure_ascii=False)
    contents = (text.getvalue(), whole, sheet_page(sheet))
    files = [folder / f"{sheet.stem}{suffix}" for suffix in SUFFIXES]
    atomic_write_all({file: content.encode() for file, content in zip(files, contents, strict=True)})
    return files
