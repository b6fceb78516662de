"""Numerical hard cases: a decorated function returns the error of each part in one precision."""

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
    """Errors in one precision, the largest allowed one, and the parts' names, if these depend on the arguments."""

    values: Any
    most: float
    parts: Sequence[str] = ()


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
    """Errors of one risk by precision, `float64` or `float32`; see `hard` for the other fields."""

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
    section: str, name: str, risk: str, reference: str, unit: str, parts: Sequence[str] | Mapping[str, Any] = (), *,
    float64: float | None = 0.0, float32: float | None = 0.0, defects: Sequence[int] = (), each: Iterable = ((),),
    also: Iterable = (),
) -> Callable[[Callable], Callable[..., HardCase]]:  # fmt: skip
    """Register a function of a dtype that returns errors, or `Errors`, and let it return a `HardCase`.

    `name` and `risk` may contain the function's arguments in braces. Readings are compared with `reference`; `unit` is
    that of the errors: "of full scale", "m", or the counted things. `parts` names the variants; for a mapping, the
    function takes each value after the dtype and returns one error. `float64` and `float32` are the largest allowed
    errors; None: not tested. `defects`, `each` and `also` are as in `oracle`.
    """

    def decorate(function: Callable) -> Callable[..., HardCase]:
        signature = inspect.signature(function)

        def errors_of(dtype: torch.dtype, *arguments: Any) -> Any:
            if not isinstance(parts, Mapping):
                return function(dtype, *arguments)
            results = [function(dtype, part, *arguments) for part in parts.values()]
            is_limited = isinstance(results[0], Errors)
            return Errors([result.values for result in results], results[0].most) if is_limited else results

        @wraps(function)
        def run(*arguments: Any) -> HardCase:
            bound = signature.bind(*([None] * (1 + isinstance(parts, Mapping))), *arguments)
            bound.apply_defaults()
            errors, names = {}, parts
            for precision, most in (("float64", float64), ("float32", float32)):
                if most is not None:
                    result = errors_of(DTYPES[precision], *arguments)
                    result = result if isinstance(result, Errors) else Errors(result, most)
                    names = result.parts or names
                    errors[precision] = Allowed(np.array(result.values, dtype=float), result.most)
            title, danger = name.format(**bound.arguments), risk.format(**bound.arguments)
            return HardCase(title, danger, reference, unit, tuple(names), errors, tuple(defects))

        run.defects = defects
        HARD.extend(cases_of(section, run, each, also))
        return run

    return decorate
