"""Field types shared by every part of the document: quantities, vectors, selections, and the base of all models."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    WithJsonSchema,
    model_validator,
)

from tgdsl import units


class SpecModel(BaseModel):
    """Base of all document models: frozen, unknown keys forbidden, field docstrings become the schema's descriptions."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _note_model(cls, value: object, info: Any) -> object:
        """Note which model a mapping was read as, so that an error can name the keys that it knows."""
        if isinstance(info.context, dict):
            info.context[id(value)] = cls
        return value


def quantity(dimension: str, ge: float | None = None, gt: float | None = None) -> Any:
    """Return a float type that also takes a string with a unit of `dimension`, bounded in SI units."""

    def check(value: float) -> float:
        if gt is not None and not value > gt:
            raise ValueError(f"{value:g} is out of range, expected more than {gt:g}")
        if ge is not None and not value >= ge:
            raise ValueError(f"{value:g} is out of range, expected at least {ge:g}")
        return value

    names = list(units.UNITS[dimension])
    pattern = r"^\s*[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?\s*(" + "|".join(map(_escape, names)) + r")?\s*$"
    number: dict[str, Any] = {"type": "number"}
    if gt is not None:
        number["exclusiveMinimum"] = gt
    if ge is not None:
        number["minimum"] = ge
    schema: dict[str, Any] = {"anyOf": [number, {"type": "string", "pattern": pattern}]} if names else number
    return Annotated[
        float,
        BeforeValidator(lambda value: units.parse(value, dimension)),
        AfterValidator(check),
        WithJsonSchema(schema),
    ]


def text_or(other: Any) -> Any:
    """Return the union of a string and another type, told apart by what is found, so that errors speak of one of them."""
    return Annotated[
        Annotated[str, Tag("text")] | Annotated[other, Tag("other")],
        Discriminator(lambda value: "text" if isinstance(value, str) else "other"),
    ]


def _escape(unit: str) -> str:
    return unit.replace("*", r"\*")


Length = quantity("length")
PositiveLength = quantity("length", gt=0.0)
Radius = quantity("length", ge=0.0)
Area = quantity("area", gt=0.0)
Angle = quantity("angle", gt=0.0)
Time = quantity("time", ge=0.0)
Number = quantity("number")
NonNegative = quantity("number", ge=0.0)
Positive = quantity("number", gt=0.0)
Position = tuple[Length, Length, Length]


def _not_zero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise ValueError("[0, 0, 0] has no direction, expected a vector of non-zero length")
    return vector


Direction = Annotated[tuple[Number, Number, Number], AfterValidator(_not_zero)]


class Selection(SpecModel):
    """Names to take: shell wildcards or group names; what `exclude` matches is left out."""

    include: Annotated[tuple[str, ...], Field(min_length=1)]
    """Names, shell wildcards (`*_link2`) or group names, of which at least one must match."""
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
