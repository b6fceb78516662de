"""Where files are, those a document names and the robots that come with tgdsl; and writing one whole."""

from __future__ import annotations

import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import tgdsl
from tgdsl.errors import FileError

_PACKAGE = Path(tgdsl.__file__).parent


def is_file(path: Path) -> bool:
    """Return whether there is such a file; unlike `Path.is_file`, also of names that no file can have."""
    return os.path.isfile(path)


def robots_folder() -> Path:
    """Return the folder of the robots that come with tgdsl: in the installed package, or at the top of a checkout."""
    installed = _PACKAGE / "_robots"
    return installed if installed.is_dir() else _PACKAGE.parent / "robots"


def robot_names() -> dict[str, Path]:
    """Return the model file of each robot known by name; a folder's own name means its right hand."""
    names: dict[str, Path] = {}
    for folder in sorted(path for path in robots_folder().iterdir() if path.is_dir()):
        for model in sorted(folder.glob("*.xml")):
            names[model.stem] = model
        if (folder / f"{folder.name}_right.xml").is_file():
            names.setdefault(folder.name, folder / f"{folder.name}_right.xml")
    return names


def robot_file(model: str, folder: Path) -> Path | None:
    """Return the file of a robot given by name or by a path relative to the document's folder; None if there is none."""
    if model in (known := robot_names()):
        return known[model]
    path = folder / model
    return path if is_file(path) else None


def layout_file(model: Path) -> Path | None:
    """Return the layout beside a model file: of `hand_left.xml` in `hand/` it is `layout_left.yaml`, or else `layout.yaml`."""
    side = model.stem.removeprefix(f"{model.parent.name}_")
    names = (f"layout_{side}.yaml", "layout.yaml")
    return next((model.parent / name for name in names if (model.parent / name).is_file()), None)


def writable(target: Path) -> Path:
    """See that a file can be written, before the work that leads to it; nothing is made, its folder neither.

    Returns:
        The file.

    Raises:
        FileError: If it cannot be written.
    """
    there = next(part for part in target.absolute().parents if part.exists())
    if not there.is_dir():
        raise FileError(target, f"{there} is a file, expected a folder")
    with naming(target):
        _refuse_folder(target)
        with tempfile.TemporaryFile(dir=there):
            return target


def with_folder(target: Path) -> Path:
    """Make the folder of a file that is written next; return the file.

    Raises:
        FileError: If it cannot be made.
    """
    with naming(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    return target


@contextmanager
def whole_file(target: Path) -> Iterator[Path]:
    """Yield an empty file beside a target, of the same suffix and with a new file's permissions, which then takes its place.

    If anything is raised meanwhile it is removed, and the target stays as it was.

    Raises:
        FileError: If it cannot be written; the error names the target.
    """
    temporary = target.with_name(f".{secrets.token_hex(8)}{target.suffix}")
    with naming(target):
        _refuse_folder(target)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))  # less what the process's umask takes away
        try:
            yield temporary
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def whole(target: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that appears whole, when it is closed, or not at all; one that is there is replaced.

    Raises:
        FileError: If it cannot be written; the error names the file.
    """
    with whole_file(target) as temporary, temporary.open("wb") as file:
        yield file


def write_whole(target: Path, content: bytes) -> None:
    """Write a file so that it appears whole or not at all; one that is there is replaced.

    Raises:
        FileError: If it cannot be written.
    """
    with whole(target) as file:
        file.write(content)


@contextmanager
def naming(target: Path) -> Iterator[None]:
    """Have errors of the system name the file that the user asked for, whatever it is called meanwhile.

    Raises:
        FileError: Instead of any OSError.
    """
    try:
        yield
    except FileError:
        raise
    except OSError as error:
        raise FileError(target, error.strerror or str(error)) from error


def _refuse_folder(target: Path) -> None:
    if target.is_dir():
        raise FileError(target, "this is a folder, expected a file's name")
