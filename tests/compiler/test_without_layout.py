"""Sensors without taxels need no layout: they may be on any body of the robot."""

import sys
from pathlib import Path

import pytest
import torch

import tgdsl
from tgdsl.compiler.pipeline import placed
from tgdsl.errors import SpecError
from tgdsl.plan.inputs import ContactPart

sys.path.append(str(Path(__file__).parents[2] / "examples" / "plugins"))

from accelerometer import ACCELEROMETER

HAND = """<mujoco><worldbody>
  <body name="finger"><joint axis="1 0 0" stiffness="10"/><geom name="finger" type="box" size=".03 .03 .01"/>
    <body name="skin" pos="0 0 .011"><geom name="skin" type="box" size=".03 .03 .001"/></body>
    <body name="camera" pos="0 .1 0"/>
  </body>
  <body name="cube" pos="0 .005 .0315"><freejoint/><geom name="cube" type="box" size=".02 .02 .02" mass=".3"/></body>
</worldbody></mujoco>"""
DOCUMENT = """tgdsl: 1
robot: {model: hand.xml}
objects: {cube: {body: cube}}
sensors:
  load: {kind: link_contact, links: finger, feels: [cube]}
"""
MISSING = 'd.yaml:2:1: robot: missing key "layout"; only robots given by name bring their own layout'
LAYOUT = "{resolutions: {low: {finger: {method: points, radius: 0.004, points: [{pos: [0, 0, 0.01], normal: [0, 0, 1]}]}}}}"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "d.yaml").write_text(DOCUMENT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def problems(text, kinds=()):
    Path("d.yaml").write_text(text)
    with pytest.raises(SpecError) as error:
        tgdsl.compile("d.yaml", kinds=kinds)
    return str(error.value).splitlines()


def test_readings_are_the_same_with_and_without_a_layout(folder):
    """The artefact loads, and its explanation names no resolution."""
    touch = tgdsl.compile("d.yaml")
    assert touch.plan.layout.num_taxels == 0 and touch.plan.origin.resolution == ""
    (folder / "full.yaml").write_text(DOCUMENT.replace("model: hand.xml", f"model: hand.xml, layout: {LAYOUT}"))
    state = tgdsl.simulate(touch, 1).state()
    reading = touch(state)["load"]
    full = tgdsl.compile("full.yaml")
    assert torch.equal(reading, full(state)["load"]) and reading[0, 0, 0] == 1 and reading[0, 0, 3] < -1
    tgdsl.save(touch, "d.safetensors")
    loaded = tgdsl.load("d.safetensors")
    assert torch.equal(loaded(state)["load"], reading)
    text = loaded.explain()
    assert text.startswith("hand.xml, 0 taxels\n") or "hand.xml, 0 taxels\n" in text
    assert "bodies  finger" in text and "at resolution" not in text + repr(touch)
    assert "at resolution low" in repr(full)


def test_any_body_is_a_separate_link(folder):
    """Bodies without taxels or geoms get a row each; a body welded to a link is part of it unless it is listed."""
    assert tgdsl.compile("d.yaml").inputs.link_parts == {"finger": (ContactPart("subtree", "finger"),)}
    touch = tgdsl.compile("d.yaml", overrides={"sensors.load.links": ["finger", "skin", "camera"]}, dtype=torch.float64)
    assert touch.inputs.link_parts == {}
    reading = touch(tgdsl.simulate(touch, 1).state())["load"]
    assert touch.outputs[0].bodies == ("finger", "skin", "camera")
    assert reading[0, :, 0].tolist() == [0, 1, 0]


def test_a_kind_on_links_needs_none_either(folder):
    document = {"tgdsl": 1, "robot": {"model": "hand.xml"}, "sensors": {"imu": {"kind": "accelerometer", "links": "finger"}}}
    touch = tgdsl.compile(document, kinds=(ACCELEROMETER,))
    assert touch(tgdsl.simulate(touch, 1).state())["imu"].shape == (1, 1, 3)


def test_kinds_on_taxels_need_one(folder):
    """Alone, with other kinds, and without sensors; a missing layout file is reported at its name."""
    assert problems(DOCUMENT.replace("link_contact", "contact")) == [MISSING]
    assert problems(DOCUMENT + "  touch: {kind: contact, links: finger, feels: [cube]}\n") == [MISSING]
    with pytest.raises(SpecError, match='robot: missing key "layout"'):
        placed({"tgdsl": 1, "robot": {"model": "hand.xml"}})
    assert problems(DOCUMENT.replace("model: hand.xml", "model: hand.xml, layout: lay.yaml")) == [
        'd.yaml:2:34: robot.layout: there is no file "lay.yaml"; paths are relative to this document'
    ]


def test_resolutions_and_unknown_links_are_refused_without_a_layout(folder):
    assert problems(DOCUMENT + "resolution: low\n") == [
        'd.yaml:6:13: resolution: there is no layout, which could have a resolution "low"; leave it out, or give the robot a layout'
    ]
    assert problems(DOCUMENT.replace("links: finger", "links: fingr")) == [
        'd.yaml:5:37: sensors.load.links: no link matches "fingr"; did you mean "finger"?'
    ]
    assert problems(DOCUMENT.replace("links: finger", 'links: {include: ["*"], exclude: ["*"]}')) == [
        "d.yaml:5:37: sensors.load.links: `exclude` leaves no link"
    ]


def test_commands_work_without_a_layout(folder, here):
    """`compile`, `explain` and `run` work; `render` reports that there is nothing to draw."""
    code, out, _ = here(folder, "compile", "d.yaml")
    assert code == 0 and out.startswith("0 taxels on 0 links\nsensors: load (link_contact, 1)\n")
    assert here(folder, "explain", "d.yaml")[0] == 0
    code, _, err = here(folder, "render", "d.yaml")
    assert code != 0 and "there is nothing to draw: no layout has a taxel" in err
    code, out, _ = here(folder, "run", "d.yaml", "--seconds", "0.02")
    assert code == 0 and out.endswith("nothing is drawn: no reading is of taxels, of the bodies that carry them, or of cells\n")
