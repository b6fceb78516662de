"""Modules with noise of every sort, and how tests read them."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.sensors.noise.pipeline import draw, stages_of
from tgdsl.sensors.noise.stage import NO_CLOCK
from tgdsl.testing import only

EXAMPLE = Path(__file__).parents[2] / "examples" / "every_sensor.yaml"
FLOAT32_TOLERANCE = 1e-5
"""Largest error over the largest magnitude of the channel, as for clean readings: some 80 roundings of 2⁻²⁴."""
SCENE = """
<mujoco><worldbody>
  <body name="pad"><freejoint/><geom type="box" size=".03 .03 .01"/></body>
  <body name="tip"><freejoint/><geom type="sphere" size=".01"/></body>
  <body name="item"><freejoint/><geom type="sphere" size=".025"/></body>
</worldbody></mujoco>
"""
EVERY_KNOB = {
    "radius_noise": 3e-4,
    "gain": [0.8, 1.2],
    "hysteresis": {"strength": 0.5, "time_constant": 0.05},
    "crosstalk": {"strength": 0.2, "sigma": "5 mm"},
    "read_delay": 0.013,
    "jitter": 0.011,
    "bias": {"force": 0.02, "torque": -1e-4},
    "white_noise": {"force": 5e-3, "torque": 1e-5},
    "drift": {"force": 1e-3, "torque": 1e-6},
    "quantization": {"force": 1e-6, "torque": 1e-9},  # one step is within the tolerance
    "dead_probability": 0.1,
    "dead_range": [-0.3, 0.3],
}
RANGES = {
    "radius_noise": [2e-4, 4e-4],
    "gain": [[0.7, 0.8], [1.2, 1.3]],
    "hysteresis": {"strength": [0.3, 0.6], "time_constant": [0.03, 0.06]},
    "crosstalk": {"strength": [0.1, 0.3], "sigma": [0.004, 0.008]},
    "read_delay": [0.01, 0.02],
    "jitter": [0.0, 0.02],
    "bias": {"force": [-0.02, 0.02]},
    "white_noise": {"force": [1e-3, 5e-3], "torque": [1e-6, 1e-5]},
    "drift": {"force": [1e-4, 1e-3]},
    "quantization": {"force": [5e-7, 1e-6]},
    "dead_probability": [0.1, 0.3],
    "dead_range": [[-0.3, -0.2], [0.2, 0.3]],
}
CONTACT_NOISE = {"white_noise": 2e-4, "release_threshold": "0.1 mm", "read_delay": "7 ms", "drift": 1e-5}


def document(folder: Path, sensors: dict, **rest) -> dict:
    """A document with sensors on 12 taxels of a pad and 5 of a tip that feel a sphere."""
    (folder / "scene.xml").write_text(SCENE)
    pad = [{"pos": [0.006 * x, 0.006 * y, 0.01], "normal": [0, 0, 1]} for x in range(-1, 2) for y in range(-2, 2)]
    tip = [{"pos": [0.01 * np.sin(a), 0, 0.01 * np.cos(a)], "normal": [np.sin(a), 0, np.cos(a)]} for a in np.linspace(-1, 1, 5)]
    layout = {name: {"method": "points", "points": points, "radius": "4 mm"} for name, points in (("pad", pad), ("tip", tip))}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": layout}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {
            name: {"kind": "kinematic_taxel", "links": "*", "feels": ["item"], **sensor} for name, sensor in sensors.items()
        },
        **rest,
    }


def felt_state(touch: TactileModule, num_envs=4, seed=0):
    """A state in which most taxels feel something, and some do not."""
    return touch.example_state(num_envs, seed=seed, spread=0.015)


def held_state(touch: TactileModule, num_envs=4):
    """A state in which every taxel is deep in the object, everywhere alike."""
    state = touch.example_state(num_envs)
    assert state.body_pos is not None and state.body_quat is not None and state.contact_found is not None
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(state.body_quat)
    found = torch.ones_like(state.contact_found)
    return dataclasses.replace(state, body_pos=torch.zeros_like(state.body_pos), body_quat=upright, contact_found=found)


def read(touch: TactileModule, calls: range, num_envs=8, envs=None) -> list[dict[str, torch.Tensor]]:
    """Return the readings of the states with these seeds; `envs` are those of a larger batch that are fed."""
    found = []
    for call in calls:
        state = felt_state(touch, num_envs, call)
        found.append({name: value.clone() for name, value in touch(state if envs is None else only(state, envs)).items()})
    return found


def assert_same(found, expected, pick=slice(None)):
    for a, b in zip(found, expected, strict=True):
        for name in a:
            assert torch.equal(a[name], b[name][pick]), name


def read_of_rank(rank: int, file: str, made: dict, folder: str) -> None:
    """Write what one of two processes of a distributed run reads; here, as a spawned process has to import it."""
    torch.distributed.init_process_group("gloo", init_method=f"file://{file}", rank=rank, world_size=2)
    touch = tgdsl.compile(made, dtype=torch.float64)
    part = slice(4 * rank, 4 * rank + 4)
    torch.save(read(touch, range(4), envs=part), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


def circumstances(touch: TactileModule, memory: Mapping[str, Tensor], dt: Tensor | None = None):
    """Return when each sensor is read next, and the stages of its noise then, by sensor."""
    nows = touch.memory.clock.nows(memory, dt)
    stages = {sensor.name: stages_of(sensor.noise.terms) for sensor in touch.plan.sensors if sensor.noise is not None}
    tree = touch.constants.tree["noise"]
    return nows, {name: draw(stages[name], own, nows.get(name, NO_CLOCK)) for name, own in tree.items()}
