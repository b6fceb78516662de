"""A task's scene as a source steps it: its objects, pushes and drives are simulated, and the task judges what happens.

Shapes: `actuator` actuators of the scene.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.rl.env import Step, StepInfo, TouchEnv
from tgdsl.runtime.stepped_scene import SteppedScene


def first_step(score: float = math.nan) -> Step:
    """Return a step of one environment that brings nothing and ends nothing."""
    is_so, count, value = torch.zeros(1, dtype=torch.bool), torch.zeros(1, dtype=torch.int64), torch.zeros(1)
    return Step({}, value, is_so, is_so, StepInfo(is_so, {}, {}, value + score, value, count, {}, is_so))


class TaskScene(SteppedScene):
    """One environment of a task, told where its joints shall go. An episode that is over stands still until it is reset.

    Attributes:
        goal: What the task asks for now.
        last_step: What the task says: of the instant that the readings are of.
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
    def max_steps(self) -> int:
        """Control steps of an episode that nothing ends before."""
        return self._env.max_steps

    @property
    def start(self) -> Float[Tensor, " actuator"]:
        """Set-points that hold at the start of an episode, or were told since [rad]: a copy."""
        return self._setpoints[0].cpu().clone()

    def put(self, actuators: Int[np.ndarray, " n"], setpoints: Float[np.ndarray, " n"]) -> None:
        """Tell some actuators where to go from the next control step on [rad]."""
        self._setpoints[0, torch.from_numpy(actuators)] = torch.from_numpy(setpoints).to(self._setpoints)

    def advance(self) -> dict[str, Tensor]:
        """Make one control step, unless the episode is over; return the readings."""
        if self.last_step.info.ended:
            return self.readings
        step = self._env.follow(self._setpoints)
        self.goal, self.last_step = self._env.task.asked().cpu().clone(), step
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
        self.goal, self.last_step = env.task.asked().cpu().clone(), first_step(float(env.task.score()))
