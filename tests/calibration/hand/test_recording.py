"""Logs of a hand as recordings: fit a fingertip's stiffness from a press, and name what a log lacks."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hand_logs import random_readings, write_log

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.wire.protocol import JOINTS

HAND = Path(__file__).parents[3] / "robots" / "xhand1" / "xhand1_right.xml"
SCENE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option integrator="implicitfast" cone="elliptic"/>
  <asset><model name="xhand1" file="{hand}"/></asset>
  <worldbody>
    <attach model="xhand1" body="right_hand_link" prefix=""/>
    <body name="post" pos="{pos}">{joint}<geom type="sphere" size=".02"/></body>
  </worldbody>
</mujoco>
"""
TIP = "right_hand_index_rota_link2"
STIFFNESS, PER_COUNT = 400.0, 0.002
"""Stiffness of each taxel [N/m], and the hand's force per count [N]."""
BEND = 0.6
"""Angle of the index finger's first joint when its tip touches the post [rad]."""
NEWTONS = replace(Calibration.none(), units="N", scale=np.full((5, 3), PER_COUNT))


def document(stiffness=300.0, links=TIP):
    law = {"normal_stiffness": stiffness, "depth_exponent": 1, "normal_damping": 0, "shear_damping": 0}
    return {
        "tgdsl": 1,
        "robot": {"model": "xhand1"},
        "scene": {"model": "scene.xml"},
        "resolution": "low",
        "objects": {"post": {"body": "post"}},
        "sensors": {"tip": {"kind": "kinematic_taxel", "links": links, "feels": ["post"], "gate": "geometric"} | law},
    }


def posed(angles):
    """Return the scene in MuJoCo with the hand's joints at these angles [rad], in the order of their ids."""
    model = mujoco.MjModel.from_xml_path("scene.xml")
    data = mujoco.MjData(model)
    for name, angle in zip(JOINTS, angles, strict=True):
        data.joint(f"right_hand_{name}").qpos = angle
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a scene: a post at the position of the bent index fingertip."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE.format(hand=HAND, pos="0 0 1", joint=""))
    taxels = tgdsl.compile(document()).taxels["tip"]
    outward = taxels["normal"].mean(axis=0)
    _, data = posed(bent(np.array([BEND]))[0])
    tip = data.body(TIP)
    at = tip.xpos + tip.xmat.reshape(3, 3) @ (taxels["pos"].mean(axis=0) + 0.02 * outward / np.linalg.norm(outward))
    (tmp_path / "scene.xml").write_text(SCENE.format(hand=HAND, pos=" ".join(map(str, at)), joint=""))
    return tmp_path


def bent(angle):
    """Return joint angles [rad] with the index finger bent, (step, joint)."""
    return np.where([name == "index_joint1" for name in JOINTS], angle[:, None], 0.0)


def log_of(folder, calibration=NEWTONS):
    """Return a log of a hand whose index fingertip presses the post, with the true stiffness."""
    readings, touch = random_readings(4.0 + np.arange(30) / 30), tgdsl.compile(document(STIFFNESS), dtype="float64")
    states, force = [], np.zeros((30, 5, 3))
    for i, angles in enumerate(bent(BEND + 0.04 * np.sin(np.linspace(0, 6, 30))).astype(np.float32)):
        states.append(replace(readings[i].state, position=angles))
        force[i, 1] = touch(tgdsl.read_mujoco(touch, *posed(angles)))["tip"][0, :, :3].sum(dim=0)
    counts = np.round(NEWTONS.counts_of(force)).astype(np.int16)
    assert np.abs(counts[:, 1]).max() > 100
    readings = [replace(r, state=replace(s, total_force=c)) for r, s, c in zip(readings, states, counts, strict=True)]
    return write_log(folder / "press.npz", readings, calibration=calibration)


def test_the_stiffness_of_a_fingertip_is_found(folder):
    fit = tgdsl.calibrate(document(), log_of(folder), ["tip.normal_stiffness"])
    parameter = fit.parameters["tip.normal_stiffness"]
    assert parameter.value == pytest.approx(STIFFNESS, rel=5e-3)


def test_everything_that_a_log_lacks_is_named_at_once(folder):
    log = log_of(folder, calibration=None)
    (folder / "scene.xml").write_text(SCENE.format(hand=HAND, pos="0 0 1", joint="<freejoint/>"))
    with pytest.raises(SpecError) as error:
        tgdsl.calibrate(document(links="tips"), log, ["tip.normal_stiffness"])
    for part in ("lacks the poses of post, which can move", "forces are counts", "the taxels of one fingertip"):
        assert part in str(error.value)
    assert str(error.value).count(str(log)) == 3
