"""The request for places: where points that are fixed to bodies are in the world."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request


@dataclass(frozen=True, eq=False)
class Places(Request[Vec]):
    """Asks where points on bodies are: planes (env, point) in the world [m], in the dtype of the state.

    With `objects` it asks where the frames of these objects' bodies are, and of no other points.

    Attributes:
        bodies: The body of each point.
        offset: Where each is in its body's frame [m].
    """

    bodies: tuple[str, ...] = ()
    offset: Float[np.ndarray, "point 3"] = field(default_factory=lambda: np.zeros((0, 3)))
