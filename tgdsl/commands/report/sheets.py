"""`tgdsl bench --oracles` and `--hard`: reports that need no document."""

from __future__ import annotations

from pathlib import Path
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


def _computed(name: str) -> Sheet:
    """Compute a report under a progress bar."""
    from tqdm import tqdm

    from tgdsl.report.hard import every as hard
    from tgdsl.report.oracles import every as oracles

    with tqdm(desc=name, total=1, disable=None, leave=False, bar_format="{n_fmt}/{total_fmt} |{bar:20}| {desc}") as bar:

        def begun(what: str, done: int, of: int) -> None:
            bar.total, bar.n = of, done
            bar.set_description_str(what)

        if name == "oracles":
            return oracles.sheet_of(oracles.run(begun=begun))
        return hard.sheet_of(hard.run(begun=begun))
