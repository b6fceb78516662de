"""Contacts of a scene: where they are and how hard they press.

Shapes: `contact` contacts of one environment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import INTEGRATED

Array = np.ndarray


class Contacts(NamedTuple):
    """Contacts of one environment in the world."""

    pos: Float[Array, "contact 3"]  # [m]
    bodies: Int[Array, "contact 2"]  # the two bodies of each; -1 for a flex
    force: Float[Array, "contact 3"] | None  # on the second body [N]; None where it is unknown

    def forces_on(self, bodies: frozenset[int]) -> Float[Array, "contact 3"]:
        """Return the forces [N], each on that one of its two bodies that is among `bodies`, or else on the second."""
        assert self.force is not None
        is_in = np.isin(self.bodies, list(bodies))
        return np.where((is_in[:, 0] & ~is_in[:, 1])[:, None], -self.force, self.force)


def state_of(sim: Simulation, env: int) -> dict[str, Array]:
    """Return copies of the arrays that MuJoCo integrates in one environment, by their names."""
    return {name: sim.arrays[name][env].detach().cpu().numpy().copy() for name in INTEGRATED}


def simulated_contacts(model: mujoco.MjModel, state: Mapping[str, Array]) -> Contacts:
    """Return the contacts of a state, by MuJoCo's forward dynamics on the CPU."""
    data = mujoco.MjData(model)
    for name, value in state.items():
        if name == "time":
            data.time = float(value)
        else:
            getattr(data, name)[...] = value
    mujoco.mj_forward(model, data)
    return contacts_of(model, data)


def contacts_of(model: mujoco.MjModel, data: mujoco.MjData, with_force: bool = True) -> Contacts:
    """Return the contacts of a state for which MuJoCo makes constraints."""
    active = [i for i in range(data.ncon) if not data.contact[i].exclude]
    geoms = data.contact.geom[active].reshape(-1, 2)
    bodies = np.where(geoms < 0, -1, model.geom_bodyid[geoms])
    force, local = np.zeros((len(active), 3)), np.zeros(6)
    for row, i in enumerate(active if with_force else ()):
        mujoco.mj_contactForce(model, data, i, local)
        force[row] = local[:3] @ data.contact.frame[i].reshape(3, 3)
    return Contacts(data.contact.pos[active].reshape(-1, 3), bodies, force if with_force else None)
