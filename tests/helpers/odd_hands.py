"""Hands that nobody has described, what should be made of them, and how to compile a document about one."""

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

import tgdsl
from tgdsl.commands.cli import main

BALL = 0.008
"""Radius of the ball that is felt [m]."""
# Two fingers of three links that one tendon pulls each, on a floating base; names, classes and shapes of all sorts.
TENDON = """
<mujoco model="tendon hand">
  <default>
    <geom friction=".8"/>
    <default class="finger"><joint type="hinge" axis="0 1 0" range="0 90" damping=".1"/><geom type="capsule" size=".006 .012"/>
      <default class="phalanx"><geom pos="0 0 .015"/>
        <default class="last"><geom type="box" size=".006 .006 .012"/><default class="pad"><geom type="ellipsoid"/></default></default>
      </default>
    </default>
  </default>
  <worldbody>
    <body name="hand/base link" pos="0 0 .3">
      <freejoint/>
      <geom type="box" size=".04 .03 .008" mass=".4"/>
      <geom type="cylinder" size=".02 .02" pos="0 0 -.02"/>
      <site name="a0" pos=".03 0 .005"/><site name="b0" pos="-.03 0 .005"/>
      <body name="hand/f.1/proximal" pos=".035 0 .01" euler="0 0 180" childclass="phalanx">
        <joint/><geom/><site name="a1" pos=".006 0 .02"/>
        <body name="hand/f.1/middle" pos="0 0 .034"><joint/><geom/><site name="a2" pos=".006 0 .02"/>
          <body name="hand/f.1/the tip" pos="0 0 .034" childclass="last"><joint/><geom/>
            <geom class="pad" size=".008 .006 .01" pos=".003 0 .015"/><site name="a3" pos=".006 0 .02"/></body>
        </body>
      </body>
      <body name="hand/f.2/proximal" pos="-.035 0 .01" childclass="phalanx">
        <joint/><geom/><site name="b1" pos=".006 0 .02"/>
        <body name="hand/f.2/middle" pos="0 0 .034"><joint/><geom/><site name="b2" pos=".006 0 .02"/>
          <body name="hand/f.2/the tip" pos="0 0 .034" childclass="last"><joint/><geom/>
            <geom class="pad" size=".008 .006 .01" pos=".003 0 .015"/><site name="b3" pos=".006 0 .02"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="a"><site site="a0"/><site site="a1"/><site site="a2"/><site site="a3"/></spatial>
    <spatial name="b"><site site="b0"/><site site="b1"/><site site="b2"/><site site="b3"/></spatial>
  </tendon>
  <actuator><motor tendon="a"/><motor tendon="b"/></actuator>
</mujoco>
"""
# A gripper of two four-bars: driver and rocker are children of the base, the finger of the driver, and a connect closes the loop.
# The bracket is behind the base.
_SIDE = """
      <body name="{0}_driver" pos="{1} 0 .02" euler="0 0 {2}"><joint axis="0 1 0" range="0 45"/>
        <geom type="cylinder" fromto="0 0 0 0 0 .03" size=".004"/>
        <body name="{0}_finger" pos="0 0 .04"><joint axis="0 1 0" range="-45 45"/>
          <geom type="box" size=".005 .008 .02" pos=".004 0 .02"/>
          <body name="{0}_pad" pos=".011 0 .03"><geom name="{0}_rubber" type="box" size=".002 .008 .01"/></body>
        </body>
      </body>
      <body name="{0}_rocker" pos="{3} 0 .02" euler="0 0 {2}"><joint axis="0 1 0" range="0 45"/>
        <geom type="cylinder" fromto="0 0 0 0 0 .03" size=".003"/></body>"""
FOUR_BAR = f"""
<mujoco>
  <option><flag gravity="disable"/></option>
  <worldbody>
    <geom type="plane" size="1 1 .1" pos="0 0 -.1"/>
    <body name="base"><geom type="box" size=".05 .02 .015"/>{_SIDE.format("left", 0.03, 180, 0.045)}{_SIDE.format("right", -0.03, 0, -0.045)}
      <body name="bracket" pos="0 0 -.02"><geom type="box" size=".01 .01 .005"/></body>
      <body name="camera" pos="0 0 -.05"/>
    </body>
  </worldbody>
  <equality>
    <connect body1="left_rocker" body2="left_finger" anchor="0 0 .04"/>
    <connect body1="right_rocker" body2="right_finger" anchor="0 0 .04"/>
  </equality>
</mujoco>
"""
# No mesh and no box; bodies that are called like groups, and one like a pattern.
CAPSULES = """
<mujoco>
  <default><geom type="capsule" size=".008"/><joint axis="0 -1 0" range="-10 95"/></default>
  <worldbody>
    <body name="wrist"><joint axis="1 0 0" range="-30 30"/><geom fromto="0 0 -.06 0 0 -.03" size=".015"/>
      <body name="palm">
        <joint axis="0 1 0" range="-30 30"/>
        <geom fromto="0 -.03 0 0 .03 0"/><geom fromto="0 -.03 .015 0 .03 .015"/><geom fromto="0 -.03 .03 0 .03 .03"/>
        <body name="f[1]" pos="0 .025 .045"><joint/><geom fromto="0 0 .005 0 0 .03"/>
          <body name="tips" pos="0 0 .04"><joint/><geom fromto="0 0 .005 0 0 .02"/></body></body>
        <body name="f[2]" pos="0 -.025 .045"><joint/><geom fromto="0 0 .005 0 0 .03"/>
          <body name="f[2] end" pos="0 0 .04"><joint/><geom fromto="0 0 .005 0 0 .02"/></body></body>
        <body name="thumb" pos="-.05 0 .02"><joint axis="0 1 0"/><geom fromto="0 0 .005 0 0 .03"/>
          <body name="thumb end" pos="0 0 .04"><joint axis="0 1 0"/><geom fromto="0 0 .005 0 0 .02"/></body></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
# Only visual geoms, a mesh among them; jaws that slide on the world itself; a table, an unnamed body and a target stand by.
VISUAL = """
<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <asset><mesh name="wedge" vertex="0 -.01 0  0 .01 0  0 -.01 .04  0 .01 .04  .01 -.01 0  .01 .01 0"/></asset>
  <worldbody>
    <body name="jaw a" pos=".02 0 0"><joint type="slide" axis="1 0 0" range="0 .03"/><geom type="mesh" mesh="wedge"/>
      <geom type="sphere" size=".006" pos="0 0 .03"/></body>
    <body name="jaw b" pos="-.02 0 0" euler="0 0 180"><joint type="slide" axis="1 0 0" range="0 .03"/><geom type="mesh" mesh="wedge"/></body>
    <body name="table" pos="0 0 -.5"><geom type="box" size=".2 .2 .1"/></body>
    <body name="floor"><geom type="plane" size="1 1 .1" pos="0 0 -1"/></body>
    <body name="target" mocap="true"><geom size=".01" pos="0 0 .5"/></body>
    <body pos="0 0 -.7"><geom size=".01"/></body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class OddHand:
    """A hand, and what should be made of it."""

    text: str
    tips: tuple[str, ...]
    palm: tuple[str, ...]
    fingers: tuple[str, ...]
    others: tuple[str, ...] = ()
    facing: tuple[tuple[str, tuple[float, ...] | None], ...] = ()
    collides: bool = True


HANDS = {
    "tendon": OddHand(
        TENDON,
        tips=("hand/f.1/the tip", "hand/f.2/the tip"),
        palm=("hand/base link",),
        fingers=tuple(f"hand/f.{i}/{part}" for i in (1, 2) for part in ("proximal", "middle", "the tip")),
        facing=(("hand/f.1/the tip", (1, 0, 0)), ("hand/f.2/middle", (1, 0, 0)), ("hand/base link", (0, 0, 1))),
    ),
    "four_bar": OddHand(
        FOUR_BAR,
        tips=("left_pad", "right_pad"),
        palm=("base",),
        fingers=tuple(f"{side}_{part}" for side in ("left", "right") for part in ("driver", "finger", "pad", "rocker")),
        facing=(("left_pad", (1, 0, 0)), ("right_pad", (1, 0, 0)), ("base", (0, 0, 1))),
    ),
    "capsules": OddHand(
        CAPSULES,
        tips=("tips", "f[2] end", "thumb end"),
        palm=("palm",),
        fingers=("f[1]", "tips", "f[2]", "f[2] end", "thumb", "thumb end"),
        facing=(("tips", (-1, 0, 0)), ("f[2]", (-1, 0, 0)), ("thumb end", (1, 0, 0)), ("palm", (-1, 0, 0))),
    ),
    "visual": OddHand(
        VISUAL,
        tips=("jaw a", "jaw b"),
        palm=(),
        fingers=("jaw a", "jaw b"),
        facing=(("jaw a", (-1, 0, 0)), ("jaw b", (-1, 0, 0))),
        collides=False,
    ),
}


def command(folder: Path, *arguments: str) -> int:
    """Run a command in a folder; return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["tgdsl", *arguments])
        patch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
        try:
            main()
        except SystemExit as ended:
            return int(ended.code or 0)
    return 0


def compiled(folder: Path, gates: dict[str, str], resolution: str = "med") -> tgdsl.TactileModule:
    """Compile a document that puts a sensor on each of some groups, in a scene that includes the hand and a ball."""
    ball = f'<body name="the ball" pos="0 0 5"><freejoint/><geom type="sphere" size="{BALL}" mass=".01"/></body>'
    (folder / "scene.xml").write_text(f'<mujoco><include file="hand.xml"/><worldbody>{ball}</worldbody></mujoco>')
    lines = [
        "tgdsl: 1",
        "robot: {model: hand.xml, layout: layout.yaml}",
        "scene: {model: scene.xml}",
        "objects: {ball: {body: the ball}}",
        f"resolution: {resolution}",
        "sensors:",
        *(f"  {g}: {{kind: contact_depth, links: {g}, feels: [ball], gate: {gate}}}" for g, gate in gates.items()),
    ]
    (folder / "document.yaml").write_text("\n".join(lines))
    return tgdsl.compile(folder / "document.yaml", dtype=torch.float64)
