"""What an oracle returns: a quantity as this package computes it, its exact value, and the paper's where that differs.

Shapes: `point` places, times or cases, `series` curves over the same abscissa.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, "point"] | Float[np.ndarray, "series point"]
Oracle = Callable[[], "Comparison"]
"""A function that computes one comparison; it takes no arguments, or has been given them."""


@dataclass(frozen=True)
class Abscissa:
    """What a comparison is drawn over.

    Attributes:
        label: What it is.
        unit: Its unit; empty for labels.
        values: One for each point: numbers, or labels.
        is_log: Whether the axis is logarithmic.
    """

    label: str
    unit: str
    values: tuple[float, ...] | tuple[str, ...]
    is_log: bool = False

    @property
    def numbers(self) -> np.ndarray | None:
        """The values, unless they are labels."""
        return None if any(isinstance(value, str) for value in self.values) else np.array(self.values, dtype=float)


@dataclass(frozen=True)
class Comparison:
    """What is computed, against what is known.

    Attributes:
        name: What is compared, in a line.
        source: Where the exact value comes from: author, year and equation, or what it was derived from.
        equation: The exact value, as a formula in text.
        kinds: Sensor kinds that compute so, or `noise`, `geometry`.
        quantity: What is compared.
        unit: Its unit.
        over: What it is drawn over.
        exact: Exact values.
        ours: The same as this package computes them.
        rtol: How far ours may be off, over the exact value.
        atol: How far ours may be off in addition.
        paper: The same by the paper's formula, where it differs.
        series: Names of the curves, where there are several.
        defects: Findings about the paper's implementation that it answers, by number; see `tgdsl.report.defects`.
    """

    name: str
    source: str
    equation: str
    kinds: tuple[str, ...]
    quantity: str
    unit: str
    over: Abscissa
    exact: Values
    ours: Values
    rtol: float = 0.0
    atol: float = 0.0
    paper: Values | None = None
    series: tuple[str, ...] = ()
    defects: tuple[int, ...] = ()

    @property
    def magnitude(self) -> float:
        """The exact values' largest magnitude."""
        return float(np.abs(self.exact).max())

    @property
    def error(self) -> float:
        """How far ours is off at most."""
        return _largest(np.abs(self.ours - self.exact))

    @property
    def paper_error(self) -> float | None:
        """How far the paper's formula is off at most."""
        return None if self.paper is None else _largest(np.abs(self.paper - self.exact))

    @property
    def used(self) -> float:
        """The largest error over what is allowed there; at most 1 if the comparison holds."""
        allowed = self.atol + self.rtol * np.abs(self.exact)
        off = np.abs(self.ours - self.exact)
        return _largest(np.divide(off, allowed, out=np.where(off == 0, 0.0, np.inf), where=allowed > 0))

    @property
    def holds(self) -> bool:
        """Whether ours is as near to the exact values as it must be; not-a-number is not."""
        return self.used <= 1.0


def _largest(values: np.ndarray) -> float:
    """Return the largest; not-a-number counts as infinite."""
    return float(np.where(np.isnan(values), np.inf, values).max())


def array(values: Any) -> np.ndarray:
    """Return numbers as float64, a single one as one point."""
    return np.atleast_1d(np.asarray(values, dtype=np.float64))


def cases(labels: Sequence[Any], label: str = "") -> Abscissa:
    """Return an abscissa of labels."""
    return Abscissa(label, "", tuple(map(str, labels)))


def along(label: str, unit: str, values: Any, is_log: bool = False) -> Abscissa:
    """Return an abscissa of numbers."""
    return Abscissa(label, unit, tuple(array(values).tolist()), is_log)
