"""Taxels that cannot feel, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

REASONS = NOT_COLLIDED, BURIED, COVERED = "not collided", "buried", "covered at rest"
"""Why a taxel cannot feel; of several reasons that hold the first counts."""


@dataclass(frozen=True, eq=False)
class Unfelt:
    """Taxels of a link that cannot feel, all for one reason."""

    link: str  # the link
    reason: str  # one of the reasons above
    why: str  # what the reason is here
    taxels: Int[np.ndarray, " unfelt"]  # the taxels, by their indices in the layout, ascending
    of: int  # number of taxels of the link

    def __str__(self) -> str:
        return f"{self.link}: {len(self.taxels)} of {self.of} taxels {self.why}"


def by_reason(found: Sequence[Unfelt]) -> str:
    """Return how many taxels cannot feel for which reason: "buried 12, covered at rest 3"."""
    counts = {reason: sum(len(own.taxels) for own in found if own.reason == reason) for reason in REASONS}
    return ", ".join(f"{reason} {count}" for reason, count in counts.items() if count)


def unfelt_ids(found: Sequence[Unfelt]) -> Int[np.ndarray, " unfelt"]:
    """Return the taxels that cannot feel, ascending."""
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(own.taxels for own in found)]))
