"""Quantities with units, read once at the door: inside tgdsl everything is SI and radians."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "area": {"m2": 1.0, "cm2": 1e-4, "mm2": 1e-6},
    "density": {"/m2": 1.0, "/cm2": 1e4, "/mm2": 1e6},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "force": {"N": 1.0, "mN": 1e-3},
    "torque": {"N*m": 1.0, "N*mm": 1e-3, "mN*m": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "frequency": {"Hz": 1.0, "kHz": 1e3},
    "mass": {"kg": 1.0, "g": 1e-3},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "temperature": {"degC": 1.0, "K": 1.0},
    "power": {"W": 1.0, "mW": 1e-3},
    "heat_flux": {"W/m2": 1.0, "kW/m2": 1e3, "W/cm2": 1e4},
    "heat_transfer": {"W/(m2*K)": 1.0},
    "conductivity": {"W/(m*K)": 1.0},
    "specific_heat": {"J/(kg*K)": 1.0, "kJ/(kg*K)": 1e3, "J/(g*K)": 1e3},
    "mass_density": {"kg/m3": 1.0, "g/cm3": 1e3},
    "number": {},
}
"""Factor to SI of every unit, by dimension; the first of a dimension is the unit inside tgdsl: SI, but of temperatures degC."""
ZEROS: dict[str, float] = {"K": -273.15}
"""Zero of a unit's scale, in the first unit of its dimension; it is 0 for all other units."""


@dataclass(frozen=True, eq=False)
class Dimension:
    """A dimension that `UNITS` lacks, for your own kinds of sensors and tasks."""

    name: str  # its name in messages
    units: Mapping[str, float]  # factor to SI of each of its units; the first is tgdsl's internal unit, with a factor of 1

    def __post_init__(self) -> None:
        """Raise `ValueError` if the first unit's factor is not 1, or a unit cannot be written after a number."""
        if not self.units or next(iter(self.units.values())) != 1.0:
            raise ValueError(f"the units of {self.name}: found {dict(self.units)}, expected one with the factor 1 first")
        for unit, factor in self.units.items():
            if unit_of(f"1 {unit}") != unit or not 0 < factor < math.inf:
                raise ValueError(f'the units of {self.name}: found "{unit}": {factor}, expected a word and a factor above 0')


def units_of(dimension: str | Dimension) -> Mapping[str, float]:
    """Return the factor to SI of every unit of a dimension: a key of `UNITS`, or your own `Dimension`."""
    return dimension.units if isinstance(dimension, Dimension) else UNITS[dimension]


_QUANTITY = re.compile(r"\s*+([-+]?(?:[0-9]++\.?[0-9]*+|\.[0-9]++)(?:[eE][-+]?[0-9]++)?)\s*+([A-Za-zµ/][\w*/µ()]*+)?\s*+\Z")
"""A number and a unit; possessive quantifiers avoid backtracking on long texts."""

_SPELLINGS = str.maketrans({"^": "", "²": "2", "³": "3", "°": "deg", "·": "*", "⋅": "*", "×": "*", "μ": "µ"})
"""Other spellings of units, and tgdsl's."""


def parse(value: object, dimension: str | Dimension) -> float:
    """Return a quantity in SI units, a temperature in °C: of a number, taken as SI or °C, or a string such as `"4 mm"`.

    Raises:
        ValueError: If the value is no finite number, or its unit is not one of the dimension.
    """
    factors = units_of(dimension)
    example = next((unit for unit in reversed(list(factors)) if unit not in ZEROS), "")
    expected = f'a number in {next(iter(factors))} or a string such as "4 {example}"' if factors else "a number"
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{value!r} is not a quantity, expected {expected}")
    if isinstance(value, str):
        plain = value.translate(_SPELLINGS)
        if plain != value and (match := _QUANTITY.match(plain)) and match[2] in factors:
            raise ValueError(f'"{value}" is not a quantity; did you mean "{plain.strip()}"?')
        match = _QUANTITY.match(value)
        if match and match[2] and not factors:
            raise ValueError(f'"{value}" has a unit, {_without_unit(float(match[1]), match[2])}')
        if not match:
            raise ValueError(f'"{value}" is not a quantity, expected {expected}')
        if match[2] and match[2] not in factors:
            name = dimension.name if isinstance(dimension, Dimension) else dimension
            raise ValueError(f'"{match[2]}" is not a unit of {name}, expected one of {", ".join(factors)}')
        value = float(match[1]) * factors.get(match[2] or "", 1.0) + ZEROS.get(match[2] or "", 0.0)
    try:
        value = float(value)
    except OverflowError:  # a whole number of more than 308 digits
        value = math.inf
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite, expected {expected}")
    return value


def unit_of(value: str) -> str:
    """Return the unit after a number in a text; empty if there is none, or the text is no quantity."""
    match = _QUANTITY.match(value)
    return (match[2] or "") if match else ""


def dimension_of(value: str, dimensions: Sequence[str]) -> str | None:
    """Return the dimension, among some, of the unit in a text such as "4 mm"; None if it has none of them."""
    unit = unit_of(value.translate(_SPELLINGS))
    return next((dimension for dimension in dimensions if unit in UNITS[dimension]), None)


def _without_unit(number: float, unit: str) -> str:
    """Return the expected plain number for a number with a unit: in SI, if the unit is known."""
    factors = next((factors for factors in UNITS.values() if unit in factors), None)
    if factors is None:
        return "expected a plain number"
    return f"expected a plain number: {number * factors[unit] + ZEROS.get(unit, 0.0):g}, if {next(iter(factors))} is meant"


def doubt(value: float, dimension: str | Dimension, low: float, high: float) -> tuple[str, str] | None:
    """Return why a quantity [SI] was most likely meant in another unit, and which; None for usual magnitudes and 0."""
    if value == 0 or low <= abs(value) <= high:
        return None
    factors = units_of(dimension)
    si = f" {next(iter(factors))}" if factors else ""
    bound = f"usually at least {low:g}{si}" if abs(value) < low else f"usually at most {high:g}{si}"
    scales = {(factor, ZEROS.get(unit, 0.0)): unit for unit, factor in factors.items()}
    units = {scale: unit for scale, unit in scales.items() if low <= abs(value * scale[0] + scale[1]) <= high}
    meant = " or ".join(f'"{value:g} {unit}"' for unit in units.values())
    return f"found {value:g}{si}, {bound}", f"was {meant} meant?" if meant else ""
