"""Comparisons with closed forms: what a decorated function returns, with its name, source, unit and tolerance.

Shapes: `point` places, times or cases; `series` curves over the same abscissa.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any, NamedTuple

import numpy as np
import torch


class Values(NamedTuple):
    """What a comparison computes, each (point,), (series, point) or a number, broadcast against each other.

    Attributes:
        exact: Known values.
        ours: The same computed by tgdsl.
        paper: The same by the paper's formula, if it differs.
        at: Abscissa, if the decorator does not give it: numbers, or labels.
        rtol: Relative tolerance, if the decorator does not give it.
        atol: Absolute tolerance, if the decorator does not give it.
        words: More words for the name.
    """

    exact: Any
    ours: Any
    paper: Any = None
    at: Any = None
    rtol: float | None = None
    atol: float | None = None
    words: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Comparison:
    """A quantity as tgdsl computes it beside its known value.

    Attributes:
        name: One line.
        equation: Formula of the exact value.
        source: Author, year and equation, or the principle it is derived from.
        kinds: Sensor kinds that compute the quantity, or `noise`, `geometry`.
        quantity: Name of the quantity.
        unit: Its unit; empty or "1" for none.
        label: Name of the abscissa.
        label_unit: Unit of the abscissa; empty if `at` are labels.
        at: Abscissa: numbers, or labels.
        is_log: Whether the abscissa is drawn logarithmically.
        exact: Known values.
        ours: The same computed by tgdsl.
        paper: The same by the paper's formula, if it differs.
        rtol: Tolerance relative to the exact value.
        atol: Absolute tolerance, added to it.
        series: Names of the curves, if there are several.
        defects: Numbers of the findings in `tgdsl.report.defects` that it answers.
    """

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
    paper: np.ndarray | None = None
    rtol: float = 0.0
    atol: float = 0.0
    series: tuple[str, ...] = ()
    defects: tuple[int, ...] = ()

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
        """The largest share of the tolerance that an error uses; up to 1 the comparison holds."""
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
    """A registered comparison with its arguments.

    Attributes:
        name: Name of the function, with its arguments.
        section: Section of the report.
        compute: Function without arguments.
        is_reported: Whether the report has a row of it; tests check all.
        is_slow: Whether its test is marked slow.
    """

    name: str
    section: str
    compute: Callable[[], Any]
    is_reported: bool
    is_slow: bool


CASES: list[Case] = []


def cases_of(section: str, function: Callable, each: Iterable, also: Iterable, slow: bool | Iterable = False) -> list[Case]:
    """Return the cases of a function: each row of the report, and what tests check in addition."""
    rows, more, slow_rows = (
        [own if isinstance(own, tuple) else (own,) for own in arguments]
        for arguments in (each, also, () if isinstance(slow, bool) else slow)
    )
    name, cases = f"{function.__module__.rpartition('.')[2]}.{function.__name__}", []
    for arguments in [*rows, *(own for own in more if own not in rows)]:
        words = ", ".join(str(getattr(own, "name", own)) for own in arguments if not callable(own))
        is_slow = slow is True or arguments in slow_rows
        cases.append(Case(f"{name}({words})", section, partial(function, *arguments), arguments in rows, is_slow))
    return cases


class _Number(float):
    """Formats `{x:mm}` and `{x:ms}` as thousandths with that unit."""

    def __format__(self, spec: str) -> str:
        return f"{1e3 * self:g} {spec}" if spec in ("mm", "ms") else super().__format__(spec)


def field(section: str, *kinds: str) -> Callable[..., Callable]:
    """Return `oracle` for a section of the report and the kinds that it is about."""
    return partial(oracle, section, kinds)


def oracle(
    section: str, kinds: tuple[str, ...], name: str, equation: str, source: str, quantity: str, over: str = "", *,
    at: Sequence | np.ndarray | None = None, is_log: bool = False, rtol: float = 0.0, atol: float = 0.0, of_peak: float = 0.0,
    series: Sequence[str] = (), defects: Sequence[int] = (), each: Iterable = ((),), also: Iterable = (), slow: bool | Iterable = False,
) -> Callable[[Callable], Callable[..., Comparison]]:  # fmt: skip
    """Register a function that returns `(exact, ours)`, `(exact, ours, paper)` or `Values`, and let it return a `Comparison`.

    Texts may contain the function's arguments in braces, as `str.format` has them; in float32 the name says so.

    Args:
        section: Section of the report.
        kinds: See `Comparison`; likewise `name`, `equation`, `source`, `rtol`, `series` and `defects`.
        name: One line.
        equation: Formula of the exact value.
        source: Where it is from.
        quantity: Quantity with its unit in brackets at the end.
        over: Abscissa with its unit in brackets at the end; without one `at` are labels.
        at: Values of the abscissa, or labels.
        is_log: Whether the abscissa is drawn logarithmically.
        rtol: Relative tolerance.
        atol: Absolute tolerance.
        of_peak: Tolerance relative to the largest magnitude of the exact values.
        series: Names of curves.
        defects: Findings that it answers.
        each: Arguments of each row of the report: tuples, or single arguments.
        also: Arguments that tests check in addition.
        slow: Whether tests are marked slow, or the arguments of those that are.
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
            columns = [part for part in values[:3] if part is not None]
            exact, ours, *paper = (np.array(part) for part in np.broadcast_arrays(*map(_column, columns)))
            places = values.at if at is None else at
            return Comparison(
                name=name.format(**known, **values.words) + (", float32" if torch.float32 in known.values() else ""),
                equation=equation.format(**known), source=source.format(**known), kinds=tuple(kinds), quantity=quantity, unit=unit, label=label,
                label_unit=label_unit,
                at=tuple(_column(places).tolist()) if label_unit else tuple(str(own).format(**known) for own in places),
                is_log=is_log, exact=exact, ours=ours, paper=paper[0] if paper else None,
                rtol=rtol if values.rtol is None else values.rtol,
                atol=of_peak * float(abs(exact).max()) or (atol if values.atol is None else values.atol),
                series=tuple(series), defects=tuple(defects),
            )  # fmt: skip

        compare.kinds, compare.defects = kinds, defects
        CASES.extend(cases_of(section, compare, each, also, slow))
        return compare

    return decorate


def _column(values: Any) -> np.ndarray:
    return np.atleast_1d(np.asarray(values, dtype=np.float64))


def _with_unit(text: str) -> tuple[str, str]:
    """Split "quantity [unit]"."""
    found = re.fullmatch(r"(.*) \[([^\[]*)\]", text)
    return (found[1], found[2]) if found else (text, "")
