"""A task that is made in half a second: a finger of two joints above a box on the floor, which in_palm_rotate turns."""

from pathlib import Path

import pytest
import torch

SCENE = """
<mujoco model="small">
  <option timestep="0.005"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <camera name="side" pos="0 -.4 .2" xyaxes="1 0 0 0 .5 .87"/>
    <body name="finger" pos="0 0 .1095">
      <joint name="swing" type="hinge" axis="0 1 0" range="-1 1" damping=".05" armature=".001"/>
      <geom name="finger" type="capsule" fromto="0 0 0 0 0 -.04" size=".008" mass=".05"/>
      <body name="tip" pos="0 0 -.06">
        <joint name="bend" type="hinge" axis="0 1 0" range="-1 1" damping=".05" armature=".001"/>
        <geom name="tip" type="box" size=".01 .01 .01" mass=".02"/>
      </body>
    </body>
    <body name="item" pos="0 0 .0205">
      <freejoint name="item"/><geom name="item" type="box" size=".02 .02 .02" mass=".1" priority="1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="swing" joint="swing" kp="2" ctrlrange="-1 1" forcerange="-1 1"/>
    <position name="bend" joint="bend" kp="2" ctrlrange="-1 1" forcerange="-1 1"/>
  </actuator>
  <keyframe><key name="open" qpos="0 0 0 0 .0205 1 0 0 0" ctrl="0 0"/></keyframe>
</mujoco>
"""
SENSORS = """tgdsl: 1
robot:
  model: scene.xml
  layout:
    resolutions: {low: {tip: {method: grid, rows: 2, columns: 2, direction: [0, 0, -1], radius: 4 mm}}}
objects: {item: {body: item}}
resolution: low
sensors:
  bit: {kind: contact, links: tip, feels: [item], threshold: 0.1 mm, release_threshold: 0.05 mm}
  felt: {kind: link_contact, links: tip, feels: [item], outputs: [force]}
  gap: {kind: surface_distance, links: tip, feels: [item], max_range: 10 cm}
"""
TASK = """tgdsl: 1
task: in_palm_rotate
document: sensors.yaml
object: item
joints: ["*"]
keyframe: open
episode: 0.2 s
touch: bool
placement: tip
action: {mode: relative, scale: 0.05 rad}
randomise: {xy: [-5 mm, 5 mm], yaw: [-15 deg, 15 deg]}
"""
STEPS = 8
"""Control steps of an episode of 0.2 s."""


def small_task(folder: Path) -> Path:
    """Write the task's files; return its document."""
    (folder / "scene.xml").write_text(SCENE)
    (folder / "sensors.yaml").write_text(SENSORS)
    (folder / "task.yaml").write_text(TASK)
    return folder / "task.yaml"


DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")]),
]
"""Devices of a fixture."""


def have_a_fault(env) -> None:
    """Make a step in which an action of environment 0 is not finite; on a GPU, two more, by which it is told of."""
    action = torch.zeros((env.num_envs, env.num_actions), device=env.device)
    for value in (torch.nan, 0.0, 0.0) if env.device.type == "cuda" else (torch.nan,):
        action[0, 0] = value
        env.step(action)
        if env.device.type == "cuda":
            torch.cuda.synchronize()
