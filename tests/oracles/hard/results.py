"""What a hard case returns: what could go wrong, and how far each of its parts is off, in each precision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from tgdsl.report.sheets.sheet import Entry
from tgdsl.view.style import FAINT

Errors = Float[np.ndarray, "part"]
COLORS = {"float64": "#1f6f8b", "float32": "#d08a2e"}
FLOOR = 1e-18
"""Errors below this are drawn here."""


@dataclass(frozen=True)
class Allowed:
    """Errors of one precision, and what they may be at most.

    Attributes:
        errors: Of each part; not-a-number or infinite where readings were not finite.
        most: What each may be at most.
    """

    errors: Errors
    most: float

    @property
    def worst(self) -> float:
        """The largest; not-a-number counts as infinite."""
        return float(np.where(np.isnan(self.errors), np.inf, self.errors).max())

    @property
    def holds(self) -> bool:
        """Whether no error is above what it may be."""
        return self.worst <= self.most


@dataclass(frozen=True)
class HardCase:
    """A hard case.

    Attributes:
        name: What is hard.
        risk: What could go wrong.
        reference: What readings are compared with.
        unit: Unit of the errors: "of full scale", "m", or a count's name.
        parts: What it was tried on: kinds, shapes, time steps.
        errors: By precision, `float64` or `float32`.
        defects: Findings about the paper's implementation that it answers, by number.
    """

    name: str
    risk: str
    reference: str
    unit: str
    parts: tuple[str, ...]
    errors: Mapping[str, Allowed]
    defects: tuple[int, ...] = ()

    @property
    def is_finite(self) -> bool:
        """Whether all that was read is finite."""
        return all(np.isfinite(own.errors).all() for own in self.errors.values())

    @property
    def holds(self) -> bool:
        """Whether every error is as small as it must be."""
        return all(own.holds for own in self.errors.values())


Case = Callable[[], HardCase]
"""A function that runs one hard case."""
HEADER = ("hard case", "what could go wrong", "worst, float64", "worst, float32", "unit", "finite", "against")


def entry_of(case: HardCase) -> Entry:
    """Return a hard case as an entry of a report."""
    spans = {name: f"{own.worst:.1e} ≤ {own.most:.0e}" for name, own in case.errors.items()}
    cells = (
        case.risk,
        spans.get("float64", ""),
        spans.get("float32", ""),
        case.unit,
        "yes" if case.is_finite else "no",
        case.reference,
    )
    record: dict[str, object] = {"risk": case.risk, "reference": case.reference, "unit": case.unit, "finite": case.is_finite}
    for name, own in case.errors.items():
        record |= {f"{name}_worst": own.worst, f"{name}_allowed": own.most, f"{name}_errors": own.errors.tolist()}
    record["parts"] = list(case.parts)
    figure = ", ".join(f"{name} {own.worst:.1e} {case.unit}" for name, own in case.errors.items())
    notes = (case.risk, f"against {case.reference}")
    return Entry(case.name, cells, record, notes, lambda axes: draw(case, axes), case.holds, case.defects, figure)


def draw(case: HardCase, axes: Axes) -> None:
    """Draw the error of each part, and what it may be at most as a line."""
    x = np.arange(len(case.parts))
    for i, (name, own) in enumerate(case.errors.items()):
        color = COLORS[name]
        errors = np.maximum(np.nan_to_num(own.errors, nan=1e9, posinf=1e9), FLOOR)
        axes.plot(x + 0.15 * i, errors, "o", markersize=4, color=color, label=name)
        axes.axhline(max(own.most, FLOOR), color=color, linewidth=0.8, linestyle="--")
    axes.set_yscale("log")
    axes.set_ylabel(f"error [{case.unit}]", fontsize=7.5)
    axes.legend(fontsize=6.5, frameon=False, labelcolor=FAINT)
    step = max(1, -(-len(x) // 20))
    axes.set_xticks(x[::step])
    axes.set_xticklabels(list(case.parts[::step]), rotation=50, ha="right")
    axes.margins(x=0.1, y=0.15)
