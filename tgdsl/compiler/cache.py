"""What takes long to compute, kept as arrays in the user's cache folder under a hash of what it was computed from."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def folder() -> Path:
    """Return the cache folder: `TGDSL_CACHE`, or `tgdsl` in `XDG_CACHE_HOME` or in `~/.cache`."""
    if own := os.environ.get("TGDSL_CACHE"):
        return Path(own)
    shared = os.environ.get("XDG_CACHE_HOME")
    return (Path(shared) if shared else Path(os.path.expanduser("~/.cache"))) / "tgdsl"


def digest(format: bytes, arrays: Sequence[np.ndarray]) -> str:
    """Return a hash of a format's name and of shapes and contents of arrays."""
    found = hashlib.sha256(format)
    for array in arrays:
        found.update(f"{array.shape} {array.dtype.str} ".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def cached(
    key: str,
    make: Callable[[], T],
    pack: Callable[[T], Mapping[str, np.ndarray]],
    unpack: Callable[[Mapping[str, np.ndarray]], T],
) -> T:
    """Return what a cache file holds, or else make it and write one.

    Args:
        key: Name of the file.
        make: Computes the value.
        pack: Returns its arrays.
        unpack: Returns the value of its arrays; raises ValueError, KeyError, IndexError or TypeError if they are none.
    """
    file = folder() / f"{key}.npz"
    try:
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as found:
            return unpack(found)
    except (OSError, ValueError, KeyError, IndexError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        pass  # there is none, or it is damaged
    value = make()
    _write(file, pack(value))
    return value


def _write(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a cache file, whole or not at all; a folder that cannot be written is left alone."""
    temporary = None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".tmp", delete=False) as out:
            temporary = Path(out.name)
            np.savez(out, allow_pickle=False, **arrays)
        temporary.replace(file)
    except OSError:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
