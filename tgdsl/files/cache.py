"""Cache of expensive results: arrays in the user's cache folder, under a hash of their inputs.

The folder's size is bounded: the least recently used files are removed first. Several processes may use it at once: files
appear and disappear whole, an open file can be read to its end, and all processes evict files in the same order.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import re
import time
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_origin, get_type_hints

import numpy as np

from tgdsl.errors import FileError, TgdslError
from tgdsl.files.write import TEMPORARY, atomic_open, with_folder

T = TypeVar("T")
MAX_BYTES = 2 * 2**30  # largest size of the folder, unless `TGDSL_CACHE_BYTES` sets another
_ENTRY = re.compile(r"[0-9a-f]{64}\.npz")
_TEMPORARY = re.compile(TEMPORARY.pattern + r"\.npz")
_ABANDONED = 3600.0  # age from which an unfinished file counts as abandoned [s]


def folder() -> Path:
    """Return the cache folder: `TGDSL_CACHE`, or `tgdsl` in `XDG_CACHE_HOME` or in `~/.cache`."""
    if folder := os.environ.get("TGDSL_CACHE"):
        return Path(folder)
    shared = os.environ.get("XDG_CACHE_HOME")
    return (Path(shared) if shared else Path(os.path.expanduser("~/.cache"))) / "tgdsl"


def max_bytes() -> int:
    """Return the largest size of the folder [bytes]: `TGDSL_CACHE_BYTES`, or `MAX_BYTES`."""
    limit = os.environ.get("TGDSL_CACHE_BYTES", "")
    if limit and not limit.isdecimal():
        raise TgdslError(f'TGDSL_CACHE_BYTES is "{limit}", expected a number of bytes such as {MAX_BYTES}')
    return int(limit) if limit else MAX_BYTES


@dataclass(frozen=True, order=True)
class Entry:
    """A file of the cache: when it was last used [s since the epoch], where it is, and its size [bytes]."""

    used: float
    file: Path
    size: int


def entries() -> list[Entry]:
    """Return the files of the cache, the least recently used first; other files in the folder do not belong to it."""
    results = []
    for file in folder().glob("*") if folder().is_dir() else ():
        with contextlib.suppress(OSError):  # another process has just removed it
            state = file.stat()
            is_abandoned = _TEMPORARY.fullmatch(file.name) and time.time() - state.st_mtime > _ABANDONED
            if _ENTRY.fullmatch(file.name) or is_abandoned:
                results.append(Entry(state.st_mtime, file, state.st_size))
    return sorted(results)


def evict(limit: int) -> list[Entry]:
    """Remove the least recently used files until the cache is within a limit [bytes]; return the removed ones."""
    cached = entries()
    size, removed = sum(entry.size for entry in cached), []
    for entry in cached:
        if size <= limit:
            break
        size -= entry.size  # also if another process has removed it
        try:
            entry.file.unlink()
            removed.append(entry)
        except OSError:
            pass
    return removed


def digest(format: bytes, arrays: Sequence[np.ndarray]) -> str:
    """Return a hash of a format's name and of shapes and contents of arrays."""
    result = hashlib.sha256(format)
    for array in arrays:
        result.update(f"{array.shape} {array.dtype.str} ".encode() + np.ascontiguousarray(array).tobytes())
    return result.hexdigest()


def cached(
    key: str,
    make: Callable[[], T],
    pack: Callable[[T], Mapping[str, np.ndarray]],
    unpack: Callable[[Mapping[str, np.ndarray]], T],
) -> T:
    """Return the value in the cache file `key`, or else compute it and write the file.

    `unpack` returns the value of arrays that `pack` returned, or raises ValueError, KeyError, IndexError or TypeError.
    """
    file, limit = folder() / f"{key}.npz", max_bytes()
    try:
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as archive:
            value = unpack(archive)
        with contextlib.suppress(OSError):  # another user's file, or one that was just removed
            os.utime(file)  # many file systems do not record access times
        return value
    except (OSError, ValueError, KeyError, IndexError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        pass  # there is none, or it is damaged
    value = make()
    with contextlib.suppress(FileError), atomic_open(with_folder(file)) as out:  # a folder that cannot be written is left alone
        np.savez(out, allow_pickle=False, **pack(value))
    evict(limit)
    return value


def cached_record(key: str, make: Callable[[], T], kind: type[T]) -> T:
    """Return a dataclass from a cache file, or else compute it and write the file; see `cached`.

    Its fields are arrays of finite numbers, numbers, texts, tuples of these, and dataclasses of numbers or None.
    """

    def unpack(found: Mapping[str, np.ndarray]) -> T:
        values: dict[str, Any] = {}
        for name, hint in get_type_hints(kind).items():
            value = found[name]
            if isinstance(hint, type) and dataclasses.is_dataclass(hint):
                numbers = zip(dataclasses.fields(hint), value.tolist(), strict=True)
                values[name] = hint(*(None if n != n else int(n) if field.type == "int" else n for field, n in numbers))
            elif value.ndim == 0 or get_origin(hint) is tuple:
                values[name] = value.item() if value.ndim == 0 else tuple(value.tolist())
            elif np.isfinite(value).all():
                values[name] = value
            else:
                raise ValueError("a damaged file")
        return kind(**values)

    def pack(record: Any) -> dict[str, np.ndarray]:
        values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
        return {
            name: np.array(dataclasses.astuple(value), float) if dataclasses.is_dataclass(value) else np.asarray(value)  # type: ignore[arg-type]
            for name, value in values.items()
        }

    return cached(key, make, pack, unpack)
