"""Quantities against powers of ten and arbitrary text."""

import math
import re
from typing import Annotated

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from tgdsl.fields import units
from tgdsl.fields.models import Quantity, RangeOf, SpecModel, Usual
from tgdsl.fields.units import Dimension, doubt

RTOL = 4e-16  # one product in float64: two roundings of at most 2⁻⁵³

DIMENSIONS = sorted(units.UNITS)


@given(st.floats(min_value=-1e150, max_value=1e150))
def test_millimetres_are_thousandths(x):
    assert math.isclose(units.parse(f"{x} mm", "length"), x * 1e-3, rel_tol=RTOL, abs_tol=5e-324)


PREFIXES = {"G": 9, "M": 6, "k": 3, "c": -2, "m": -3, "u": -6, "µ": -6}
SYMBOLS = {"m": 0, "g": -3, "s": 0, "N": 0, "Pa": 0, "Hz": 0, "W": 0, "J": 0, "K": 0, "rad": 0}
"""Powers of ten from symbols to SI units; only the gram is not coherent."""


def si_factor(unit):
    """Return a unit's factor to SI by the rules of SI: prefixes, products, quotients and powers of symbols."""
    exponent, sign = 0, 1
    for separator, symbol, power in re.findall(r"([/*]?)\(?([A-Za-zµ]+)(\d?)\)?", unit):
        sign = -1 if separator == "/" or (sign == -1 and "(" in unit) else 1
        prefix, base = (0, symbol) if symbol in SYMBOLS else (PREFIXES[symbol[0]], symbol[1:])
        exponent += sign * (prefix + SYMBOLS[base]) * int(power or 1)
    return float(f"1e{exponent}")


def test_every_unit_has_its_si_factor():
    assert si_factor("kW/m2") == 1e3 and si_factor("/cm2") == 1e4 and si_factor("kJ/(kg*K)") == 1e3 == si_factor("J/(g*K)")
    for dimension, symbols in units.UNITS.items():
        for unit in symbols:
            factor, zero = {"deg": (math.pi / 180, 0.0), "degC": (1.0, 0.0), "K": (1.0, -273.15)}.get(unit) or (
                si_factor(unit),
                0.0,
            )
            for text in (f"2.5{unit}", f"+2.5 {unit}", f"  25e-1  {unit} "):
                assert units.parse(text, dimension) == pytest.approx(2.5 * factor + zero, rel=RTOL), (dimension, unit)


def test_units_agree_with_each_other():
    assert units.parse("180 deg", "angle") == math.pi
    assert units.parse("1 cm2", "area") == pytest.approx(units.parse("1 cm", "length") ** 2, rel=RTOL)
    assert units.parse("1 N*mm", "torque") == units.parse("1 mN*m", "torque") == 1e-3
    assert units.parse("1 µm", "length") == units.parse("1 um", "length") == 1e-6
    assert units.parse("1 g/cm3", "mass_density") == 1e3 == pytest.approx(units.parse("1 g", "mass") / 1e-2**3, rel=RTOL)
    assert units.parse("1 J/(g*K)", "specific_heat") == units.parse("1 kJ/(kg*K)", "specific_heat") == 1e3
    assert units.parse("1 W/cm2", "heat_flux") == pytest.approx(1 / units.parse("1 cm2", "area"), rel=RTOL)


def test_kelvin_has_another_zero():
    assert (
        units.parse("0 degC", "temperature") == units.parse("273.15 K", "temperature") == units.parse(0, "temperature") == 0.0
    )
    assert units.parse("318.15 K", "temperature") == pytest.approx(45.0, abs=1e-12)
    assert units.parse("-40 degC", "temperature") == -40.0


@pytest.mark.parametrize(
    ("value", "dimension", "meant"),
    [
        ("45 °C", "temperature", "45 degC"),
        ("60°", "angle", "60deg"),
        ("15 W/(m·K)", "conductivity", "15 W/(m*K)"),
        ("5 W/m²", "heat_flux", "5 W/m2"),
        ("5 W/(m²·K)", "heat_transfer", "5 W/(m2*K)"),
        ("1 kg/m³", "mass_density", "1 kg/m3"),
        ("1 g/cm^3", "mass_density", "1 g/cm3"),
        ("4 J/(kg⋅K)", "specific_heat", "4 J/(kg*K)"),
    ],
)
def test_other_spellings_suggest_the_known_one(value, dimension, meant):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        units.parse(value, dimension)
    assert str(caught.value) == f'"{value}" is not a quantity; did you mean "{meant}"?'
    units.parse(meant, dimension)


def test_a_kelvin_value_without_its_unit_is_doubted():
    assert units.doubt(318.15, "temperature", 0.0, 250.0) == (
        "found 318.15 degC, usually at most 250 degC",
        'was "318.15 K" meant?',
    )
    assert units.doubt(-40.0, "temperature", 0.0, 250.0) is None


@pytest.mark.parametrize("value", [2, 2.0, "2", "2.", "+2", "0.2e1", ".2e+1", "20E-1"])
def test_a_bare_number_is_si(value):
    length = units.parse(value, "length")
    assert length == 2.0
    assert isinstance(length, float)


@pytest.mark.parametrize(
    ("value", "dimension", "message"),
    [
        ("4 mn", "length", '"mn" is not a unit of length, expected one of m, cm, mm, um, µm'),
        ("4 MM", "length", '"MM" is not a unit of length, expected one of m, cm, mm, um, µm'),
        ("4 m", "area", '"m" is not a unit of area, expected one of m2, cm2, mm2'),
        ("4 mm 5", "length", '"4 mm 5" is not a quantity, expected a number in m or a string such as "4 µm"'),
        ("", "angle", '"" is not a quantity, expected a number in rad or a string such as "4 deg"'),
        ("four", "force", '"four" is not a quantity, expected a number in N or a string such as "4 mN"'),
        ("٤ mm", "length", '"٤ mm" is not a quantity, expected a number in m or a string such as "4 µm"'),
        ("4 degF", "temperature", '"degF" is not a unit of temperature, expected one of degC, K'),
        ("hot", "temperature", '"hot" is not a quantity, expected a number in degC or a string such as "4 degC"'),
        ("4 W/m/K", "conductivity", '"W/m/K" is not a unit of conductivity, expected one of W/(m*K)'),
        ("4 W/(m*K", "conductivity", '"W/(m*K" is not a unit of conductivity, expected one of W/(m*K)'),
        ("4 m", "number", '"4 m" has a unit, expected a plain number: 4, if m is meant'),
        (True, "number", "True is not a quantity, expected a number"),
        ([1], "time", '[1] is not a quantity, expected a number in s or a string such as "4 µs"'),
        (math.inf, "number", "inf is not finite, expected a number"),
        (math.nan, "number", "nan is not finite, expected a number"),
        ("1e999", "number", "inf is not finite, expected a number"),
        (10**400, "number", "inf is not finite, expected a number"),
    ],
)
def test_malformed_quantities_are_errors(value, dimension, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        units.parse(value, dimension)
    assert str(caught.value) == message


@given(
    st.one_of(st.text(), st.from_regex(units._QUANTITY), st.none(), st.booleans(), st.integers(), st.floats()),
    st.sampled_from(DIMENSIONS),
)
@settings(max_examples=30)
def test_anything_is_a_finite_float_or_a_value_error(value, dimension):
    try:
        number = units.parse(value, dimension)
    except ValueError:
        return
    assert isinstance(number, float)
    assert math.isfinite(number)


CAPACITANCE = Dimension("capacitance", {"F": 1.0, "nF": 1e-9, "pF": 1e-12})


class Plate(SpecModel):
    own: Annotated[float, Quantity(CAPACITANCE, gt=0.0), Usual(CAPACITANCE, high=1e-6)]


@pytest.mark.parametrize(("written", "value"), [("4.7 pF", 4.7e-12), ("2nF", 2e-9), (3e-12, 3e-12), ("1e-3 nF", 1e-12)])
def test_a_custom_dimension_is_parsed(written, value):
    assert Plate(own=written).own == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("4 mm", '"mm" is not a unit of capacitance, expected one of F, nF, pF'),
        ("much", 'expected a number in F or a string such as "4 pF"'),
        ("-1 pF", "-1e-12 is out of range, expected more than 0"),
    ],
)
def test_errors_of_a_custom_dimension_name_the_problem(written, message):
    with pytest.raises(ValidationError, match=re.escape(message)):
        Plate(own=written)


def test_schema_and_doubt_use_the_custom_units():
    pattern = Plate.model_json_schema()["properties"]["own"]["anyOf"][1]["pattern"]
    assert [bool(re.search(pattern, text)) for text in ("4.7 pF", "1e-9F", "4 mm")] == [True, True, False]
    assert doubt(10.0, CAPACITANCE, 0.0, 1e-6) == ("found 10 F, usually at most 1e-06 F", 'was "10 nF" or "10 pF" meant?')


@pytest.mark.parametrize("units", [{}, {"pF": 1e-12, "F": 1.0}, {"F": 1.0, "p F": 1e-12}, {"F": 1.0, "pF": 0.0}])
def test_invalid_units_of_a_dimension_are_refused(units):
    with pytest.raises(ValueError, match="the units of capacitance: found"):
        Dimension("capacitance", units)


Span = TypeAdapter(Annotated[tuple[float, float], RangeOf("time", ge=0.0, le=2.0)])


def test_a_range_is_a_number_or_an_ordered_pair():
    assert Span.validate_python("5 ms") == (5e-3, 5e-3)
    assert Span.validate_python([0, "20 ms"]) == (0.0, 0.02)
    assert Span.validate_python([1.0, 1.0]) == (1.0, 1.0)
    for wrong, message in (
        ([2, 1], r"\[2, 1\] is not ordered"),
        ([1], "found a list of 1"),
        ([0, 1, 2], "found a list of 3"),
        ([0, 3], "3 is out of range, expected at most 2"),
        (-1, "-1 is out of range, expected at least 0"),
    ):
        with pytest.raises(ValidationError, match=message):
            Span.validate_python(wrong)


def test_the_schema_of_a_range_is_a_quantity_or_a_pair():
    one, two = Span.json_schema()["anyOf"]
    assert one["anyOf"][0] == {"type": "number", "minimum": 0.0, "maximum": 2.0}
    assert two == {"type": "array", "items": one, "minItems": 2, "maxItems": 2}


@pytest.mark.parametrize(
    "text", ["1" * 10**6 + "!", "1" + " " * 10**6 + "!", "1." + "1" * 10**6 + "!", "1 " + "m*" * 10**6 + "!"]
)
def test_parsing_takes_linear_time(text):
    """A pattern that tries every split of a run of digits would take days."""
    with pytest.raises(ValueError, match="is not a quantity"):
        units.parse(text, "length")


@pytest.mark.parametrize("text", ["4 mm", "4mm", " -4.e-3 m ", "+.004", "4e-3m", "4E-3"])
def test_one_length_has_many_spellings(text):
    assert abs(units.parse(text, "length")) == pytest.approx(0.004, rel=np.finfo(float).eps)
