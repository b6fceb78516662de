"""A pad and a finger with bodies welded to them, an item that presses on these, and what MuJoCo solves of it."""

import mujoco
import numpy as np
import torch
from pressed_pads import of_kinds

import tgdsl
from tgdsl.plan.inputs import ContactPart
from tgdsl.runtime.batch.simulation import BatchSimulation

ITEM = '<body name="item" pos="0 0 {z}"><freejoint/><geom name="item" type="box" size=".02 .02 .02" mass=".3"/></body>'
SKIN = """
<body name="pad"><geom name="pad" type="box" size=".06 .06 .009"/>
  <body {name} pos="0 0 .0095" quat=".7071067811865476 0 0 .7071067811865476">
    <geom name="skin" type="box" size=".05 .06 .0005"/>
  </body>
</body>"""
ON_SKIN = ITEM.format(z=".0299")
ITEMS = {"item": {"body": "item"}}
GATED = {
    "depth": {"kind": "contact_depth", "feels": ["item"]},
    "touch": {"kind": "kinematic_taxel", "outputs": ["force"], "feels": ["item"]},
    "bit": {"kind": "contact", "feels": ["item"]},
    "skin": {"kind": "elastomer", "feels": ["item"]},
}
HAND = """
<mujoco><option timestep=".002" tolerance="1e-14" iterations="200"/><worldbody>
  <body name="palm" pos=".1 -.2 .3" euler="10 -30 50">{wrist}
    <geom name="palm" type="box" size=".02 .02 .02" pos="-.1 0 0"/>
    <body name="finger" pos=".02 0 .01" euler="20 40 -30">{knuckle}
      <geom name="core" type="box" size=".03 .02 .01"/>
      <{welded} {skin} pos=".04 .02 .006" euler="2 -3 70">
        <geom name="skin" type="box" size=".015 .01 .005" pos="0 .01 0" euler="0 4 0" friction=".4"/>
        <geom name="seen" type="sphere" size=".03" contype="0" conaffinity="0" mass="0"/>
        <{welded} {nail} pos=".025 -.01 0" euler="30 0 90"><geom name="nail" type="sphere" size=".004"/></{welded}>
      </{welded}>
      {more}
    </body>
  </body>
  <body name="item" pos="{pos}" quat="{quat}"><freejoint/>
    <geom name="item" type="box" size=".06 .06 .01" mass=".3"/>
    <body name="handle" pos="0 0 .01"><geom name="handle" type="capsule" size=".012" fromto="-.04 0 0 .04 0 0" mass=".1"/></body>
  </body>
</worldbody></mujoco>"""
JOINTS = {"wrist": '<joint axis="0 1 .2"/>', "knuckle": '<joint axis="1 0 .3" pos=".01 .02 0"/>'}
FIXED = {"wrist": "", "knuckle": ""}
NAMES = {"skin": 'name="skin"', "nail": 'name="nail"'}
UNNAMED = {"skin": "", "nail": ""}
POINTS = [{"pos": [x, y, 0.01], "normal": [0, 0, 1], "radius": 0.004} for x in (-0.02, 0, 0.02) for y in (-0.01, 0.01)]
HINGED = '<body name="tip" pos="-.03 0 0"><joint axis="0 0 1"/><geom name="tip" type="sphere" size=".011" mass=".01"/></body>'
FLAP = '<body name="flap" pos="0 -.05 0"><joint axis="1 0 0"/><geom name="flap" size=".005" mass=".01"/></body>'
FORCE = {"kind": "link_contact", "feels": ["item"], "outputs": ["force"]}


def parts(*names, kind="body"):
    return tuple(ContactPart(kind, name) for name in names)


def hand(welded="body", more="", **parts):
    """Return the hand with the item pressed 1 mm into the finger's core; a body, or a frame, is welded to it."""

    def text(pos=(0, 0, 0), quat=(1, 0, 0, 0)):
        own = {**NAMES, **JOINTS, **parts, "pos": " ".join(map(repr, pos)), "quat": " ".join(map(repr, quat))}
        return HAND.format(welded=welded, more=more, **own)

    model = mujoco.MjModel.from_xml_string(text())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    finger, pos = data.body("finger"), np.zeros(3)
    mujoco.mju_rotVecQuat(pos, np.array([0.02, 0.01, 0.019]), finger.xquat)
    return text((pos + finger.xpos).tolist(), finger.xquat.tolist())


def gripped(folder, text, objects=ITEMS, sensors=None, layout=None, dtype=torch.float64):
    """Return a module of the hand's finger, which carries six taxels unless a layout says otherwise."""
    (folder / "hand.xml").write_text(text)
    points = {"method": "points", "points": POINTS}
    places = dict.fromkeys(layout or ["finger"], points)
    kinds = of_kinds(["item"]) | GATED
    kinds["shared"] |= {"slots": 16, "footprint": 0.1}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "hand.xml"), "layout": {"resolutions": {"r": places}}},
        "objects": objects,
        "sensors": sensors or {name: {"links": "finger", **own} for name, own in kinds.items()},
    }
    return tgdsl.compile(document, dtype=dtype)


def solved(sim, names):
    """Return where the finger is, and MuJoCo's contacts between geoms of those names and the item: place, force, torque on it."""
    data = mujoco.MjData(sim.model)
    data.qpos[:] = sim.batch.qpos[0] if isinstance(sim, BatchSimulation) else sim.arrays["qpos"][0].numpy()
    mujoco.mj_forward(sim.model, data)
    found = []
    for i, contact in enumerate(data.contact):
        own = [sim.model.geom(g).name for g in contact.geom]
        if not (set(own) & set(names) and set(own) & {"item", "handle"}):
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(sim.model, data, i, wrench)
        sign = 1 if own[1] in names else -1  # MuJoCo's is on the second of the two geoms
        force, torque = (sign * contact.frame.reshape(3, 3).T @ part for part in (wrench[:3], wrench[3:]))
        found.append((contact.pos.copy(), force, torque))
    finger = data.body("finger")
    return finger.xpos.copy(), finger.xmat.reshape(3, 3).copy(), found
