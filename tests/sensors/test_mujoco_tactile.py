"""Against MuJoCo's own `tactile` sensor, at its own vertices: what it calls penetration is our depth of a point."""

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import tgdsl

SCENE = """
<mujoco>
  <asset><mesh name="patch" builtin="sphere" params="3" scale=".03 .025 .02"/></asset>
  <worldbody>
    <body name="pad" euler="20 -10 35" pos=".01 .02 .03">
      <geom name="pad" type="mesh" mesh="patch" pos=".004 -.003 .002" euler="10 0 0"/>
    </body>
    <body name="item"><freejoint/><geom name="item" type="{shape}" size="{size}" pos=".003 .001 0" euler="0 15 0"/></body>
  </worldbody>
  <sensor><tactile geom="pad" mesh="patch"/></sensor>
</mujoco>
"""
TOLERANCE = 1e-6
"""MuJoCo keeps mesh vertices in float32: 1e-9 m; its distances of these shapes are exact. Both leave room within 1e-6 m."""


@pytest.mark.parametrize(("shape", "size"), [("sphere", ".02"), ("capsule", ".012 .02"), ("cylinder", ".015 .02")])
def test_depth_at_the_vertices_is_mujocos(tmp_path, shape, size):
    (tmp_path / "scene.xml").write_text(SCENE.format(shape=shape, size=size))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    pad = model.geom("pad")
    vertices = Rotation.from_quat(pad.quat, scalar_first=True).apply(model.mesh_vert) + pad.pos
    points = [{"pos": v.tolist(), "normal": [0, 0, 1], "radius": 1e-3} for v in vertices]
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(tmp_path / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
            },
            "objects": {"item": {"body": "item"}},
            "sensors": {"d": {"kind": "surface_distance", "links": "pad", "feels": ["item"]}},
        },
        dtype=torch.float64,
    )
    rng = np.random.default_rng(0)
    num_touched = 0
    for _ in range(20):
        data.qpos[:3] = np.array([0.01, 0.02, 0.03]) + 0.03 * rng.uniform(-1, 1, 3)
        data.qpos[3:] = rng.normal(size=4)
        mujoco.mj_forward(model, data)
        bodies = [model.body(name).id for name in touch.inputs.bodies]
        state = tgdsl.SceneState(
            body_pos=torch.from_numpy(data.xpos[bodies][None]), body_quat=torch.from_numpy(data.xquat[bodies][None])
        )
        depth = np.maximum(-touch(state)["d"][0, :, 0].numpy(), 0)
        theirs = data.sensordata.reshape(3, -1)[0]
        if data.ncon:
            np.testing.assert_allclose(depth, theirs, atol=TOLERANCE)
            num_touched += int((theirs > 0).sum())
    assert num_touched > 500
