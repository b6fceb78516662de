"""A bench as files: CSV, JSON, and one HTML file."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict
from pathlib import Path

from tgdsl.files.write import atomic_write_all, check_writable
from tgdsl.report.bench.page import page
from tgdsl.report.bench.results import Report, rows_of

NAMES = ("bench.csv", "bench.json", "bench.html")


def check_files(folder: Path) -> None:
    """See that the files can be written, before the work that leads to them.

    Raises:
        FileError: If one cannot.
    """
    for name in NAMES:
        check_writable(folder / name)


def write_files(report: Report, folder: Path) -> list[Path]:
    """Write the files of a bench, all or none, and return them.

    Raises:
        FileError: If one cannot be written.
    """
    rows = list(rows_of(report))
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), restval="")
    writer.writeheader()
    writer.writerows(rows)
    told = {"document": report.document, "machine": report.machine, "states": report.states, "rows": rows}
    told["subjects"] = [{key: value for key, value in asdict(own).items() if key != "points"} for own in report.subjects]
    contents = (text.getvalue(), json.dumps(told, indent=1, ensure_ascii=False), page(report))
    files = [folder / name for name in NAMES]
    atomic_write_all({file: content.encode() for file, content in zip(files, contents, strict=True)})
    return files
