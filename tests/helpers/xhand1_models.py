"""A small model with the joints and fingertips of an XHand1, and a plate that they press on when they bend."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

FINGERS = {
    "thumb_rota_link2": ("thumb_bend_joint", "thumb_rota_joint1", "thumb_rota_joint2"),
    "index_rota_link2": ("index_bend_joint", "index_joint1", "index_joint2"),
    "mid_link2": ("mid_joint1", "mid_joint2"),
    "ring_link2": ("ring_joint1", "ring_joint2"),
    "pinky_link2": ("pinky_joint1", "pinky_joint2"),
}
"""Joints of each fingertip's finger, from the palm on."""
JOINTS = tuple(joint for joints in FINGERS.values() for joint in joints)
TIPS = tuple(FINGERS)


def hand_xml(
    side: str = "right", actuators: Sequence[str] = JOINTS, tips: Sequence[str] = TIPS, actuator: str = 'position kp="1"'
) -> str:
    """Return the MJCF of a hand: bodies in the order of `tips`, actuators in that of `actuators`."""
    bodies = []
    for i, tip in enumerate(tips):
        finger = '<geom type="box" size=".008 .008 .01" pos="0 0 .02" mass=".02"/>'
        name = f"{side}_hand_{tip}"
        for joint in reversed(FINGERS[tip]):
            place = f"0 {0.03 * i} 0" if joint == FINGERS[tip][0] else "0 0 .01"
            joint_xml = f'<joint name="{side}_hand_{joint}" axis="0 1 0" range="-1 1" damping=".02" armature=".001"/>'
            finger = f'<body name="{name}" pos="{place}">{joint_xml}{finger}<geom size=".003" mass=".01" contype="0"/></body>'
            name = f"{joint}_body"
        bodies.append(finger)
    drives = "".join(f'<{actuator} name="{side}_{name}" joint="{side}_hand_{name}"/>' for name in actuators)
    return f"""
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="plate" pos=".025 .06 .03"><geom type="box" size=".01 .1 .05" contype="2" conaffinity="2"/></body>
    <body name="palm" pos="0 0 0"><geom size=".001" contype="0" conaffinity="0"/>{"".join(bodies)}</body>
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>
""".replace('mass=".02"/>', 'mass=".02" contype="2" conaffinity="2"/>')


def document(
    folder: Path, observations: dict[str, Any], xml: str | None = None, side: str = "right", **sensors: dict[str, Any]
) -> dict[str, Any]:
    """Return a document with the sensors `depth` and `contact` on the fingertips; `depth={...}` adds to a sensor's fields."""
    (folder / "hand.xml").write_text(hand_xml(side) if xml is None else xml)
    points = [{"pos": [0.008, y, z], "normal": [1, 0, 0]} for y in (-0.004, 0.004) for z in (0.014, 0.02, 0.026)]
    tilted = [{"pos": [0.008, 0, 0.03], "normal": [0.8, 0, 0.6]}]
    tip = {"method": "points", "points": points + tilted, "radius": 0.004}
    kinds = {"depth": "contact_depth", "contact": "contact"}
    plain = {name: {"kind": kind, "links": "*", "feels": ["plate"]} for name, kind in kinds.items()}
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "hand.xml"),
            "layout": {"resolutions": {"r": {f"{side}_hand_{name}": tip for name in TIPS}}},
        },
        "objects": {"plate": {"body": "plate"}},
        "sensors": {name: {**fields, **sensors.get(name, {})} for name, fields in plain.items()}
        | {name: fields for name, fields in sensors.items() if name not in plain},
        "observations": observations,
    }
