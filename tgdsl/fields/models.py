"""Field types shared by every part of the document: quantities, vectors, selections, and the base of all models."""

from __future__ import annotations

import math
import re
from copy import copy
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    StrictBool,
    StrictInt,
    Tag,
    WithJsonSchema,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from tgdsl.fields import units

M = TypeVar("M", bound="SpecModel")


class SpecModel(BaseModel):
    """Base of all document models: frozen, unknown keys forbidden, field docstrings become the schema's descriptions."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _note_model(cls, value: object, info: Any) -> object:
        if isinstance(info.context, dict):
            info.context[id(value)] = cls
        return value


def with_defaults(base: type[M], **defaults: Any) -> type[M]:
    """Return a subclass of a model in which fields have other defaults; all else of them stays."""
    fields: dict[str, Any] = {}
    for name, default in defaults.items():
        field = copy(base.model_fields[name])
        field.default = default
        fields[name] = (field.annotation, field)
    return create_model(base.__name__, __base__=base, __module__=base.__module__, __doc__=base.__doc__, **fields)


PATTERN = r"^\s*[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?\s*(%s)?\s*$"
"""A number and one of some units, as a pattern of JSON Schema."""


@dataclass(frozen=True)
class Quantity:
    """Marks a float that may also be written with a unit, bounded in SI units."""

    dimension: str | units.Dimension  # a key of `units.UNITS`, or your own `units.Dimension`
    ge: float | None = None  # least value
    gt: float | None = None  # bound that the value must exceed
    le: float | None = None  # largest value

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Read a number or a string, then look at the bounds."""
        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a number, or a string that ends in a unit."""
        number: dict[str, Any] = {"type": "number"}
        if self.gt is not None:
            number["exclusiveMinimum"] = self.gt
        if self.ge is not None:
            number["minimum"] = self.ge
        if self.le is not None:
            number["maximum"] = self.le
        names = "|".join(re.sub(r"([*()])", r"\\\1", name) for name in units.units_of(self.dimension))
        return {"anyOf": [number, {"type": "string", "pattern": PATTERN % names}]} if names else number

    def _read(self, found: object) -> float:
        value = units.parse(found, self.dimension)
        if self.gt is not None and not value > self.gt:
            raise ValueError(f"{value:g} is out of range, expected more than {self.gt:g}")
        if self.ge is not None and not value >= self.ge:
            raise ValueError(f"{value:g} is out of range, expected at least {self.ge:g}")
        if self.le is not None and not value <= self.le:
            raise ValueError(f"{value:g} is out of range, expected at most {self.le:g}")
        return value


Range = tuple[float, float]  # lowest and highest value; the same for a plain number


class RangeOf(Quantity):
    """Marks a quantity that may also be a range, `[low, high]`; with `least` and `most` as the bounds of both."""

    def _read(self, found: object) -> Any:
        parts = found if isinstance(found, (list, tuple)) else [found, found]
        if len(parts) != 2:
            raise ValueError(f"found a list of {len(parts)}, expected a number or [low, high]")
        low, high = (super(RangeOf, self)._read(part) for part in parts)
        if low > high:
            raise ValueError(f"[{low:g}, {high:g}] is not ordered, expected [low, high]")
        return low, high

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a quantity, or a list of two."""
        one = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [one, {"type": "array", "items": one, "minItems": 2, "maxItems": 2}]}


@dataclass(frozen=True)
class Usual:
    """Marks a field whose value, beyond these bounds, was most likely meant in another unit, and triggers a warning."""

    dimension: str | units.Dimension  # a key of `units.UNITS`, or your own `units.Dimension`
    low: float = 0.0  # least usual magnitude, in SI units; 0 is usual too
    high: float = math.inf  # largest usual magnitude

    def doubt(self, value: float) -> tuple[str, str] | None:
        """Return the reason why a value is unusual, and a hint; None for a usual value."""
        return units.doubt(value, self.dimension, self.low, self.high)


Text = Annotated[str, Tag("text")]
TEXT_OR_OTHER = Discriminator(lambda value: "text" if isinstance(value, str) else "other")
"""Distinguishes `Text` from a type tagged "other" by the value's type, so that errors mention only one of them."""

Length = Annotated[float, Quantity("length")]
PositiveLength = Annotated[float, Quantity("length", gt=0.0)]
Radius = Annotated[float, Quantity("length", ge=0.0)]
Area = Annotated[float, Quantity("area", gt=0.0)]
Angle = Annotated[float, Quantity("angle", gt=0.0)]
Frequency = Annotated[float, Quantity("frequency", gt=0.0)]
Pressure = Annotated[float, Quantity("pressure", gt=0.0)]
Temperature = Annotated[float, Quantity("temperature", ge=units.ZEROS["K"])]  # [°C], from absolute zero on
Number = Annotated[float, Quantity("number")]
NonNegative = Annotated[float, Quantity("number", ge=0.0)]
Positive = Annotated[float, Quantity("number", gt=0.0)]
Position = tuple[Length, Length, Length]


def _not_zero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise ValueError("[0, 0, 0] has no direction, expected a vector of non-zero length")
    return vector


Direction = Annotated[tuple[Number, Number, Number], AfterValidator(_not_zero)]


class Selection(SpecModel):
    """Names to take: shell wildcards or group names; what `exclude` matches is left out."""

    include: Annotated[tuple[str, ...], Field(min_length=1)]
    """Names, shell wildcards (`*_link2`) or group names; at least one must match."""
    exclude: tuple[str, ...] = ()
    """Names, wildcards or groups to leave out again."""


def _as_selection(value: object) -> object:
    if isinstance(value, str):
        return {"include": (value,)}
    if isinstance(value, (list, tuple)):
        return {"include": value}
    if not isinstance(value, (dict, Selection)):
        raise ValueError("not a selection, expected a name, a list of names, or {include: [...], exclude: [...]}")
    return value


_NAMES = {"type": "array", "items": {"type": "string"}}
Selector = Annotated[
    Selection,
    BeforeValidator(_as_selection),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string"},
                {**_NAMES, "minItems": 1},
                {
                    "type": "object",
                    "properties": {"include": {**_NAMES, "minItems": 1}, "exclude": _NAMES},
                    "required": ["include"],
                    "additionalProperties": False,
                },
            ],
            "description": "A name, group or shell wildcard, a list of them, or {include: [...], exclude: [...]}.",
        }
    ),
]
"""What a user may write for a selection: `hand`, `[tips, "*_link1"]` or `{include: [...], exclude: [...]}`."""


class HistorySpec(SpecModel):
    """A window over the last calls' readings."""

    length: Annotated[StrictInt, Field(ge=1), Usual("number", high=1000.0)]
    """Number of calls in the window, this one included; after a reset the first call fills the window."""
    reduce: Literal["stack", "last", "median", "mean"] = "stack"
    """`stack`: all of them, oldest first, along a further dimension; otherwise one reading computed from them."""
    view: StrictBool = False
    """Whether a stack is returned as a view of the module's memory, which the next call overwrites and which carries no
    gradient; default: a copy."""

    @model_validator(mode="after")
    def _is_used(self) -> HistorySpec:
        if self.view and self.reduce != "stack":
            raise ValueError("`view` has no effect without `reduce: stack`, expected it to be left out")
        return self


History = Annotated[
    HistorySpec,
    BeforeValidator(lambda found: {"length": found} if isinstance(found, int) else found),
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 1}, HistorySpec.model_json_schema()]}),
]
