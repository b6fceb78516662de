"""What a policy feels at each physics step of a control step, stacked: `temporal: stack` of a task's document.

Shapes: `env` environments, `step` physics steps of a control step, the first one first, `feature` numbers of a group.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.module.module import TactileModule
from tgdsl.rl.sensed import Sensed
from tgdsl.runtime.simulators.simulation import Simulation


class SubstepTouch:
    """The groups of touch after each physics step of the last control step; all steps of a start are alike.

    Attributes:
        stacks: By group of observations: live tensors.
    """

    def __init__(self, sensed: Sensed, sim: Simulation):
        self._sensed, self._sim = sensed, sim
        self.stacks: dict[str, Float[Tensor, "env step feature"]] = {}

    def step(self, control: Float[Tensor, "env nu"]) -> dict[str, Tensor]:
        """Make a control step, feeling at each physics step; return the readings of the last one."""
        readings: dict[str, Tensor] = {}
        touch: TactileModule = self._sensed.touch
        for i, state in enumerate(self._sim.substates(control)):
            readings = touch(state)
            for name, value in self._sensed.observe(readings).items():
                self.stacks[name][:, i].copy_(value)
        return readings

    def begin(self, chosen: Bool[Tensor, " env"], readings: dict[str, Tensor]) -> None:
        """Fill the stacks of environments that begin an episode with the readings of their start."""
        for name, value in self._sensed.observe(readings).items():
            start = value[:, None].expand(-1, self._sim.substeps, -1)
            if name not in self.stacks:
                self.stacks[name] = start.clone()
            self.stacks[name].copy_(torch.where(chosen[:, None, None], start, self.stacks[name]))

    def observe(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Return copies of the groups: all features of the first physics step, then of the second."""
        return {name: value.flatten(1).clone() for name, value in self.stacks.items()}
