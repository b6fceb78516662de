"""Simulators as sources: observed by the module itself."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.observations.observations import HAND_ONLY, hand_only_error
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.source import Simulator


class SimulationConnection(Connection):
    """A connection to a simulator of the module's scene.

    Shapes: `env` environments, `feature` numbers of an observation.
    """

    def __init__(self, touch: TactileModule, sim: Simulator):
        """Connect a module to the simulator that it reads."""
        super().__init__(sim)
        self._touch, self._sim = touch, sim

    def read(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Compute the readings of the state, and return the observation groups."""
        return self._touch.observe(self._touch(self._sim.state()))


def refuse_hand_only(touch: TactileModule) -> None:
    """Refuse observations that no simulator can give.

    Raises:
        ObservationError: For the first one.
    """
    for term in touch.plan.observations:
        if term.type in HAND_ONLY:
            raise hand_only_error(term.group, term.index, term.type)


def set_control_step(sim: Simulation, control_step: float) -> None:
    """Have a simulation make as many physics steps per control step as this takes [s].

    Raises:
        SimulationError: If it is no whole number of them.
    """
    timestep = float(sim.model.opt.timestep)
    sim.substeps = round(control_step / timestep)
    if sim.substeps < 1 or abs(sim.control_step - control_step) > 1e-6 * timestep:
        what = f"a control step of {control_step:g} s"
        raise SimulationError(f"{what}, expected a whole number of the scene's physics steps of {timestep:g} s")
