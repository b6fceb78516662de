"""Third octaves: which band each mode is in.

    f_n = 1000 · 10^(n/10) Hz,   edges f_n · 10^(∓1/20)

Source: IEC 61260-1, base-ten system. Shapes: `row` bodies that ring, `mode` their modes, `band` bands.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def numbers(frequency: np.ndarray) -> np.ndarray:
    """Return the number of the band that each frequency is in; of 0 Hz that of none."""
    return np.round(10 * np.log10(np.where(frequency > 0, frequency, 1.0) / 1000.0)).astype(np.int64)


def band_numbers(frequency: Float[np.ndarray, " mode"]) -> list[int]:
    """Return the bands from that of the lowest mode to that of the highest."""
    own = numbers(frequency)
    return list(range(int(own.min()), int(own.max()) + 1))


def middle(number: int) -> float:
    """Return a band's middle frequency [Hz]."""
    return 1000.0 * 10.0 ** (number / 10)


def membership(frequency: Float[np.ndarray, "row mode"], bands: Sequence[int]) -> Float[np.ndarray, "row mode band"]:
    """Return 1 for the band that each mode is in, else 0."""
    is_in = numbers(frequency)[..., None] == np.array(bands)
    return (is_in & (frequency > 0)[..., None]).astype(np.float64)
