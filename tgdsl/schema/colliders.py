"""Primitive colliders of a robot's links, in a file of their own beside the robot's model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StrictBool, model_validator

from tgdsl.fields.models import Number, Position, PositiveLength, SpecModel
from tgdsl.plan.scene import Collider
from tgdsl.schema.load import read_spec
from tgdsl.schema.objects import NUM_SIZES


class ColliderSpec(SpecModel):
    """A primitive that a link collides with."""

    type: Literal["sphere", "capsule", "cylinder", "ellipsoid", "box"]
    """Its type, by MuJoCo's name."""
    size: Annotated[tuple[PositiveLength, ...], Field(min_length=1, max_length=3)]
    """Its size as MuJoCo defines it: radius; radius and half-length; half-lengths along x, y, z [m]."""
    pos: Position = (0.0, 0.0, 0.0)
    """Origin of its frame in the body's frame [m]."""
    quat: tuple[Number, Number, Number, Number] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of its frame in the body's frame, w, x, y, z."""
    core: StrictBool = False
    """Whether links that have primitive colliders meet it too; the others meet what is no such link alone."""

    @model_validator(mode="after")
    def _check(self) -> ColliderSpec:
        if len(self.size) != NUM_SIZES[self.type]:
            raise ValueError(f"a {self.type} has {NUM_SIZES[self.type]} sizes, found {len(self.size)}")
        if not any(self.quat):
            raise ValueError("[0, 0, 0, 0] is no orientation, expected a quaternion w, x, y, z of non-zero length")
        return self


class CollidersSpec(SpecModel):
    """The primitive colliders of a robot."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    bodies: Annotated[dict[str, Annotated[tuple[ColliderSpec, ...], Field(min_length=1)]], Field(min_length=1)]
    """Colliders by the name of the body whose colliding geoms they stand in for."""


def load_colliders(file: Path) -> tuple[Collider, ...]:
    """Return the colliders of a file, those of one body after another.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    spec, _ = read_spec(file, CollidersSpec, ("tgdsl", "bodies"))
    return tuple(
        Collider(body, own.type, own.size, own.pos, own.quat, own.core) for body, parts in spec.bodies.items() for own in parts
    )
