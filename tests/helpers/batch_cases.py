"""A cube on a pad and an arm that pushes an item, for MuJoCo's batch, and one environment of them stepped by MuJoCo alone."""

import dataclasses

import mujoco
import numpy as np

import tgdsl
from tgdsl.module.module import TactileModule

TOLERANCE = 1e-12
"""Both sides use float64 and the same solver, and differ in the order of a few sums and products."""
CONTACT_FIELDS = ("contact_found", "contact_pos", "contact_force", "contact_torque", "contact_normal", "contact_netforce")
WEIGHT = 0.25 * 9.81
PAD = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10"/>
  <worldbody>
    <body name="pad" {mount}><geom name="pad" type="box" size=".05 .05 .01" friction="1"/></body>
    <body name="cube" {place}><freejoint/><geom type="box" size=".02 .02 .02" mass=".25" friction="1"/></body>
  </worldbody>
</mujoco>
"""
ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm" pos=".1 -.2 .3" quat=".8 .2 -.4 .1">
      <joint name="one" axis="0 1 .2"/>
      <geom name="arm" type="capsule" size=".02" fromto="0 0 0 .2 .05 0" contype="2" conaffinity="2"/>
      <body name="pad" pos=".2 .05 .03" euler="20 40 -30">
        <joint name="two" axis="1 0 .3" pos=".01 .02 0"/>
        <geom name="pad" type="{pad}" size=".03 .02 .015" pos=".008 -.01 .02" euler="10 20 30"/>
      </body>
    </body>
    <body name="item" pos=".216 -.231 .525">
      <freejoint/>
      <geom name="item" type="{item}" size=".03 .025 .02" pos="-.01 .02 .005" mass=".1"/>
      <geom type="sphere" size=".01" pos=".1 0 0" mass=".05"/>
    </body>
    <body name="post" pos="0 0 -5"><geom name="post" size=".1"/></body>
  </worldbody>
  <actuator>
    <motor name="one" joint="one" gear=".5"/>
    <motor name="two" joint="two" gear=".2"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0 .216 -.231 .525 1 0 0 0" qvel="3 -2 .1 -.2 .3 4 -5 6"/>
    <key name="far" qpos=".3 -.2 3 0 0 1 0 0 0" ctrl=".1 -.1"/>
  </keyframe>
</mujoco>
"""


def scene(folder, text: str):
    (folder / "scene.xml").write_text(text)
    return folder / "scene.xml"


def module(path, objects=("cube",), links=("pad",), **sensor) -> TactileModule:
    probe = [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}, {"pos": [0.01, 0, 0.01], "normal": [0, 0, 1]}]
    points = {"method": "points", "points": probe, "radius": 0.005}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(path), "layout": {"resolutions": {"only": dict.fromkeys(links, points)}}},
        "objects": {name: {"body": name} for name in objects},
        "sensors": {"touch": {"kind": "kinematic_taxel", "links": list(links), "feels": list(objects), **sensor}},
    }
    return tgdsl.compile(document)


def wanting(touch: TactileModule, path, fields=CONTACT_FIELDS, slots: int = 4) -> tuple[TactileModule, mujoco.MjModel]:
    """Return the module as if its sensors read the given contact fields too, and a model with the sensors for it."""
    own = tuple(dict.fromkeys((*touch.inputs.fields, *fields)))
    inputs = dataclasses.replace(touch.inputs, fields=own, slots=slots)
    spec = mujoco.MjSpec.from_file(str(path))
    return TactileModule(dataclasses.replace(touch.plan, inputs=inputs)), tgdsl.instrument(spec, inputs).compile()


def arm(folder, pad: str = "box", item: str = "sphere") -> tuple[TactileModule, mujoco.MjModel]:
    path = scene(folder, ARM.format(pad=pad, item=item))
    return wanting(module(path, ("item",), ("pad", "arm"), gate="geometric"), path, ())


def value(state, name: str) -> np.ndarray:
    return getattr(state, name).numpy()


def stepped(model: mujoco.MjModel, keyframe: str | None, controls, substeps: int) -> mujoco.MjData:
    """Return one environment's data just before the last substep, all of it evaluated there."""
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
    total = len(controls) * substeps
    for i in range(total):
        data.ctrl[:] = controls[i // substeps]
        if i == total - 1:
            mujoco.mj_forward(model, data)
        else:
            mujoco.mj_step(model, data)
    return data
