"""Arrays of `.npz` files."""

from __future__ import annotations

import zlib
from collections.abc import Collection
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from tgdsl.errors import TgdslError


def read_arrays(
    file: Path, expected: str, error: type[TgdslError] = TgdslError, only: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Return the arrays of an `.npz` file by name, or `only` some of them, without reading the others.

    `expected` says what the file should be, such as "an .npz file of states".

    Raises:
        TgdslError: Of the type `error`, if the file cannot be read, or holds anything but arrays.
    """
    try:
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if only is None or name in only}
    except (OSError, EOFError, ValueError, TypeError, AttributeError, BadZipFile, zlib.error) as wrong:  # TypeError: .npy
        raise error(f"{file}: expected {expected}: {wrong}") from wrong
