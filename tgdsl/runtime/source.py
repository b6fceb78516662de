"""What a source offers, whichever simulator, hardware or recording is behind it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.module.state import SceneState
from tgdsl.tensors.env_ids import EnvIds

Control = Tensor | np.ndarray | None
"""Controls of a step, (actuator,) or (env, actuator); None: as they were."""


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


@runtime_checkable
class Simulator(Source, Protocol):
    """A source that steps MuJoCo's model of the scene: what rollouts and pictures ask of it.

    Attributes:
        model: The compiled scene; where objects differ between environments, that of the first.
    """

    model: mujoco.MjModel

    @property
    def qpos(self) -> Float[Tensor, "env nq"]:
        """MuJoCo's generalised positions, after the last step."""
        ...

    def state(self) -> SceneState:
        """Return what the module wants, all of it from one instant; its `dt` is that of a control step."""
        ...

    def substates(self, control: Control = None) -> Iterator[SceneState]:
        """Advance all environments by one control step, and yield the state after each of its physics steps.

        The `dt` of these states is that of a physics step.
        """
        ...

    def body_poses(self, env: int) -> tuple[Float[np.ndarray, "body 3"], Float[np.ndarray, "body 4"]]:
        """Return where all bodies of the model are in one environment, at the state's instant.

        Returns:
            Origins [m] and quaternions w, x, y, z, both in the world.
        """
        ...

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return the model of one environment, its objects as they are there."""
        ...
