"""Balls that fall on a plate in a simulation, and how loud that is.

Shapes: `env` environments, each a ball of its own height.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from oracles.setups.sounds import MODES
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.tuning.compile import compile

MASS, GRAVITY = 0.05, 9.81
"""Of the ball [kg, m/s²]."""
SCENE = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <body name="plate"><geom type="box" size=".1 .1 .005" solref="{stiffness}"/></body>
    <body name="ball" pos="0 0 .0160"><freejoint/><geom type="sphere" size=".01" mass="0.05" solref="{stiffness}"/></body>
  </worldbody>
</mujoco>
"""
HEIGHTS = np.array([0.005, 0.01, 0.02, 0.04, 0.08, 0.16])
"""Of the ball's lowest point above the plate [m]."""


def dropped(
    folder: Path,
    simulator: Callable[..., Any] = BatchSimulation,
    heights: np.ndarray = HEIGHTS,
    step: float = 0.001,
    stiffness: str = "-1e6 -4",
    substeps: int = 1,
    **sensor: Any,
) -> tuple[Any, TactileModule]:
    """Return a simulation of balls that fall from heights [m], and its module."""
    (folder / "drops.xml").write_text(SCENE.format(step=step, stiffness=stiffness), encoding="utf-8")
    given = {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": MODES, "scrape": 0, **sensor}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "drops.xml")},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"s": {"samples": 8, "substeps": substeps, **given}},
    }
    touch = compile(document)
    sim = simulator(touch, len(heights), substeps=substeps)
    place = sim.qpos.clone()
    place[:, sim.joints["ball"].qpos.start + 2] = torch.as_tensor(0.015 + heights, dtype=place.dtype)
    sim.reset(qpos=place)
    return sim, touch


def loudest(sim: Any, touch: TactileModule, seconds: float) -> tuple[Float[np.ndarray, " env"], Float[np.ndarray, " env"]]:
    """Return of each environment the amplitude of its first mode after its first collision, and that one's impulse [N·s]."""
    largest, impulse = np.zeros((2, sim.num_envs))
    is_over, is_next = np.zeros((2, sim.num_envs), dtype=bool)
    for _ in range(round(seconds / sim.model.opt.timestep)):
        sim.step()
        state = sim.state()
        touch(state)
        force = state.contact_netforce[:, 0].norm(dim=-1).double().numpy()
        is_next |= is_over & (force > 0)
        is_over |= (impulse > 0) & (force == 0)
        impulse += np.where(is_over, 0.0, force * sim.model.opt.timestep)
        phasors = touch.memory.get_buffer("s:phasors")[:, 0].double().numpy()
        largest = np.where(is_next, largest, np.maximum(largest, np.hypot(phasors[:, 0], phasors[:, len(MODES)])))
    return largest, impulse
