"""How far off a sensor's reading may be: a fraction of its largest change, or an amount in the reading's unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from pydantic_core import CoreSchema, core_schema

from tgdsl.fields import units
from tgdsl.fields.models import PATTERN

DIMENSIONS = ("length", "force", "torque", "pressure", "temperature")  # dimensions of readings
EXPECTED = 'a fraction such as "1 %", or an amount such as "0.02 mm"'
_PERCENT = re.compile(r"\s*+([0-9]++\.?[0-9]*+|\.[0-9]++)([eE][-+]?[0-9]++)?\s*+%\s*+\Z")


class Bound(NamedTuple):
    """Largest accepted error."""

    value: float  # the bound, in the unit
    unit: str  # unit of its channels, `N·m`; empty: a fraction of the largest change
    text: str  # the bound as written in a document


@dataclass(frozen=True)
class Accuracy:
    """Bounds of a reading's errors."""

    bounds: tuple[tuple[str, Bound], ...]  # the bound of each quantity, `force` for `force_x`; the empty name: of all

    def of(self, quantity: str) -> Bound | None:
        """Return the bound of a quantity."""
        bounds = dict(self.bounds)
        return bounds.get(quantity, bounds.get(""))

    def __str__(self) -> str:
        return ", ".join(f"{name} {bound.text}".strip() for name, bound in self.bounds)


def parse_bound(value: object) -> Bound:
    """Return a bound in the unit that readings have, of a number or text as `EXPECTED` says. Temperatures are differences.

    Raises:
        ValueError: If it is none, not positive, or a fraction of 1 or more.
    """
    text = str(value)
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{value!r} is no accuracy, expected {EXPECTED}")
    if isinstance(value, str) and _PERCENT.match(value):
        bound = Bound(float(value.strip().rstrip("%")) / 100.0, "", text)
    elif isinstance(value, str) and (dimension := units.dimension_of(value, DIMENSIONS)):
        unit = next(iter(units.UNITS[dimension])).replace("*", "·")
        bound = Bound(units.parse(value, dimension) - units.parse(f"0 {units.unit_of(value)}", dimension), unit, text)
    else:
        try:
            number = units.parse(value, "number")
        except ValueError:
            unit_names = ", ".join(unit for dimension in DIMENSIONS for unit in units.UNITS[dimension])
            raise ValueError(f'"{value}" is no accuracy, expected {EXPECTED}; units: %, {unit_names}') from None
        bound = Bound(number, "", f"{100 * number:g} %")
    if not bound.value > 0 or (not bound.unit and bound.value >= 1):
        raise ValueError(f"{text} is out of range, expected {EXPECTED}, more than 0 and less than 100 %")
    return bound


class AccuracyOf:
    """Marks an `Accuracy` in a document: a bound, or a mapping from quantities to bounds."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Read a bound or a mapping."""
        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a number, a text that ends in a unit, or a mapping of them."""
        names = [re.sub(r"([*()])", r"\\\1", unit) for dimension in DIMENSIONS for unit in units.UNITS[dimension]]
        fraction = {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 1}
        one = {"anyOf": [fraction, {"type": "string", "pattern": PATTERN % "|".join(["%", *names])}]}
        each = {"type": "object", "additionalProperties": one, "minProperties": 1}
        return {"anyOf": [*one["anyOf"], each, {"type": "null"}]}

    def _read(self, found: object) -> Accuracy | None:
        if found is None or isinstance(found, Accuracy):
            return found
        if not isinstance(found, Mapping):
            return Accuracy((("", parse_bound(found)),))
        if not found:
            raise ValueError(
                f"found a mapping of 0, expected {EXPECTED}, or one of each quantity: {{force: 5 mN, torque: 1 %}}"
            )
        return Accuracy(tuple((str(name), parse_bound(value)) for name, value in found.items()))


AccuracyField = Annotated[Accuracy | None, AccuracyOf()]
