"""What a source of scene states offers, whichever simulator or hardware is behind it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
from torch import Tensor

from tgdsl.state import SceneState

EnvIds = Tensor | np.ndarray | Sequence[int]
"""Environments: indices, or a boolean mask over all of them."""


class Source(Protocol):
    """Something that steps and can be felt."""

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        ...

    def step(self, control: Tensor | np.ndarray | None = None) -> None:
        """Advance all environments by one control step."""
        ...

    def substates(self, control: Tensor | np.ndarray | None = None) -> Iterator[SceneState]:
        """Advance all environments by one control step, and yield the state after each of its physics steps.

        The `dt` of these states is that of a physics step. What has no physics steps yields one state, of the control step.
        """
        ...

    def state(self) -> SceneState:
        """Return what the module wants, all of it from one instant; its `dt` is that of a control step."""
        ...

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Start some environments (default: all) anew, and what the module remembers of them."""
        ...
