"""`tgdsl bench --oracles` and `--hard`: reports that need no document."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tgdsl.report.sheets.sheet import Sheet


def report(oracles: bool, hard: bool, out: Path) -> None:
    """Compute the reports that are asked for, print their tables, write their files.

    Args:
        oracles: Whether the comparisons with closed forms are asked for.
        hard: Whether the numerical hard cases are.
        out: Folder of the files.

    Raises:
        FileError: If a file cannot be written.
        TgdslError: If something is not as it should be, once all is written.
    """
    from tgdsl.errors import TgdslError
    from tgdsl.report.sheets.files import check_sheet_files, write_sheet
    from tgdsl.report.sheets.page import sheet_text

    names = [name for name, is_asked in (("oracles", oracles), ("hard", hard)) if is_asked]
    for name in names:
        check_sheet_files(name, out)
    failed = 0
    for name in names:
        sheet = _computed(name)
        print(sheet_text(sheet))
        print("\n".join(["", *map(str, write_sheet(sheet, out)), ""]))
        failed += len(sheet.failed)
    if failed:
        raise TgdslError(f"{failed} results are not as they should be; they are marked in {out}")


def from_clone(module: str) -> ModuleType:
    """Import a module of the package `oracles`, which a clone has in `tests/`.

    Raises:
        TgdslError: If tgdsl is not imported from a clone.
    """
    from tgdsl.errors import TgdslError

    tests = Path(__file__).parents[3] / "tests"
    if not (tests / "oracles" / "every.py").is_file():
        raise TgdslError(
            "bench --oracles and --hard run tgdsl's tests, which an installed package does not contain: "
            "in a clone of the repository, `pip install -e .` and run the command again"
        )
    if str(tests) not in sys.path:
        sys.path.insert(0, str(tests))
    return importlib.import_module(f"oracles.{module}")


def _computed(name: str) -> Sheet:
    """Compute a report under a progress bar."""
    from tqdm import tqdm

    runner = from_clone("every" if name == "oracles" else "hard.every")
    with tqdm(desc=name, total=1, disable=None, leave=False, bar_format="{n_fmt}/{total_fmt} |{bar:20}| {desc}") as bar:

        def begun(what: str, done: int, of: int) -> None:
            bar.total, bar.n = of, done
            bar.set_description_str(what)

        return runner.sheet_of(runner.run(begun=begun))
