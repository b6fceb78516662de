"""What a document says of modes that are computed from a body's shape."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StrictInt

from tgdsl.fields.materials import MaterialField
from tgdsl.fields.models import SpecModel


class ShapeModes(SpecModel):
    """Modes by modal analysis of a body's shape."""

    material: MaterialField
    """Its material, by name or by numbers."""
    count: Annotated[StrictInt, Field(ge=1)] = 32
    """Number of modes, from the lowest on, at most."""
