"""Mocap bodies: MuJoCo gives them no velocity, and tgdsl warns where a sensor needs one."""

import warnings

import mujoco
import pytest

import tgdsl

SCENE = """<mujoco><worldbody>
  <body name="pad" mocap="true"><geom type="box" size=".02 .02 .005"/></body>
  <body name="cube" pos="0 0 .014"><freejoint/><geom type="box" size=".01 .01 .01"/></body>
</worldbody></mujoco>"""


def compiled(folder, kind):
    (folder / "scene.xml").write_text(SCENE)
    points = {"method": "points", "points": [{"pos": [0, 0, 0.005], "normal": [0, 0, 1], "radius": 0.002}]}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"pad": points}}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {"s": {"kind": kind, "links": "pad", "feels": ["cube"]}},
        }
    )


@pytest.mark.parametrize("simulator", ["cpu", pytest.param("warp", marks=pytest.mark.slow)])
def test_a_sensor_that_needs_a_mocap_bodys_velocity_warns(tmp_path, simulator):
    from tgdsl.runtime.warp import WarpSimulation

    make = (
        (lambda touch: WarpSimulation(touch, 1, device="cpu"))
        if simulator == "warp"
        else (lambda touch: tgdsl.simulate(touch, 1))
    )
    with pytest.warns(UserWarning, match="no velocity: shear, slip and sound of its motion are not felt: pad"):
        sim = make(compiled(tmp_path, "kinematic_taxel"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(compiled(tmp_path, "contact_depth"))
    data = mujoco.MjData(sim.model)
    data.mocap_pos[0, 0] = 0.1
    mujoco.mj_step(sim.model, data)
    assert not data.body("pad").cvel.any()  # MuJoCo gives no velocity
