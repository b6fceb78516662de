"""Grasps as environments draw them: each those of its own variant of the object, with what the module's sensors feel in them.

Shapes: `env` environments, `grasp` grasps, ordered by variant, `nq` and `nu` as in MuJoCo's model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError, listed
from tgdsl.rl.draws import Draws
from tgdsl.rl.grasps.grasps import Grasps
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import FIELDS, StateValues


class Drawn(NamedTuple):
    """A grasp of each environment.

    Attributes:
        values: MuJoCo's arrays: `qpos`, and `ctrl`, with which the hand presses.
        contacts: Fields of a state that follow from forces, by name, (env, …).
        pos: Position of the object's body in the world [m].
        quat: Its orientation, w, x, y, z.
    """

    values: StateValues
    contacts: dict[str, Tensor]
    pos: Float[Tensor, "env 3"]
    quat: Float[Tensor, "env 4"]


class GraspTable:
    """The grasps of some environments.

    Attributes:
        qpos: Positions of all joints in each grasp.
        ctrl: Controls of all actuators in it.
        contacts: Fields of a state that follow from forces, by name, (grasp, …): those that the module wants.
        pos: Position of the object's body in each, in the world [m].
        quat: Its orientation, w, x, y, z.
        first: The first grasp of each environment's variant.
        count: How many that variant has.
    """

    qpos: Float[Tensor, "grasp nq"]
    ctrl: Float[Tensor, "grasp nu"]
    contacts: Mapping[str, Tensor]
    pos: Float[Tensor, "grasp 3"]
    quat: Float[Tensor, "grasp 4"]
    first: Int[Tensor, " env"]
    count: Int[Tensor, " env"]

    def __init__(self, grasps: Grasps, sim: Simulation, body: str, variant: Int[Tensor, " env"], draws: Draws):
        """Evaluate the contacts of all grasps, in the simulation; it has to be reset afterwards.

        Its objects have to be as those that the grasps were sampled with, and not yet of a mass and friction of their own.

        Raises:
            SimulationError: If the grasps are of other joints or actuators, or a variant that some environment has is lacking.
        """
        shape = (sim.model.nq, sim.model.nu)
        sizes = (grasps.qpos.shape[1], grasps.ctrl.shape[1])
        if sizes != shape:
            raise SimulationError(f"grasps of {sizes[0]} positions and {sizes[1]} controls, expected {shape[0]} and {shape[1]}")
        variants = variant.cpu().numpy()
        lacking = sorted({int(v) for v in variants} - {int(v) for v in grasps.variant})
        if lacking:
            problem = f"there are no grasps of variant {listed([str(v) for v in lacking])} of {grasps.object}"
            raise SimulationError(f"{problem}; sample as many as it has variants, or more")
        order = np.argsort(grasps.variant, kind="stable")
        variants_in_order = grasps.variant[order]
        device, dtype = sim.qpos.device, sim.qpos.dtype
        self.qpos = torch.from_numpy(grasps.qpos[order]).to(device, dtype)
        self.ctrl = torch.from_numpy(grasps.ctrl[order]).to(device, dtype)
        self.first = torch.from_numpy(np.searchsorted(variants_in_order, variants)).to(device)
        self.count = torch.from_numpy(np.searchsorted(variants_in_order, variants, side="right")).to(device) - self.first
        self._draws = draws
        contacts = self._evaluated(sim, body, variants)
        self.pos, self.quat = contacts.pop("pos"), contacts.pop("quat")
        self.contacts = contacts

    def draw(self, episode: Int[Tensor, " env"]) -> Drawn:
        """Return a grasp of each environment, drawn by its count of episodes."""
        share = self._draws.uniform("grasp", episode, 1)[:, 0]
        index = self.first + torch.minimum((share * self.count).to(torch.int64), self.count - 1)
        contacts = {name: value[index] for name, value in self.contacts.items()}
        return Drawn({"qpos": self.qpos[index], "ctrl": self.ctrl[index]}, contacts, self.pos[index], self.quat[index])

    def _evaluated(self, sim: Simulation, body: str, variants: Int[np.ndarray, " env"]) -> dict[str, Tensor]:
        """Return the touch in each grasp, and the object's place: zeros for variants that no environment has."""
        rank, num = np.zeros_like(variants), np.zeros_like(variants)
        for v in np.unique(variants):
            rank[variants == v], num[variants == v] = np.arange((variants == v).sum()), (variants == v).sum()
        result: dict[str, Tensor] = {}
        device = self.qpos.device
        step, place = torch.from_numpy(num).to(device), torch.from_numpy(rank).to(device)
        for i in range(int((self.count / step).ceil().max())):
            index = self.first + torch.minimum(place + i * step, self.count - 1)
            sim.reset(contacts="evaluate", qpos=self.qpos[index], ctrl=self.ctrl[index])
            state, motion = sim.state(), sim.watched().body(body)
            each = {name: getattr(state, name) for name in FIELDS} | {"pos": motion.pos, "quat": motion.quat}
            for name, value in each.items():
                if value is not None:
                    values = result.setdefault(
                        name, torch.zeros((len(self.qpos), *value.shape[1:]), dtype=value.dtype, device=device)
                    )
                    values[index] = value.to(device)
        return result
