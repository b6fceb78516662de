"""A plate that is pressed and rubbed by a ball as a test says, and what it sounds like."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

PLATE = """
<mujoco>
  <option timestep="0.001" cone="elliptic"/>
  <worldbody>
    <body name="plate"><geom name="plate" type="box" size=".1 .1 .005"/></body>
    <body name="other" pos="1 0 0"><geom type="box" size=".1 .1 .005"/></body>
    <body name="ball" pos="0 0 .03"><freejoint/><geom type="sphere" size=".01" mass=".05"/></body>
  </worldbody>
</mujoco>
"""
STEP = 0.001
MODES = [
    {"frequency": 523.0, "decay": 6.0, "gain": 2.0},
    {"frequency": 1171.0, "decay": 20.0, "gain": -1.0},
    {"frequency": 2903.0, "decay": 55.0, "gain": 0.7},
]


def plate_document(folder, **sensor: Any) -> dict[str, Any]:
    """Return a document of a plate that feels a ball; its scene is written to a folder."""
    (folder / "plate.xml").write_text(PLATE)
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "plate.xml")},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"s": {"kind": "contact_audio", "links": "plate", "feels": ["ball"], "modes": MODES, **sensor}},
    }


def plate(folder, dtype: torch.dtype = torch.float64, **sensor: Any) -> TactileModule:
    """Return a compiled plate."""
    return tgdsl.compile(plate_document(folder, **sensor), dtype=dtype)


def pressed(
    touch: TactileModule, force: Sequence[float], speed: Sequence[float] | float = 0.0, step: float = STEP
) -> SceneState:
    """Return the state of a ball in each environment that presses with a normal force [N], sliding at a speed [m/s].

    It lies turned, and the plate moves along and turns, so that only what is relative counts.
    """
    force, speed = torch.as_tensor(force, dtype=torch.float64), torch.as_tensor(speed, dtype=torch.float64)
    state = touch.example_state(len(force))
    for name in ("contact_force", "contact_normal", "contact_netforce", "body_angvel"):
        getattr(state, name).zero_()
    normal, along = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64), torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64)
    pair = [own.link for own in touch.inputs.pairs].index("plate")
    state.contact_normal[:, pair, 0] = normal
    state.contact_force[:, pair, 0] = force[:, None] * (normal + 0.3 * along)
    state.contact_netforce[:, pair] = state.contact_force[:, pair, 0]
    ball, link = (touch.inputs.bodies.index(name) for name in ("ball", "plate"))
    state.body_linvel[:, ball] = state.body_linvel[:, link] + speed[..., None] * along + 0.4 * normal
    state.dt = step
    return state


def sound(touch: TactileModule, forces: Any, speeds: Any = 0.0, step: float = STEP) -> np.ndarray:
    """Return what is heard of forces (step, env) [N] and sliding speeds, one after the other: (env, sample)."""
    forces = np.atleast_2d(np.asarray(forces, dtype=np.float64).T).T
    speeds = np.broadcast_to(np.asarray(speeds, dtype=np.float64), forces.shape)
    heard = [touch(pressed(touch, f.tolist(), v.tolist(), step))["s"][:, :, 0, 0] for f, v in zip(forces, speeds, strict=True)]
    return torch.cat(heard, dim=1).double().numpy()


def ringing(impulse: float, time: np.ndarray, modes: Sequence[dict[str, float]] = MODES) -> np.ndarray:
    """Return J Σ g e^(−dt) sin(2πft) [m/s], 0 before the impulse."""
    after = np.maximum(time, 0.0)
    each = [m["gain"] * np.exp(-m["decay"] * after) * np.sin(2 * math.pi * m["frequency"] * after) for m in modes]
    return impulse * np.sum(each, axis=0) * (time >= 0)


def energy(touch: TactileModule) -> float:
    """Return Σ |z|² of all modes now [N²·s²]."""
    return float((touch.memory.get_buffer("s:phasors").double() ** 2).sum())
