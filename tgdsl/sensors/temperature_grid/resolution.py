"""How well cells hold what their faces lose: against the closed form of a box that cools from one temperature.

    θ̄ = Π_a Σ_m 4 sin² β/(β (2β + sin 2β)) e^(−β² αt/L²),   β tan β = hL/k                                          [1]

is the mean of what is left of a box, a product over the axes with exposed faces, L the box's side along one, or half of it if
both of its faces are exposed. Cells leave the sum of their own modes. They are compared when two fifths of the heat are lost.
Cells begin with an even flow to the face, and the solid with a steeper one: that is what cells too large for Bi = hL/k miss.

Source: Carslaw and Jaeger, *Conduction of Heat in Solids*, 3.11; Incropera et al., 5.5 and 5.8.

Shapes: `row` links, `axis` x, y and z.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import CoarseCellsWarning
from tgdsl.quantities.patches import tables

LARGEST_ERROR = 0.01
"""Error of the heat lost up to which cells are fine enough [1]."""
EARLY = 0.5
"""When they are compared, in time constants of the cells: two fifths of the heat are lost then."""
MOST_CELLS = 64
"""Cells along an axis that are tried."""


def warn_of_coarse(
    names: Sequence[str],
    count: Int[np.ndarray, "row 3"],
    size: Float[np.ndarray, "row 3"],
    exposed: Sequence[str],
    conductivity: Float[np.ndarray, " row"],
    film: Float[np.ndarray, " row"],
) -> None:
    """Warn of the link whose cells err most, and name the cells that would do.

    Args:
        names: The links.
        count: Their cells along each axis.
        size: Sides of their boxes [m].
        exposed: Faces that lose heat.
        conductivity: k [W/(m·K)].
        film: Heat transfer coefficient of a face near ambient [W/(m²·K)].
    """
    errors = [abs(lost_error(*row, exposed)) for row in zip(count, size, film / conductivity, strict=True)]
    worst = int(np.argmax(errors))
    if errors[worst] <= LARGEST_ERROR:
        return
    across = np.array([any(face[1] == axis for face in exposed) for axis in "xyz"])
    size, ratio = size[worst], film[worst] / conductivity[worst]
    enough = f"more than {MOST_CELLS} along an axis would be needed"
    for most in range(2, MOST_CELLS + 1):
        finer = np.where(across, np.maximum(count[worst], most), count[worst])
        if abs(lost_error(finer, size, ratio, exposed)) <= LARGEST_ERROR:
            enough = f"{_times(finer)} cells hold {100 * LARGEST_ERROR:g} %"
            break
    problem = f"what its faces lose is {100 * errors[worst]:.2g} % wrong with {_times(count[worst])} cells"
    warnings.warn(f"heat of {names[worst]}: {problem}; {enough}", CoarseCellsWarning, stacklevel=2)


def _times(count: Int[np.ndarray, " axis"]) -> str:
    return " × ".join(str(number) for number in count.tolist())


def lost_error(
    count: Int[np.ndarray, " axis"], size: Float[np.ndarray, " axis"], ratio: float, exposed: Sequence[str]
) -> float:
    """Return the relative error of the heat that cells have lost after `EARLY`.

    Args:
        count: Cells along each axis.
        size: Sides of the box [m].
        ratio: Heat transfer coefficient of its faces over conductivity [1/m].
        exposed: The faces.
    """
    ends = np.array([sum(face[1] == axis for face in exposed) for axis in "xyz"])
    step = size / count
    loss = ratio * step / (1.0 + ratio * step / 2.0 * (1.0 - ends / (3.0 * count)))
    slowest = tables(count[None], size[None], exposed, loss[None])
    rates = [slowest[f"square_{axis}"][0] / step[a] ** 2 for a, axis in enumerate("xyz")]
    time = EARLY / sum(own.min() for own in rates)
    ours, exact = 1.0, 1.0
    for a, axis in enumerate("xyz"):
        ours *= float(slowest[f"total_{axis}"][0] ** 2 @ np.exp(-rates[a] * time)) / count[a]
        if ends[a]:
            exact *= _left(ratio * size[a] / ends[a], time / (size[a] / ends[a]) ** 2)
    return (1.0 - ours) / (1.0 - exact) - 1.0


def _left(biot: float, fourier: float, count: int = 40) -> float:
    """Return the mean of a slab that began at 1 and loses heat at one of its faces."""
    low, high = np.pi * np.arange(count), np.pi * (np.arange(count) + 0.5)
    for _ in range(60):
        middle = 0.5 * (low + high)
        is_below = middle * np.sin(middle) * (-1.0) ** np.arange(count) < biot * np.cos(middle) * (-1.0) ** np.arange(count)
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    beta = 0.5 * (low + high)
    share = 4.0 * np.sin(beta) ** 2 / (beta * (2.0 * beta + np.sin(2.0 * beta)))
    return float(share @ np.exp(-(beta**2) * fourier))
