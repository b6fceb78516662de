"""Types of knobs: a number or a range `[low, high]`, and an amplitude in the unit of the reading.

An amplitude may be a mapping from quantities: `white_noise: {force: 5e-3, torque: 1e-4}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from tgdsl.fields.models import Range, RangeOf

Amplitude = Mapping[str, Range]  # a range for each quantity of a reading, or under `ALL` for every one
ALL = "*"


class AmplitudeOf(RangeOf):
    """Marks a range that may also be a mapping from quantities to ranges."""

    def _read(self, found: object) -> Any:
        if not isinstance(found, Mapping):
            return {ALL: super()._read(found)}
        ranges = {}
        for name, part in found.items():
            try:
                ranges[str(name)] = super()._read(part)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        return ranges

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a range, or a mapping of ranges."""
        one = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [*one["anyOf"], {"type": "object", "additionalProperties": one}]}


AnyAmplitude = Annotated[Amplitude, AmplitudeOf("number")]
NonNegativeAmplitude = Annotated[Amplitude, AmplitudeOf("number", ge=0.0)]
Factor = Annotated[Range, RangeOf("number", gt=0.0)]
LengthRange = Annotated[Range, RangeOf("length", ge=0.0)]
TimeRange = Annotated[Range, RangeOf("time", ge=0.0)]
Share = Annotated[Range, RangeOf("number", ge=0.0, le=1.0)]
ZERO: Range = (0.0, 0.0)
NO_AMPLITUDE: Amplitude = {ALL: ZERO}


def quantity(channel: str) -> str:
    """Return a channel's quantity: `force` for `force_x`, else its own name; a distance is named by its object."""
    is_component = channel[-2:] in ("_x", "_y", "_z") and not channel.startswith("distance_")
    return channel[:-2] if is_component else channel


def range_of(value: Range | Amplitude, channel: str) -> Range:
    """Return a number's range for a channel; 0 of quantities that an amplitude lacks."""
    return value if isinstance(value, tuple) else value.get(quantity(channel), value.get(ALL, ZERO))
