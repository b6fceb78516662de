"""A robot with every way to drive a joint, beside an object that has a driven joint of its own."""

from pathlib import Path
from typing import Any

import torch

import tgdsl
from tgdsl.module.module import TactileModule

SCENE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="base">
      <geom size=".01" contype="0" conaffinity="0"/>
      <body name="arm" pos=".1 0 .3">
        <joint name="lift" type="slide" axis="0 0 1" range="-.2 .2" damping="1"/>
        <geom type="capsule" size=".01" fromto="0 0 0 .1 0 0" mass=".2"/>
        <body name="finger" pos=".1 0 0">
          <joint name="bend" axis="0 1 0" damping=".01" armature=".001"/>
          <geom type="box" size=".01 .01 .01" pos=".02 0 0" mass=".05"/>
          <body name="tip" pos=".04 0 0">
            <joint name="curl" axis="0 1 0" ref=".2" damping=".01" armature=".001"/>
            <geom type="box" size=".01 .01 .01" pos=".02 0 0" mass=".05"/>
          </body>
        </body>
        <body name="flap" pos="0 0 .05">
          <joint name="passive" axis="1 0 0" damping=".002" armature=".001"/>
          <geom size=".01" pos="0 .03 0" mass=".02"/>
        </body>
      </body>
      <body name="head" pos="-.2 0 .3"><joint name="neck" type="ball" damping=".01"/><geom size=".02" mass=".1"/></body>
    </body>
    {object}
  </worldbody>
  <tendon><fixed name="cable"><joint joint="bend" coef=".02"/><joint joint="curl" coef=".01"/></fixed></tendon>
  <actuator>
    <motor name="pull" tendon="cable" gear="3"/>
    {drive}
    <position name="raise" joint="lift" kp="60" kv="3"/>
    <motor name="twist" joint="bend" gear=".3"/>
  </actuator>
  <keyframe><key name="home" qpos="{qpos}" qvel="{qvel}" ctrl="{ctrl}"/></keyframe>
</mujoco>
"""
OBJECT = """
    <body name="item" pos=".35 0 .3">
      <joint name="spin" axis="0 0 1" damping=".001"/><geom type="box" size=".02 .02 .02" mass=".1"/>
    </body>
"""
ROBOT_XML = SCENE.format(object="", drive="", qpos=".02 .3 -.1 .2 .8 .6 0 0", qvel=".1 -.5 .7 1 .1 .2 .3", ctrl="-.3 .05 .02")
SCENE_XML = SCENE.format(
    object=OBJECT,
    drive='<motor name="turn" joint="spin"/>',
    qpos=".02 .3 -.1 .2 .8 .6 0 0 .1",
    qvel=".1 -.5 .7 1 .1 .2 .3 2",
    ctrl="-.3 .001 .05 .02",
)
ACTUATED = ("bend", "curl", "lift")
"""The robot's actuated joints in the order of its actuators; `passive` has none, `neck` is no hinge, `spin` is the object's."""
ACTUATORS = ("pull", "raise", "twist")
ALL = [{"type": name} for name in ("joint_pos", "joint_vel", "joint_effort", "last_action")]


def joint_document(folder: Path, observations: dict[str, Any], **sensors: Any) -> dict[str, Any]:
    (folder / "robot.xml").write_text(ROBOT_XML)
    (folder / "scene.xml").write_text(SCENE_XML)
    points = {
        "method": "points",
        "points": [{"pos": [0.02, 0, z], "normal": [1, 0, 0]} for z in (-0.005, 0.005)],
        "radius": 0.01,
    }
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "robot.xml"), "layout": {"resolutions": {"only": {"tip": points, "finger": points}}}},
        "scene": {"model": str(folder / "scene.xml")},
        "objects": {"item": {"body": "item"}},
        "sensors": {
            "dist": {"kind": "surface_distance", "links": "*", "feels": ["item"], "nearest": True},
            **sensors,
        },
        "observations": observations,
    }


def joint_module(folder: Path, observations: dict[str, Any], dtype=torch.float64, **sensors: Any) -> TactileModule:
    return tgdsl.compile(joint_document(folder, observations, **sensors), dtype=dtype)
