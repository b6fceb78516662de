"""Errors that a user can act on: the actual value, its place, and the expected one."""

from __future__ import annotations

import difflib
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


class TgdslError(Exception):
    """Base of every error that tgdsl raises on purpose."""


class RobotError(TgdslError):
    """A robot or scene file that cannot be read, or that holds something tgdsl does not support."""


class StateError(TgdslError):
    """A `SceneState` that lacks a field of the module's inputs, or has one of another shape, dtype or device."""


class ArtifactError(TgdslError):
    """A compiled artefact that is damaged, of another version, or whose assets have changed."""


class TaxelError(TgdslError):
    """Taxels that differ from the expected ones, or are in another order, so that rows of readings would be mixed up."""


class SimulationError(TgdslError):
    """A simulator that cannot run with the given arguments, or that diverged."""


class ObservationError(TgdslError):
    """An observation that a source cannot provide."""


class UnfeltWarning(UserWarning):
    """A document has taxels that can never sense the objects of their sensors."""


class CoarseCellsWarning(UserWarning):
    """Cells of a temperature grid are too large for the heat loss at their faces."""


class FileError(TgdslError, OSError):
    """A file that cannot be written; also an `OSError`.

    Attributes:
        file: The file.
        reason: Message of the operating system.
    """

    def __init__(self, file: object, reason: str):
        super().__init__(f"{file}: {reason}")
        self.file, self.reason = file, reason


class HandError(TgdslError):
    """Base of all errors of a real or emulated hand; `tgdsl.runtime.xhand1.wire.errors` has the subclasses."""


@dataclass(frozen=True, order=True)
class Problem:
    """One mistake in a document.

    Attributes:
        file: The document's file name, as the user gave it.
        line: Line of the mistake, from 1; 0 where the document did not come from a file.
        column: Column of the mistake, from 1.
        path: Where it is in the document, such as `sensors.touch.links`.
        what: The actual and the expected value, in words.
        hint: What would be right, or empty.
    """

    file: str
    line: int
    column: int
    path: str
    what: str
    hint: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}:{self.column}: " if self.line else f"{self.file}: "
        path = f"{self.path}: " if self.path else ""
        return f"{place}{path}{self.what}" + (f"; {self.hint}" if self.hint else "")


class SpecError(TgdslError):
    """All the mistakes of a document and its layout, sorted by place.

    Attributes:
        problems: The mistakes, sorted, without repeats.
    """

    def __init__(self, problems: Iterable[Problem]):
        self.problems: tuple[Problem, ...] = tuple(sorted(set(problems)))
        super().__init__("\n".join(map(str, self.problems)))


class BakeError(TgdslError):
    """A surface whose distance no grid within the budget holds to the tolerance, or that has no distance."""


class SampleError(TgdslError):
    """A placement that a surface cannot satisfy: the actual and the expected value in words, and what would be right."""

    def __init__(self, what: str, hint: str = ""):
        self.what, self.hint = what, hint
        super().__init__(f"{what}; {hint}" if hint else what)


class LowerError(TgdslError):
    """A sensor that its kind cannot compute on its links; `field` of its spec is at fault, if given."""

    def __init__(self, what: str, field: str = "", hint: str = ""):
        self.what, self.field, self.hint = what, field, hint
        super().__init__(f"{what}; {hint}" if hint else what)


def did_you_mean(found: str, names: Iterable[str], what: str = "names") -> str:
    """Return a hint that names the nearest known name, or else lists what exists."""
    valid = sorted(set(names))
    if not valid:
        return f"there are no {what}"
    similar = [name for name in valid if abs(len(name) - len(found)) <= 3 or name.startswith(found)]
    near = difflib.get_close_matches(found, similar, n=1, cutoff=0.6)
    if near:
        return f'did you mean "{near[0]}"?'
    return f"known {what}: {listed(valid, limit=20)}"


def raised_at(file: str, error: Exception) -> str:
    """Return a file of a user's code, with the line from which an error comes, if any: `task.py:12`."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return f"{file}:{error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f"{file}:{lines[-1]}" if lines else file


def listed(names: Sequence[str], limit: int = 12) -> str:
    """Return names joined by commas, the tail counted rather than printed."""
    text = ", ".join(names[:limit])
    return text if len(names) <= limit else f"{text} and {len(names) - limit} more"
