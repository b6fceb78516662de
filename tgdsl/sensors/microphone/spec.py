"""What a document says of a microphone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from tgdsl.fields.models import NonNegative, Position, Positive, PositiveLength, Quantity, Usual
from tgdsl.sensors.base import AnySensorSpec

Speed = Annotated[float, Quantity("speed", gt=0.0)]


class MicrophoneSpec(AnySensorSpec):
    """What a point hears of the sensors that make sound."""

    kind: Literal["microphone"]
    """Sound pressure at a point [Pa]: the sum over all sources, each delayed and fainter by its distance; blocks of samples."""
    pos: Position | None = None
    """Where it is [m]: in the world, or with `body` in that body's frame."""
    body: str | None = None
    """Body of the scene that carries it; default: it is fixed in the world. At its frame's origin unless `pos` says where."""
    hears: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Sensors whose sound it hears; default: all of the document that make sound."""
    levels: dict[str, Positive] = {}
    """By what the sound of a sensor is multiplied [1], by its name; default: 1."""
    falloff: NonNegative = 1.0
    """Exponent p of the level 1/r^p, r in metres [1]; 1 for a point source in a free field."""
    nearest: Annotated[PositiveLength, Usual("length", low=1e-3, high=1.0)] = 0.01
    """Distance below which a source gets no louder [m]."""
    reach: Annotated[PositiveLength, Usual("length", low=0.05, high=100.0)] = 10.0
    """Distance beyond which nothing is heard [m]: sound is remembered for as long as it travels so far."""
    speed: Annotated[Speed, Usual("speed", high=7000.0)] = 343.0
    """Speed of sound, c [m/s]; default: air at 20 °C."""
    is_on_taxels: ClassVar[bool] = False
    needs_taxels: ClassVar[bool] = False

    @model_validator(mode="after")
    def _check(self) -> MicrophoneSpec:
        if self.pos is None and self.body is None:
            raise ValueError("expected `pos`, in the world, or `body`, or both")
        if self.nearest >= self.reach:
            raise ValueError(f"nearest {self.nearest:g} m is not below reach {self.reach:g} m")
        return self

    @property
    def named_bodies(self) -> Mapping[str, str]:
        """The body that carries it."""
        return {} if self.body is None else {"body": self.body}
