"""Comparisons with closed forms: results of decorated functions with name, equation, source, unit and tolerance.

Shapes: `point` positions, times or cases; `series` curves over the same abscissa.
"""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any, NamedTuple

import numpy as np
import torch


class Values(NamedTuple):
    """Values of a comparison; fields below `paper` depend on its arguments, so they cannot be in the decorator."""

    exact: Any
    """Known values: (point,), (series, point), or a number; all three are broadcast against each other."""
    ours: Any
    """tgdsl's values."""
    paper: Any = None
    """Values by the paper's formula, if it differs."""
    at: Any = None
    """Abscissa: numbers, or labels."""
    rtol: float | None = None
    atol: float | None = None
    words: Mapping[str, Any] = {}
    """Suffix of the name."""


@dataclass(frozen=True)
class Comparison:
    """A quantity computed by tgdsl and its known value; see `oracle` for the fields."""

    name: str
    equation: str
    source: str
    kinds: tuple[str, ...]
    quantity: str
    unit: str
    label: str
    label_unit: str
    at: tuple[float, ...] | tuple[str, ...]
    is_log: bool
    exact: np.ndarray
    ours: np.ndarray
    paper: np.ndarray | None
    rtol: float
    atol: float
    series: tuple[str, ...]
    defects: tuple[int, ...]

    @property
    def magnitude(self) -> float:
        """The largest magnitude of the exact values."""
        return float(np.abs(self.exact).max())

    @property
    def error(self) -> float:
        """The largest error of `ours`; infinite for not-a-number."""
        return _largest(np.abs(self.ours - self.exact))

    @property
    def paper_error(self) -> float | None:
        """The largest error of the paper's formula."""
        return None if self.paper is None else _largest(np.abs(self.paper - self.exact))

    @property
    def used(self) -> float:
        """The largest error over its tolerance; the comparison holds up to 1."""
        allowed = self.atol + self.rtol * np.abs(self.exact)
        off = np.abs(self.ours - self.exact)
        return _largest(np.divide(off, allowed, out=np.where(off == 0, 0.0, np.inf), where=allowed > 0))

    @property
    def holds(self) -> bool:
        """Whether every value is within its tolerance and a number."""
        return self.used <= 1.0


def _largest(values: np.ndarray) -> float:
    return float(np.where(np.isnan(values), np.inf, values).max())


class Case(NamedTuple):
    """A registered function with its arguments; the report shows it if `is_reported`, tests check all."""

    name: str
    section: str
    compute: Callable[[], Any]
    is_reported: bool
    is_slow: bool


CASES: list[Case] = []


def cases_of(section: str, function: Callable, each: Iterable, also: Iterable, slow: bool | Iterable = False) -> list[Case]:
    """Return the cases of a function: rows of the report, and those that only tests check."""
    rows, more, slow_rows = (
        [row if isinstance(row, tuple) else (row,) for row in arguments]
        for arguments in (each, also, () if isinstance(slow, bool) else slow)
    )
    name, cases = f"{function.__module__.rpartition('.')[2]}.{function.__name__}", []
    for arguments in [*rows, *(row for row in more if row not in rows)]:
        words = ", ".join(str(getattr(value, "name", value)) for value in arguments if not callable(value))
        is_slow = slow is True or arguments in slow_rows
        cases.append(Case(f"{name}({words})", section, partial(function, *arguments), arguments in rows, is_slow))
    return cases


class _Number(float):
    """Formats `{x:mm}` and `{x:ms}` as thousandths with that unit."""

    def __format__(self, spec: str) -> str:
        return f"{1e3 * self:g} {spec}" if spec in ("mm", "ms") else super().__format__(spec)


def field(section: str, *kinds: str) -> Callable[..., Callable]:
    """Return `oracle` for a section of the report and the sensor kinds, `noise` or `geometry` that compute its quantities."""
    return partial(oracle, section, kinds)


def oracle(
    section: str, kinds: tuple[str, ...], name: str, equation: str, source: str, quantity: str, over: str = "", *,
    at: Sequence | np.ndarray | None = None, is_log: bool = False, rtol: float = 0.0, atol: float = 0.0, of_peak: float = 0.0,
    series: Sequence[str] = (), defects: Sequence[int] = (), each: Iterable = ((),), also: Iterable = (),
    slow: bool | Iterable = False,
) -> Callable[[Callable], Callable[..., Comparison]]:  # fmt: skip
    """Register a function that returns `(exact, ours)`, `(exact, ours, paper)` or `Values`, and let it return a `Comparison`.

    `name`, `equation` (of the exact value), `source` and labels may contain the function's arguments in braces, as for
    `str.format`; names of float32 cases say so. `quantity` and `over`, the abscissa, end in their unit in brackets;
    without a unit, `at` are labels. Errors may be `atol + rtol·|exact|`; `of_peak` is `atol` over the largest exact value.
    `series` names curves, `defects` the findings of `oracles.defects` that it answers. `each` holds arguments of reported
    rows, tuples or single values, `also` those of further tests; `slow` marks arguments of slow tests, or all (True).
    """
    quantity, unit = _with_unit(quantity)
    label, label_unit = _with_unit(over)

    def decorate(function: Callable) -> Callable[..., Comparison]:
        signature = inspect.signature(function)

        @wraps(function)
        def compare(*args: Any, **kwargs: Any) -> Comparison:
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            known = {key: _Number(value) if isinstance(value, float) else value for key, value in bound.arguments.items()}
            values = Values(*function(*args, **kwargs))
            columns = np.broadcast_arrays(*(_column(part) for part in values[:3] if part is not None))
            exact, ours, paper = (*map(np.array, columns), None)[:3]
            places = values.at if at is None else at
            labels = _column(places).tolist() if label_unit else [str(place).format(**known) for place in places]
            title = name.format(**known, **values.words) + (", float32" if torch.float32 in known.values() else "")
            allowed = of_peak * float(abs(exact).max()) or (atol if values.atol is None else values.atol)
            return Comparison(
                title, equation.format(**known), source.format(**known), kinds, quantity, unit, label, label_unit, tuple(labels),
                is_log, exact, ours, paper, rtol if values.rtol is None else values.rtol, allowed, tuple(series), tuple(defects),
            )  # fmt: skip

        compare.kinds, compare.defects = kinds, defects
        CASES.extend(cases_of(section, compare, each, also, slow))
        return compare

    return decorate


def _column(values: Any) -> np.ndarray:
    return np.atleast_1d(np.asarray(values, dtype=np.float64))


def _with_unit(text: str) -> tuple[str, str]:
    """Split "quantity [unit]"."""
    parts = re.fullmatch(r"(.*) \[([^\[]*)\]", text)
    return (parts[1], parts[2]) if parts else (text, "")
