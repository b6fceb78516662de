"""Modal analysis: from the triangles around a solid to its modes."""

from __future__ import annotations

from tgdsl.errors import LowerError
from tgdsl.modal.modes import Modes
from tgdsl.modal.spec import ShapeModes
from tgdsl.surfaces.surface import Surface


def analysed(name: str, surface: Surface, given: ShapeModes, below: float) -> Modes:
    """Return the modes of a solid.

    Args:
        name: What the body is called in messages.
        surface: Its surface, in its frame; of several geoms, all of theirs.
        given: What the document says of its modes.
        below: Frequency beyond which no mode is wanted [Hz].

    Raises:
        LowerError: If the surface encloses no solid that can be analysed.
    """
    raise LowerError(f'modes of "{name}" cannot be computed from its shape', field="modes", hint="list them")
