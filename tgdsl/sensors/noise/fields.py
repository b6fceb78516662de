"""Field types of noise knobs: ranges, and amplitudes in the unit of the reading, which may differ between its quantities.

Any number may be a range `[low, high]`: each environment then draws its own at reset, uniformly. An amplitude may be a mapping
from quantities: `white_noise: {force: 5e-3, torque: 1e-4}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from tgdsl.fields.models import Range, RangeOf

Amplitude = Mapping[str, Range]
"""A range for each quantity of a reading, or under `ALL` for every one."""
ALL = "*"


class AmplitudeOf(RangeOf):
    """Marks a range that may also be a mapping from quantities to ranges."""

    def _read(self, found: object) -> Any:
        if not isinstance(found, Mapping):
            return {ALL: super()._read(found)}
        read = {}
        for name, part in found.items():
            try:
                read[str(name)] = super()._read(part)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        return read

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a range, or a mapping of ranges."""
        one = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [*one["anyOf"], {"type": "object", "additionalProperties": one}]}


class ProbabilityRange(RangeOf):
    """Marks a share from 0 to 1, or a range of it."""

    def __init__(self) -> None:
        super().__init__("number", ge=0.0)

    def _read(self, found: object) -> Any:
        low, high = super()._read(found)
        if high > 1:
            raise ValueError(f"{high:g} is out of range, expected at most 1")
        return low, high

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a number up to 1, or a list of two."""
        one = {"type": "number", "minimum": 0.0, "maximum": 1.0}
        return {"anyOf": [one, {"type": "array", "items": one, "minItems": 2, "maxItems": 2}]}


AnyAmplitude = Annotated[Amplitude, AmplitudeOf("number")]
NonNegativeAmplitude = Annotated[Amplitude, AmplitudeOf("number", ge=0.0)]
TimeRange = Annotated[Range, RangeOf("time", ge=0.0)]
Share = Annotated[Range, ProbabilityRange()]
ZERO: Range = (0.0, 0.0)
NO_AMPLITUDE: Amplitude = {ALL: ZERO}


def quantity(channel: str) -> str:
    """Return what a channel is a component of: `force` of `force_x`, else its own name; a distance is named by its object."""
    is_component = channel[-2:] in ("_x", "_y", "_z") and not channel.startswith("distance_")
    return channel[:-2] if is_component else channel


def range_of(value: Range | Amplitude, channel: str) -> Range:
    """Return a number's range for a channel; what an amplitude does not name is 0."""
    return value if isinstance(value, tuple) else value.get(quantity(channel), value.get(ALL, ZERO))
