"""Parts of a link's surface, as a user writes them: where it faces, boxes, spheres, geoms."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import BeforeValidator, Discriminator, Tag, model_validator

from tgdsl.fields.models import Angle, Direction, Position, PositiveLength, Selector, SpecModel, Usual


class Facing(SpecModel):
    """The part of a surface whose outward normal points along a direction."""

    facing: Direction
    """Direction in the link frame; need not have unit length."""
    within: Annotated[Angle, Usual("angle", high=math.pi)]
    """Largest angle between normal and direction [rad, or a string such as `60 deg`]."""


class BoxBounds(SpecModel):
    """An axis-aligned box in the link frame."""

    min: Position
    """Lower corner [m]."""
    max: Position
    """Upper corner [m]."""

    @model_validator(mode="after")
    def _ordered(self) -> BoxBounds:
        if not all(low < high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError(f"min {list(self.min)} is not below max {list(self.max)} on every axis")
        return self


class InBox(SpecModel):
    """The part of a surface inside a box."""

    box: BoxBounds
    """The box, in the link frame."""


class SphereBounds(SpecModel):
    """A sphere in the link frame."""

    center: Position
    """Centre [m]."""
    radius: PositiveLength
    """Radius [m]."""


class InSphere(SpecModel):
    """The part of a surface inside a sphere."""

    sphere: SphereBounds
    """The sphere, in the link frame."""


class OnGeoms(SpecModel):
    """The part of a link's surface that belongs to some of its geoms."""

    geoms: Selector
    """Geom or mesh names, with shell wildcards."""


RegionPart = Facing | InBox | InSphere | OnGeoms
_REGIONS: dict[str, type[SpecModel]] = {"facing": Facing, "box": InBox, "sphere": InSphere, "geoms": OnGeoms}


def _region_tag(value: object) -> str | None:
    # An article, because a tag in an error's location must not look like a key.
    if isinstance(value, dict):
        return next((f"a {key}" for key in _REGIONS if key in value), None)
    return next((f"a {key}" for key, model in _REGIONS.items() if isinstance(value, model)), None)


_TaggedRegion = Annotated[
    Annotated[Facing, Tag("a facing")]
    | Annotated[InBox, Tag("a box")]
    | Annotated[InSphere, Tag("a sphere")]
    | Annotated[OnGeoms, Tag("a geoms")],
    Discriminator(
        _region_tag,
        custom_error_type="region",
        custom_error_message="not a region, expected a mapping with one of the keys facing, box, sphere, geoms",
    ),
]


Region = Annotated[
    tuple[_TaggedRegion, ...],
    BeforeValidator(
        lambda value: (value,) if isinstance(value, dict) else value,
        json_schema_input_type=_TaggedRegion | tuple[_TaggedRegion, ...],
    ),
]
"""A region, or a list of regions that means their intersection; an empty one means all of the surface."""
