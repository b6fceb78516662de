"""Numbered entries of the cache, whose arrays are known."""

import numpy as np

from tgdsl.files import cache

VALUES = 1000
"""Numbers of an entry, 8 bytes each; its file is a little larger."""


def key(i: int) -> str:
    return cache.digest(b"test", [np.array(i)])


def value_of(i: int, made: list[int] | None = None) -> np.ndarray:
    """Return entry i from the cache, or make it."""

    def make() -> np.ndarray:
        if made is not None:
            made.append(i)
        return np.full(VALUES, float(i))

    return cache.cached(key(i), make, lambda value: {"value": value}, lambda found: found["value"])
