"""Accuracies in documents."""

import re

import pytest
from pydantic import TypeAdapter, ValidationError

from tgdsl.fields.accuracy import EXPECTED, Accuracy, AccuracyField, Bound, parse_bound

ADAPTER = TypeAdapter(AccuracyField)


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [
        ("1%", 0.01, ""),
        (" .5 % ", 0.005, ""),
        ("1e-2 %", 1e-4, ""),
        (0.02, 0.02, ""),
        ("0.02", 0.02, ""),
        ("0.02 mm", 2e-5, "m"),
        ("5 mN", 5e-3, "N"),
        ("2 N*mm", 2e-3, "N·m"),
        ("3 kPa", 3e3, "Pa"),
        ("0.5 K", 0.5, "degC"),
        ("0.5 degC", 0.5, "degC"),
    ],
)
def test_bounds_are_in_the_unit_of_readings(text, value, unit):
    bound = parse_bound(text)
    assert bound.value == pytest.approx(value, rel=1e-12) and bound.unit == unit


@pytest.mark.parametrize("wrong", ["0 %", "-1 %", "100 %", 1, 0, -0.1, "-2 mm", "0 mm"])
def test_a_bound_is_above_zero_and_a_fraction_below_one(wrong):
    with pytest.raises(ValueError, match=r"is out of range|is no accuracy"):
        parse_bound(wrong)


@pytest.mark.parametrize("wrong", ["5 furlongs", "1 kg", "much", True, None, [1]])
def test_wrong_accuracies_name_the_units(wrong):
    with pytest.raises(ValueError, match=re.escape(EXPECTED)):
        parse_bound(wrong)


def test_each_quantity_has_its_bound():
    accuracy = ADAPTER.validate_python({"force": "5 mN", "torque": "1 %"})
    assert accuracy == Accuracy((("force", Bound(5e-3, "N", "5 mN")), ("torque", Bound(0.01, "", "1 %"))))
    assert accuracy.of("torque").value == 0.01 and accuracy.of("depth") is None and str(accuracy) == "force 5 mN, torque 1 %"
    assert ADAPTER.validate_python("1 %").of("anything").value == 0.01
    assert ADAPTER.validate_python(None) is None
    with pytest.raises(ValidationError, match="found a mapping of 0"):
        ADAPTER.validate_python({})


def test_the_schema_has_the_bounds_of_numbers_and_of_a_mapping():
    number, _, each, null = ADAPTER.json_schema()["anyOf"]
    assert number == {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 1}
    assert (each["type"], each["minProperties"], null) == ("object", 1, {"type": "null"})
    assert each["additionalProperties"]["anyOf"][0] == number


def test_the_schema_accepts_what_the_parser_reads():
    patterns = [option["pattern"] for option in ADAPTER.json_schema()["anyOf"] if option.get("type") == "string"]
    for text in ("1%", ".5 %", "0.02 mm", "2 N*mm", "0.5 K"):
        assert re.search(patterns[0], text)
    for text in ("5 furlongs", "1 kg", "% 1"):
        assert not re.search(patterns[0], text)
