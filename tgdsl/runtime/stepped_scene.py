"""A simulated scene of one environment, as sources step it: set-points in, control steps, readings out.

Shapes: `actuator` actuators of the scene, `joint` joints by name.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import Control, control_tensor
from tgdsl.tensors.env_ids import EnvIds


class SteppedScene:
    """A scene that holds its set-points until `put` changes them, and is read at the end of each control step.

    Subclasses that know more of the scene, such as a task, override `advance` and `begin`.

    Attributes:
        sim: The simulation, of one environment.
        readings: What the module reads at the end of the last step, or at the start.
    """

    num_envs = 1

    def __init__(self, touch: TactileModule, sim: Simulation):
        if sim.num_envs != 1:
            raise SimulationError(f"an emulated hand has one environment, found {sim.num_envs}")
        self.sim, self._touch = sim, touch
        self.readings = self.read()

    @property
    def control_step(self) -> float:
        return self.sim.control_step

    def put(self, actuators: Int[np.ndarray, " n"], setpoints: Float[np.ndarray, " n"]) -> None:
        """Tell some actuators where to go from the next physics step on [rad; slides: m]."""
        self.sim.ctrl[0, torch.from_numpy(actuators)] = torch.from_numpy(setpoints).to(self.sim.ctrl)

    def step(self, control: Control = None) -> None:
        """Make one control step with set-points of all actuators, (actuator,) or (1, actuator), and read the sensors."""
        if control is not None:
            values = control_tensor(control, *self.sim.ctrl.shape).reshape(-1)
            self.put(np.arange(len(values)), values.cpu().numpy())
        self.readings = self.advance()

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Begin a new episode, and read the sensors."""
        self.readings = self.begin()

    def advance(self) -> dict[str, Tensor]:
        """Make one control step; return the readings."""
        self.sim.step()
        return self.read()

    def begin(self) -> dict[str, Tensor]:
        """Begin a new episode; return the readings."""
        self.sim.reset()
        return self.read()

    def read(self) -> dict[str, Tensor]:
        """Return the readings of the present state: once per state, as sensors remember their last samples."""
        with torch.no_grad():
            return self._touch(self.sim.state())

    def positions(self, joints: Sequence[str]) -> Float[np.ndarray, " joint"]:
        """Return where joints that are watched are, at the instant that the readings are of [rad; slides: m]."""
        watched = self.sim.watched()
        rows = [watched.watch.joints.index(name) for name in joints]
        return watched.joint_pos[0, rows].double().cpu().numpy()

    def close(self) -> None:
        """Release the module; the scene can no longer be used."""
        self.sim.close()
