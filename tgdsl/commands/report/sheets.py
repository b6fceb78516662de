"""`tgdsl bench --oracles` and `--hard`: reports that need no document, but a clone, whose tests they run."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType


def report(oracles: bool, hard: bool, out: Path) -> None:
    """Compute reports, print their tables and write their files.

    Args:
        oracles: Whether to report the comparisons with closed forms.
        hard: Whether to report the numerical hard cases.
        out: Folder of the files.

    Raises:
        FileError: If a file cannot be written.
        TgdslError: If tgdsl is not imported from a clone; if a result is wrong, once all files are written.
    """
    from tqdm import tqdm

    from tgdsl.errors import TgdslError
    from tgdsl.report.files import check_report_files

    tests, failed = tests_of_clone(), 0
    sheets = importlib.import_module("oracles.sheet")
    names = [name for name, is_wanted in (("oracles", oracles), ("hard", hard)) if is_wanted]
    for name in names:
        check_report_files(out, name)
    for name in names:
        with tqdm(desc=name, total=1, disable=None, leave=False, bar_format="{n_fmt}/{total_fmt} |{bar:20}| {desc}") as bar:

            def begun(section: str, done: int, total: int, bar: tqdm = bar) -> None:
                bar.total, bar.n = total, done
                bar.set_description_str(section)

            sheet = tests.sheet(name, begun)
        print(sheets.sheet_text(sheet))
        print("\n".join(["", *map(str, sheets.write_sheet(sheet, out)), ""]))
        failed += len(sheet.failed)
    if failed:
        raise TgdslError(f"{failed} results are not as they should be; they are marked in {out}")


def tests_of_clone() -> ModuleType:
    """Import `oracles.report`, which is in `tests/` of a clone.

    Raises:
        TgdslError: If tgdsl is not imported from a clone.
    """
    from tgdsl.errors import TgdslError

    tests = Path(__file__).parents[3] / "tests"
    if not (tests / "oracles" / "report.py").is_file():
        raise TgdslError(
            "bench --oracles and --hard run tgdsl's tests, which an installed package does not contain: in a clone of the "
            "repository, run `pip install -e .` and then the command again"
        )
    if str(tests) not in sys.path:
        sys.path.insert(0, str(tests))
    return importlib.import_module("oracles.report")
