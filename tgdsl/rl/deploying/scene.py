"""A task's scene as a source steps it: its objects, pushes and drives are simulated, and the task judges what happens.

Shapes: `actuator` actuators of the scene.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.rl.env import TouchEnv
from tgdsl.runtime.stepped_scene import SteppedScene


class Judged(NamedTuple):
    """What the task says of an episode so far.

    Attributes:
        goal: What is asked for now.
        score: The score.
        is_over: Whether it has ended, for good or as time is over.
        is_held: Whether nothing has ended it before its time was over.
    """

    goal: Float[Tensor, "env goal"]
    score: float
    is_over: bool
    is_held: bool


class TaskScene(SteppedScene):
    """One environment of a task, told where its joints shall go. An episode that is over stands still until it is reset.

    Attributes:
        judged: What the task says: of the instant that the readings are of.
    """

    def __init__(self, env: TouchEnv):
        """Take environments of one, at the start of an episode; they are closed with the scene.

        Raises:
            SimulationError: If there are several.
        """
        if env.num_envs != 1:
            raise SimulationError(f"a scene that a source steps has one environment, found {env.num_envs}")
        self._env = env
        super().__init__(env.touch, env.sim)
        self._note_start()

    @property
    def start(self) -> Float[Tensor, " actuator"]:
        """Set-points that hold at the start of an episode, or were told since [rad]: a copy."""
        return self._setpoints[0].cpu().clone()

    def put(self, actuators: Int[np.ndarray, " n"], setpoints: Float[np.ndarray, " n"]) -> None:
        """Tell some actuators where to go from the next control step on [rad]."""
        self._setpoints[0, torch.from_numpy(actuators)] = torch.from_numpy(setpoints).to(self._setpoints)

    def advance(self) -> dict[str, Tensor]:
        """Make one control step, unless the episode is over; return the readings."""
        if self.judged.is_over:
            return self.readings
        step = self._env.follow(self._setpoints)
        goal, info = self._env.task.asked().cpu().clone(), step.info
        ended = bool(info.ended)
        self.judged = Judged(goal, float(info.score), ended, not ended or bool(info.is_whole(self._env.max_steps)))
        return self.read()

    def begin(self) -> dict[str, Tensor]:
        """Begin the next episode; return the readings."""
        self._env.reset()
        self._note_start()
        return self.read()

    def read(self) -> dict[str, Tensor]:
        """Return what the environment has read, once per step."""
        return dict(self._env.now.readings)

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def _note_start(self) -> None:
        env = self._env
        self._setpoints = env.sim.ctrl.clone()
        self._setpoints[:, torch.from_numpy(env.task.setup.actuators.actuator)] = env.actuation.target
        self.judged = Judged(env.task.asked().cpu().clone(), float(env.task.score()), False, True)
