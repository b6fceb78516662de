"""A ball that presses two probes, and recordings of what they read with known parameters."""

from pathlib import Path

import numpy as np
import torch

import tgdsl
from tgdsl.calibration.recordings import velocities

SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01" pos="0 0 -.01"/></body>
  <body name="ball" pos="0 0 .05"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
DOCUMENT = """\
tgdsl: 1
robot:
  model: scene.xml
  layout:
    resolutions:
      r:
        pad:
          method: points
          radius: 4 mm
          points:
            - {pos: [0, 0, 0], normal: [0, 0, 1]}
            - {pos: [3 mm, 0, 0], normal: [0, 0, 1]}
            - {pos: [0, 4 mm, 0], normal: [0, 0, 1]}
objects: {ball: {body: ball}}
sensors:
  touch:
    kind: kinematic_taxel
    links: pad
    feels: [ball]
    gate: geometric
    outputs: [force]
    normal_stiffness: 500  # a guess
    depth_exponent: 1.0
    normal_damping: 0
    shear_damping: 0
"""
TRUE = {"sensors.touch.normal_stiffness": 900.0, "sensors.touch.depth_exponent": 1.3}
NOISE = 2e-3
LAG = 0.12
"""Noise [N], and how far the sensor's clock is behind the states' [s]."""


def document(folder: Path) -> Path:
    (folder / "scene.xml").write_text(SCENE)
    (folder / "touch.yaml").write_text(DOCUMENT)
    return folder / "touch.yaml"


def motion(num: int = 120) -> dict[str, np.ndarray]:
    """Presses of different depths and speeds, and a bit of sideways motion; bodies in the order of the module's inputs."""
    time = np.linspace(0.0, 3.0, num)
    pos, quat = np.zeros((num, 2, 3)), np.zeros((num, 2, 4))
    pos[:, 0, 0] = 1e-3 * np.sin(2 * time)
    pos[:, 0, 2] = 0.034 - 1.2e-3 * (1 - np.cos(4 * time)) - 4e-4 * np.sin(9 * time)
    quat[..., 0] = 1.0
    return {"time": time, "body_pos": pos, "body_quat": quat, "bodies": np.array(["ball", "pad"])}


def readings(path: Path, states: dict[str, np.ndarray], true: dict[str, float] = TRUE) -> np.ndarray:
    """Return what sensors with the true parameters read of each state (step, row, channel)."""
    touch = tgdsl.compile(path, overrides=true, dtype="float64")
    fields = {name: states[name] for name in ("body_pos", "body_quat")}
    fields |= velocities(states["time"], fields)
    return touch(tgdsl.SceneState(**{name: torch.from_numpy(value) for name, value in fields.items()}))["touch"].numpy()


def recording(path: Path, seed: int = 0, lag: float = LAG, num: int = 60, noise: float = NOISE) -> dict[str, np.ndarray]:
    """Return a recording, the target at times and on a clock of its own."""
    states = motion(1200)
    values, clock = readings(path, states), np.linspace(0.4, 2.6, num)
    flat = values.reshape(len(values), -1)
    target = np.stack([np.interp(clock, states["time"], column) for column in flat.T], axis=1).reshape(num, *values.shape[1:])
    target += np.random.default_rng(seed).normal(0.0, noise, target.shape)
    keys = {
        "target": target,
        "clock": clock + lag,
        "clock_width": np.array(0.2),
        "unit": np.array("N"),
        "floor": np.array(noise),
    }
    return states | {f"{key}:touch": value for key, value in keys.items()}
