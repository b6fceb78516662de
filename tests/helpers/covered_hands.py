"""Hands some of whose links the simulator does not collide, fills by a hull, or covers by another link at rest."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.layout.layout import Layout, Link

PROFILE = ((0, 0), (0.03, 0), (0.03, 0.01), (0.01, 0.01), (0.01, 0.03), (0, 0.03))
"""An L in the x–y plane [m]; its hull adds the triangle between its inner corner and the line x + y = 40 mm."""
HEIGHT = 0.04
HOLLOW = 0.01 / np.sqrt(2)
"""Distance of the middle of an inner side, (10, 20) mm, from the hull's face x + y = 40 mm [m]; the next side is 10 mm away."""
_TOP = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]


def shell(name: str = "shell", side: int = 1) -> str:
    """Return a mesh: the L, extruded along z; `side` −1 is its mirror image in the x–z plane."""
    points = [(x, side * y, z) for z in (0, HEIGHT) for x, y in PROFILE]
    walls = [f for i in range(6) for f in ((i, (i + 1) % 6, 6 + (i + 1) % 6), (i, 6 + (i + 1) % 6, 6 + i))]
    faces = [*walls, *(tuple(6 + i for i in f) for f in _TOP), *(f[::-1] for f in _TOP)]
    faces = faces if side > 0 else [f[::-1] for f in faces]
    text = [" ".join(f"{x:g}" for row in rows for x in row) for rows in (points, faces)]
    return f'<mesh name="{name}" vertex="{text[0]}" face="{text[1]}"/>'


def hand(side: int = 1) -> str:
    """Return a hand: a palm that is an L, a plate welded to it, a finger that begins inside it, and links not collided.

    Its joints are balls, so that nothing says how it closes. The finger's first 8 mm are inside the palm at rest, and its second
    link is not collided; the thumb collides with the cube alone, by an explicit pair; `cube` floats, partly inside the palm.
    """
    return f"""
<mujoco model="hand">
  <asset>{shell("shell", side)}</asset>
  <worldbody>
    <geom type="plane" size="1 1 1" pos="0 0 .02"/>
    <body name="palm">
      <geom name="palm" type="mesh" mesh="shell"/>
      <body name="plate" pos="-.002 {side * 0.015} .02"><geom name="plate" type="box" size=".006 .005 .01"/></body>
      <body name="finger" pos=".022 {side * 0.005} .02">
        <joint name="bend" type="ball"/>
        <geom name="finger" type="box" size=".02 .003 .003" pos=".02 0 0"/>
        <body name="the tip" pos=".04 0 0">
          <joint type="ball"/><geom name="nail" type="sphere" size=".004" contype="0" conaffinity="0"/>
        </body>
      </body>
      <body name="thumb" pos="-.05 0 .02">
        <joint type="ball"/><geom name="thumb" type="mesh" mesh="shell" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="cube" pos="0 {side * 0.03} 0"><freejoint/><geom name="cube" type="box" size=".01 .01 .01"/></body>
  </worldbody>
  <contact><pair geom1="thumb" geom2="cube"/></contact>
</mujoco>
"""


def model(folder: Path, text: str) -> Model:
    """Return a robot of a text."""
    (folder / "hand.xml").write_text(text)
    return load_model(folder / "hand.xml")


def layout(points: dict[str, Sequence[Sequence[float]]], radius: float = 0.002) -> Layout:
    """Return a layout of points in the frames of bodies, whose normals do not matter."""
    count = [len(own) for own in points.values()]
    pos = np.concatenate([np.array(own, dtype=float) for own in points.values()])
    fixed = np.tile(np.eye(3)[2], (len(pos), 1)), np.tile(np.eye(3)[0], (len(pos), 1))
    sizes = np.full(len(pos), radius), np.full(len(pos), 1e-6), np.full((len(pos), 2), -1)
    links = tuple(Link(name, name) for name in points)
    return Layout(links, {}, np.repeat(np.arange(len(links)), count), pos, *fixed, *sizes)
