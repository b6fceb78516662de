"""Who acts in environments.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

from jaxtyping import Bool, Float
from torch import Tensor


class Actor(ABC):
    """Who acts in environments.

    Attributes:
        changes: What of the task was otherwise when that was learned, a line each.
    """

    changes: Sequence[str] = ()

    @abstractmethod
    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return actions, from −1 to 1, for observations by group."""

    def begin(self, ended: Bool[Tensor, " env"]) -> None:  # noqa: B027
        """Forget what is remembered of episodes that have ended; most remember nothing."""
