"""Logging of a training run: a progress bar or lines, and TensorBoard."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tgdsl.files.write import as_file_error

SAID_EVERY = 10.0
"""Time between lines where there is no terminal for a progress bar [s]."""


class ProgressBar:
    """A progress bar of a run; where there is no terminal, a line now and then."""

    def __init__(self, iterations: int | None, done: int, unit: str):
        self._unit, self._total, self._said = unit, iterations, -SAID_EVERY
        form = "{desc} {n_fmt}/{total_fmt} |{bar}| {postfix}" if iterations else "{desc} {n_fmt} {postfix}"
        self._bar = tqdm(total=iterations, initial=done, desc="learning", disable=None, leave=False, bar_format=form)
        self._seen: dict[str, float] = {}

    def show(self, row: Mapping[str, float | int], left: float) -> None:
        """Show an iteration."""
        self._seen |= {name: row[name] for name in ("Episode/return", "Episode/score") if name in row}
        parts = [f"{timedelta(seconds=round(left))} left"]
        if self._seen:
            score = f"{self._seen['Episode/score']:.2f} {self._unit}"
            parts = [f"return {self._seen['Episode/return']:.2f}", f"score {score}", *parts]
        parts.insert(-1, f"{row['steps_per_second']:,.0f} steps/s")
        text = ", ".join(parts)
        if not self._bar.disable:
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update()
        elif row["seconds"] - self._said >= SAID_EVERY:
            self._said = row["seconds"]
            print(f"{row['iteration']:.0f}{f'/{self._total}' if self._total else ''}: {text}", flush=True)

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()
        sys.stdout.flush()


class Board:
    """TensorBoard's file of a run, if TensorBoard is installed."""

    def __init__(self, folder: Path, done: int):
        self._writer: Any = None
        self._file = folder / "events.out.tfevents"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of its own packages
                from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._writer = SummaryWriter(str(folder), flush_secs=10, purge_step=done + 1 if done else None)

    @property
    def is_there(self) -> bool:
        """Whether TensorBoard is installed."""
        return self._writer is not None

    def add(self, told: Mapping[str, float], iteration: int) -> None:
        """Add what an iteration was.

        Raises:
            FileError: If what was added before could not be written.
        """
        if self._writer is not None:
            with as_file_error(self._file):
                for name, value in told.items():
                    self._writer.add_scalar(name, value, iteration)

    def close(self) -> None:
        """Write what has not been written.

        Raises:
            FileError: If it cannot be written.
        """
        if self._writer is not None:
            with as_file_error(self._file):
                self._writer.close()
