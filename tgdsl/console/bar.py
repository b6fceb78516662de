"""A progress bar, also where there is no terminal."""

from __future__ import annotations

from typing import Any

from tqdm import tqdm

from tgdsl.console.progress import StatusLine


class Bar(tqdm):
    """A bar of tqdm that is wiped at the end; without a terminal, where tqdm prints nothing, a line every few seconds."""

    def __init__(self, job: str, total: int | None, unit: str, **look: Any):
        """Show the name of a job; `total` counts units, `look` has further options of tqdm."""
        super().__init__(total=total, desc=job, unit=unit, disable=None, leave=False, **look)
        self._job, self._unit, self._lines = job, unit, StatusLine()

    def set_description(self, desc: str | None = None, refresh: bool | None = True) -> None:
        """Change the name of the job."""
        self._job = desc
        super().set_description(desc, refresh)

    def set_description_str(self, desc: str | None = None, refresh: bool | None = True) -> None:
        """Change the name of the job, and show it now."""
        if self.disable:
            self._lines(desc or "")
        else:
            super().set_description_str(desc, refresh)

    def update(self, n: float | None = 1) -> bool | None:
        """Count units."""
        if not self.disable:
            return super().update(n)
        self.n += n or 0
        self._lines(f"{self._job}: {self.n}{f' of {self.total}' if self.total else ''} {self._unit}s")
        return None

    def close(self) -> None:
        """End the bar, or the lines."""
        if self.disable:
            self._lines.wipe()
        super().close()
