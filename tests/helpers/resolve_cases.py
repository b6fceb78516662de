"""A small hand and documents about it, for the tests of what documents mean."""

from pathlib import Path

import pytest

import tgdsl
from tgdsl.compiler.resolve import Resolved, resolve
from tgdsl.errors import SpecError
from tgdsl.schema.load import load

HAND = """
<mujoco>
  <asset>
    <mesh name="skin" vertex="0 0 0  .01 0 0  0 .01 0  0 0 .01"/>
  </asset>
  <worldbody>
    <body name="palm">
      <freejoint/>
      <geom name="palm" type="box" size=".03 .03 .01"/>
      <geom name="back" type="box" size=".02 .02 .005" pos="0 0 -.015"/>
      <body name="index_1" pos=".04 0 0">
        <joint axis="0 1 0"/>
        <geom name="index_bone" type="box" size=".01 .01 .01" contype="0" conaffinity="0"/>
        <geom name="index_pad" type="box" size=".012 .01 .01"/>
        <body name="index_2" pos=".03 0 0"><joint axis="0 1 0"/><geom type="mesh" mesh="skin"/></body>
      </body>
      <body name="thumb_1" pos="0 .05 0">
        <joint axis="0 1 0"/>
        <geom name="thumb_pad" type="sphere" size=".01"/>
        <body name="thumb_2" pos="0 .03 0"><joint axis="0 1 0"/><geom type="mesh" mesh="skin"/></body>
        <body name="frame" pos="0 0 .1"/>
      </body>
    </body>
    <body name="cube" pos="0 0 1"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
    <body name="rock" pos="1 0 1"><freejoint/><geom name="pebble" type="mesh" mesh="skin"/></body>
    <body name="ghost" pos="2 0 1"><freejoint/><geom size=".1" mass="1" contype="0" conaffinity="0"/></body>
    <body name="nothing" pos="3 0 1"/>
  </worldbody>
</mujoco>
"""
POINT = {"method": "points", "points": [{"pos": [0, 0, 0], "normal": [0, 0, 1]}], "radius": 0.001}
PLACE = "{method: points, radius: 1 mm, points: [{pos: [0, 0, 0], normal: [0, 0, 1]}]}"
DOCUMENT = """tgdsl: 1
robot:
  model: hand.xml
  layout:
    groups:
      tips: ["*_2"]
      index: {include: ["index_*"]}
      thumb: {include: ["thumb*"], exclude: [tips]}
      all: {include: [index, thumb, palm]}
    resolutions:
      low:
        palm: PLACE
        index_1: PLACE
        index_2: PLACE
        thumb_pad: PLACE
      tip:
        index_2: PLACE
objects: {cube: {body: cube}}
resolution: low
sensors:
  touch: {kind: contact_depth, links: all, feels: [cube]}
""".replace("PLACE", PLACE)


def resolved(folder: Path, text: str = DOCUMENT) -> Resolved:
    (folder / "d.yaml").write_text(text)
    loaded = load(folder / "d.yaml")
    return resolve(loaded)


def with_layout(folder: Path, placements: dict, links: object = "*", **layout: object) -> Resolved:
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "hand.xml"), "layout": {**layout, "resolutions": {"only": placements}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"touch": {"kind": "contact_depth", "links": links, "feels": ["cube"]}},
    }
    return resolve(load(document))


def problems(folder: Path, *changes: tuple[str, str], text: str = DOCUMENT) -> list[str]:
    """Return the messages of a document with some text replaced, the file's folder left out."""
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "d.yaml").write_text(text)
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(folder / "d.yaml")
    return [line.removeprefix(f"{folder}/") for line in str(caught.value).splitlines()]
