"""A document and its layout: as found, as read, and what is wrong with them so far."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from tgdsl.errors import LowerError, Problem, SpecError
from tgdsl.files import find
from tgdsl.schema.document import Spec
from tgdsl.schema.placement import LayoutSpec
from tgdsl.schema.yaml import Path, Source

GIVEN = "<scene>"  # the robot's model of a document that names none, where a scene is given


@dataclass(kw_only=True)
class Section:
    """A document, or its layout, as found, and its mistakes so far."""

    source: Source  # its text's values and places
    folder: FilePath  # folder that file names in it are relative to
    problems: list[Problem]  # mistakes found so far, of the document and its layout; later stages add theirs
    prefix: Path = ()  # where its paths start in the source: of a layout in line, where that stands in its document

    def problem(self, path: Path, what: str, hint: str = "", on_key: bool = False) -> Problem:
        """Return a mistake at a path."""
        return self.source.problem((*self.prefix, *path), what, hint, on_key)

    def note(self, path: Path, what: str | LowerError, hint: str = "", on_key: bool = False) -> None:
        """Note a mistake at a path; a `LowerError` at the field of it that the error names."""
        if isinstance(what, LowerError):
            path, what, hint = (*path, *([what.field] if what.field else [])), what.what, what.hint
        self.problems.append(self.problem(path, what, hint, on_key))

    def raw(self, path: Path) -> Any:
        """Return the plain value at a path, or None."""
        return self.source.get((*self.prefix, *path))


@dataclass(kw_only=True)
class LoadedLayout(Section):
    """A layout, as found and as read."""

    spec: LayoutSpec


@dataclass(kw_only=True)
class Loaded(Section):
    """A document, as found and as read. With `problems`, faulty entries are left out of `spec`."""

    spec: Spec  # the document
    layout: LoadedLayout | None = None  # its layout; None if that could not be read, or if it `is_without_layout`

    @property
    def robot_file(self) -> FilePath | None:
        """The robot's model file, if it exists."""
        return find.robot_file(self.spec.robot.model, self.folder)

    @property
    def is_without_layout(self) -> bool:
        """Whether it has no layout and needs none: none of its sensors reads taxels, and all are on bodies of the robot."""
        sensors = self.spec.sensors.values()
        is_none = self.layout is None and self.spec.robot.layout is None and bool(sensors)
        return is_none and not any(sensor.needs_taxels for sensor in sensors)

    @property
    def resolution(self) -> str | None:
        """The resolution that is compiled: the one named, or the only one."""
        if self.spec.resolution is not None or self.layout is None:
            return self.spec.resolution
        names = list(self.layout.spec.resolutions)
        return names[0] if len(names) == 1 else None

    def raise_problems(self) -> None:
        """Raise all mistakes found so far, if any."""
        if self.problems:
            raise SpecError(self.problems)
