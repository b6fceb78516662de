"""Numerical hard cases: a decorated function returns the error of each part in one precision."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
import torch

from oracles.comparison import Case, cases_of

DTYPES = {"float64": torch.float64, "float32": torch.float32}
HARD: list[Case] = []


class Errors(NamedTuple):
    """What a hard case computes in one precision.

    Attributes:
        values: Error of each part; infinite or not-a-number where a reading is not finite.
        parts: Names of the parts, if the decorator does not give them.
        most: Largest allowed error, if the decorator does not give it.
    """

    values: Any
    parts: Sequence[str] | None = None
    most: float | None = None


class Allowed(NamedTuple):
    """Errors in one precision (part,), and the largest allowed one."""

    errors: np.ndarray
    most: float

    @property
    def worst(self) -> float:
        """The largest error; infinite for not-a-number."""
        return float(np.where(np.isnan(self.errors), np.inf, self.errors).max())


@dataclass(frozen=True)
class HardCase:
    """Errors of one risk.

    Attributes:
        name: One line.
        risk: What could go wrong.
        reference: What readings are compared with.
        unit: Unit of the errors: "of full scale", "m", or the name of what is counted.
        parts: What it was tried on: kinds, shapes, time steps.
        errors: By precision, `float64` or `float32`.
        defects: Numbers of the findings in `tgdsl.report.defects` that it answers.
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
        """Whether every reading is finite."""
        return all(np.isfinite(allowed.errors).all() for allowed in self.errors.values())

    @property
    def holds(self) -> bool:
        """Whether every error is at most the allowed one."""
        return all(allowed.worst <= allowed.most for allowed in self.errors.values())


def hard(
    section: str, name: str, risk: str, reference: str, unit: str, parts: Sequence[str] = (), *, float64: float | None = 0.0,
    float32: float | None = 0.0, defects: Sequence[int] = (), each: Iterable = ((),), also: Iterable = (),
) -> Callable[[Callable], Callable[..., HardCase]]:  # fmt: skip
    """Register a function of a dtype that returns errors, or `Errors`, and let it return a `HardCase`.

    Args:
        section: Section of the report.
        name: See `HardCase`, also for `risk`, `reference`, `unit`, `parts` and `defects`; arguments in braces are filled in.
        risk: What could go wrong.
        reference: What readings are compared with.
        unit: Unit of the errors.
        parts: Names of the parts.
        float64: Largest allowed error; None: not tried in this precision.
        float32: The same in float32.
        defects: Findings that it answers.
        each: Arguments of each row of the report: tuples, or single arguments.
        also: Arguments that tests check in addition.
    """

    def decorate(function: Callable) -> Callable[..., HardCase]:
        signature = inspect.signature(function)

        @wraps(function)
        def run(*args: Any) -> HardCase:
            bound = signature.bind(None, *args)
            bound.apply_defaults()
            names, errors = parts, {}
            for precision, most in (("float64", float64), ("float32", float32)):
                if most is None:
                    continue
                result = function(DTYPES[precision], *args)
                result = result if isinstance(result, Errors) else Errors(result)
                names = result.parts or names
                errors[precision] = Allowed(np.array(result.values, dtype=float), most if result.most is None else result.most)
            filled = (text.format(**bound.arguments) for text in (name, risk, reference, unit))
            return HardCase(*filled, tuple(names), errors, tuple(defects))

        run.defects = defects
        HARD.extend(cases_of(section, run, each, also))
        return run

    return decorate
