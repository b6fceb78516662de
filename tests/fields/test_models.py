"""Positive quantities accept any value above zero, however small."""

import pytest
from pydantic import TypeAdapter, ValidationError

from tgdsl.fields.models import Angle, Area, Frequency, Positive, Pressure


@pytest.mark.parametrize("kind", [Area, Angle, Frequency, Pressure, Positive])
def test_positive_quantities_reject_zero_and_below(kind):
    adapter = TypeAdapter(kind)
    assert adapter.validate_python(1e-9) == 1e-9
    for value in (0, -1.0):
        with pytest.raises(ValidationError, match="is out of range, expected more than 0"):
            adapter.validate_python(value)
