"""A pad with two probes under a ball that is pressed so deep at each call."""

from pathlib import Path

import numpy as np
import torch

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

BALL, RADIUS, UP = 0.03, 0.004, 0.01
"""Radius of the ball, of the probe, and the probe's height over its body [m]."""
SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01"/></body>
  <body name="item" pos="0 0 .05"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""


def pad(folder: Path, dtype=torch.float64, observations=None, **sensors) -> TactileModule:
    """Return a module whose sensors read the probes."""
    (folder / "scene.xml").write_text(SCENE)
    points = [{"pos": [0, 0, UP], "normal": [0, 0, 1]}, {"pos": [0.002, 0, UP], "normal": [0, 0, 1]}]
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points, "radius": RADIUS}}}}
    own = {"kind": "contact_depth", "links": "pad", "feels": ["item"], "gate": "geometric"}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "scene.xml"), "layout": layout},
            "objects": {"item": {"body": "item"}},
            "sensors": {name: {**own, **sensor} for name, sensor in sensors.items()},
            "observations": observations or {},
        },
        dtype=dtype,
    )


def pressed(touch, depth, dt=None) -> SceneState:
    """A state in which the first probe is `depth` deep, in each environment its own [m]."""
    depth = torch.as_tensor(np.atleast_1d(depth), dtype=torch.float64)
    pos, quat = torch.zeros(len(depth), 2, 3, dtype=torch.float64), torch.zeros(len(depth), 2, 4, dtype=torch.float64)
    quat[..., 0] = 1
    pos[:, touch.inputs.bodies.index("item"), 2] = UP + RADIUS + BALL - depth
    return SceneState(body_pos=pos, body_quat=quat, dt=dt)


def ramp(num: int, num_envs=1) -> np.ndarray:
    """Depths (call, env) that are all different [m]."""
    return 1e-3 + 2e-3 * (np.arange(num * num_envs).reshape(num, num_envs) / (num * num_envs))
