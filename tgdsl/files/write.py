"""Atomic writes: a file appears whole, or not at all, with the permissions of any new file; and its folder.

Content goes to a temporary file next to the target, which then replaces the target. Failures are a `FileError` that names the
target.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from tgdsl.errors import FileError

TEMPORARY = re.compile(r"\.[0-9a-f]{16}")  # stems of temporary files; an old one was left by a killed process


def check_writable(target: Path) -> Path:
    """Check that a file can be written, before computing its content; neither the file nor its folder is created.

    Returns:
        The file.

    Raises:
        FileError: If it cannot be written.
    """
    there = next(part for part in target.absolute().parents if part.exists())
    if not there.is_dir():
        raise FileError(target, f"{there} is a file, expected a folder")
    with as_file_error(target):
        _refuse_folder(target)
        with tempfile.TemporaryFile(dir=there):
            return target


def with_folder(target: Path) -> Path:
    """Create the folder of a file; return the file."""
    with as_file_error(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    return target


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield an empty temporary file of the target's suffix, for a library that writes to a path; then it replaces the target.

    After an exception it is removed, and the target stays unchanged.
    """
    temporary = target.with_name(f".{secrets.token_hex(8)}{target.suffix}")
    with as_file_error(target):
        _refuse_folder(target)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))  # the process's umask applies
        try:
            yield temporary
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def atomic_open(target: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing bytes; when it is closed it replaces the target."""
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        yield file


def atomic_write(target: Path, content: bytes) -> None:
    """Write a file, replacing an existing one."""
    with atomic_open(target) as file:
        file.write(content)


def atomic_write_all(contents: Mapping[Path, bytes]) -> None:
    """Write files that belong together, and their folders: all are written before they replace their targets in order."""
    with ExitStack() as stack:
        for target, content in reversed(list(contents.items())):  # the stack closes the last one first
            stack.enter_context(new_folder(target))
            stack.enter_context(atomic_path(target)).write_bytes(content)


@contextmanager
def as_file_error(target: Path) -> Iterator[None]:
    """Raise the system's errors as errors of the requested file, not of its temporary one."""
    try:
        yield
    except FileError:
        raise
    except OSError as error:
        raise FileError(target, error.strerror or str(error)) from error


@contextmanager
def new_folder(target: Path) -> Iterator[None]:
    """Create the folder of a file; after an exception, remove new folders that are empty."""
    new = [folder for folder in target.parents if not folder.exists()]
    with_folder(target)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # something is in it
            for folder in new:
                folder.rmdir()
        raise


def _refuse_folder(target: Path) -> None:
    if target.is_dir():
        raise FileError(target, "this is a folder, expected a file's name")
