"""What a source offers, whichever simulator, hardware or recording is behind it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from tgdsl.tensors.env_ids import EnvIds

Control = Tensor | np.ndarray | None  # controls of a step, (actuator,) or (env, actuator); None: as they were


@runtime_checkable
class Source(Protocol):
    """Environments that are stepped: what a connection needs of a simulator, a hand or a recording."""

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        ...

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        ...

    def step(self, control: Control = None) -> None:
        """Advance all environments by one control step."""
        ...

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Begin a new episode in some environments (default: all)."""
        ...

    def close(self) -> None:
        """Release the simulator, the device or the file."""
        ...
