"""Taxels that cannot feel, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

NOT_COLLIDED, BURIED, COVERED = "not collided", "buried", "covered at rest"
"""Reasons, as a legend calls them; of several that hold the first counts."""


@dataclass(frozen=True, eq=False)
class Unfelt:
    """Taxels of a link that cannot feel, all for one reason.

    Attributes:
        link: The link.
        reason: One of the reasons above.
        why: What the reason is here.
        taxels: The taxels, by their indices in the layout, ascending.
        of: Number of taxels of the link.
    """

    link: str
    reason: str
    why: str
    taxels: Int[np.ndarray, " unfelt"]
    of: int

    def __str__(self) -> str:
        return f"{self.link}: {len(self.taxels)} of {self.of} taxels {self.why}"


def num_unfelt(found: Sequence[Unfelt]) -> int:
    """Return how many taxels cannot feel."""
    return len(np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(own.taxels for own in found)])))
