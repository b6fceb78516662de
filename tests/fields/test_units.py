"""Quantities against powers of ten, and arbitrary text."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tgdsl.fields import units

RTOL = 4e-16  # one product in float64: two roundings of at most 2⁻⁵³

DIMENSIONS = sorted(units.UNITS)


@given(st.floats(min_value=-1e150, max_value=1e150))
def test_millimetres_are_thousandths(x):
    assert math.isclose(units.parse(f"{x} mm", "length"), x * 1e-3, rel_tol=RTOL, abs_tol=5e-324)


@pytest.mark.parametrize(("dimension", "unit"), [(d, u) for d, known in units.UNITS.items() for u in known])
def test_every_unit_has_its_factor(dimension, unit):
    for text in (f"2.5{unit}", f"+2.5 {unit}", f"  25e-1  {unit} "):
        assert units.parse(text, dimension) == 2.5 * units.UNITS[dimension][unit]


def test_units_agree_with_each_other():
    assert units.parse("180 deg", "angle") == math.pi
    assert units.parse("1 cm2", "area") == pytest.approx(units.parse("1 cm", "length") ** 2, rel=RTOL)
    assert units.parse("1 N*mm", "torque") == units.parse("1 mN*m", "torque") == 1e-3
    assert units.parse("1 µm", "length") == units.parse("1 um", "length") == 1e-6


@pytest.mark.parametrize("value", [2, 2.0, "2", "2.", "+2", "0.2e1", ".2e+1", "20E-1"])
def test_a_bare_number_is_si(value):
    found = units.parse(value, "length")
    assert found == 2.0
    assert isinstance(found, float)


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
        ("4 m", "number", '"4 m" is not a quantity, expected a number'),
        (True, "number", "True is not a quantity, expected a number"),
        ([1], "time", '[1] is not a quantity, expected a number in s or a string such as "4 µs"'),
        (math.inf, "number", "inf is not finite, expected a number"),
        (math.nan, "number", "nan is not finite, expected a number"),
        ("1e999", "number", "inf is not finite, expected a number"),
        (10**400, "number", "inf is not finite, expected a number"),
    ],
)
def test_what_is_no_quantity(value, dimension, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        units.parse(value, dimension)
    assert str(caught.value) == message


@given(
    st.one_of(st.text(), st.from_regex(units._QUANTITY), st.none(), st.booleans(), st.integers(), st.floats()),
    st.sampled_from(DIMENSIONS),
)
def test_anything_is_a_finite_float_or_a_value_error(value, dimension):
    try:
        found = units.parse(value, dimension)
    except ValueError:
        return
    assert isinstance(found, float)
    assert math.isfinite(found)
