"""Compiled masses survive USD, whatever the compiler options."""

import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdPhysics

from tgdsl.errors import RobotError
from tgdsl.formats.robot import export_model, load_model

SCENE = """
<mujoco>
  <compiler {options}/>
  <default><geom density="700"/></default>
  <worldbody>
    <body name="table" pos="0 0 -.2"><geom type="box" size=".3 .3 .02" group="1"/></body>
    <body name="stand" pos=".5 0 0"><inertial pos="0 0 .1" mass="2" diaginertia="0 0 0"/><geom size=".1" group="2"/></body>
    <body name="disc" pos="-.5 0 0"><inertial pos="0 0 .1" quat=".9 .1 .3 .2" mass="1" diaginertia=".2 0 .2"/><geom size=".1"/></body>
    <body name="palm" pos="0 0 .3">
      <inertial pos=".01 .02 .03" quat=".8 .1 .3 .2" mass=".4" diaginertia=".002 .0011 .0025"/>
      <joint axis="0 1 0"/><geom type="box" size=".05 .02 .03" group="0"/>
      <body name="finger" pos=".1 0 0"><joint axis="0 1 0"/>
        <geom type="capsule" size=".01 .04" quat=".3 .5 .1 .8" group="1"/>
        <geom type="box" size=".02 .01 .03" pos="0 .01 .02" quat=".9 .2 0 .1" group="3"/>
        <geom type="ellipsoid" size=".02 .03 .03" pos=".1 0 0" contype="0" conaffinity="0" group="4"/>
        <body name="camera" pos="0 0 .1"><geom size=".02" group="5" mass="0"/></body>
        <body name="frame" pos="0 0 .1"/>
      </body>
      <body name="thumb" pos="0 .1 0"><joint axis="1 0 0"/><geom type="cylinder" size=".01 .05" group="1"/></body>
    </body>
    <body name="ball" pos="0 0 1"><freejoint/><geom type="ellipsoid" size=".03 .02 .01" pos=".01 .02 0" contype="0" group="1"/></body>
  </worldbody>
</mujoco>
"""
"""Bodies with and without mass or moments, fixed and moving, with geoms of many groups."""
OPTIONS = {
    "none": "",
    "groups": "inertiagrouprange='1 3'",
    "no geoms": "inertiagrouprange='1 1'",
    "from geoms": "inertiafromgeom='true' inertiagrouprange='0 3'",
    "total": "settotalmass='3.5'",
    "bounds": "boundmass='.05' boundinertia='.0004'",
    "balanced": "balanceinertia='true'",
    "degrees": "angle='degree'",
    "radians": "angle='radian'",
    "fused": "fusestatic='true'",
    "aligned": "alignfree='true'",
    "discarded": "discardvisual='true'",
}
EXACT = 1e-14


@pytest.mark.filterwarnings("ignore:.*USD takes a mass of 0", "ignore:.*no ellipsoids", "ignore:.*settotalmass")
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_masses_survive_with_each_option_of_the_compiler(tmp_path, options):
    (tmp_path / "robot.xml").write_text(SCENE.format(options=options))
    export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    one, two = (load_model(tmp_path / name).compiled for name in ("robot.xml", "robot.usda"))
    names = [one.body(i).name for i in range(one.nbody)]
    assert names == [two.body(i).name for i in range(two.nbody)]
    np.testing.assert_allclose(two.body_mass, one.body_mass, rtol=EXACT, atol=0)
    np.testing.assert_allclose(two.body_inertia, one.body_inertia, rtol=EXACT, atol=0)
    np.testing.assert_allclose(two.body_ipos, one.body_ipos, rtol=0, atol=EXACT)
    signs = np.where((two.body_iquat * one.body_iquat).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    has_inertia = one.body_inertia.any(axis=1)
    np.testing.assert_allclose((two.body_iquat * signs)[has_inertia], one.body_iquat[has_inertia], rtol=0, atol=EXACT)
    states = [mujoco.MjData(model) for model in (one, two)]
    for model, state in zip((one, two), states, strict=True):
        state.qpos[:2] = 0.3, -0.4
        state.qvel[:] = np.arange(model.nv) * 0.2
        mujoco.mj_forward(model, state)
    np.testing.assert_allclose(states[1].qfrc_bias, states[0].qfrc_bias, atol=1e-10)


TABLE = """<mujoco><compiler inertiagrouprange="1 5"/><worldbody>
  <body name="table"><geom type="box" size=".3 .3 .02"/></body>
  <body name="arm"><joint/><geom size=".1" group="1"/></body>
</worldbody></mujoco>"""


def test_a_mass_given_in_the_stage_counts(tmp_path):
    """The table is massless in MuJoCo; a mass set in USD counts, with its collider's inertia."""
    (tmp_path / "robot.xml").write_text(TABLE)
    export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    assert load_model(tmp_path / "robot.usda").compiled.body("table").mass[0] == 0
    stage = Usd.Stage.Open(str(tmp_path / "robot.usda"))
    UsdPhysics.MassAPI(stage.GetDefaultPrim().GetChild("table")).GetMassAttr().Set(3.0)
    stage.Save()
    table = load_model(tmp_path / "robot.usda").compiled.body("table")
    assert table.mass[0] == 3.0
    np.testing.assert_allclose(np.sort(table.inertia), np.sort([0.0904, 0.0904, 0.18]), rtol=1e-6)


def test_invalid_inertias_are_refused(tmp_path):
    (tmp_path / "robot.xml").write_text(TABLE)
    export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    stage = Usd.Stage.Open(str(tmp_path / "robot.usda"))
    stage.GetDefaultPrim().GetChild("table").GetAttribute("tgdsl:inertial").Set([0.0, -1.0])
    stage.Save()
    with pytest.raises(RobotError, match=r"robot.usda: .*table: tgdsl:inertial is .*; expected a mass, three moments"):
        load_model(tmp_path / "robot.usda")
