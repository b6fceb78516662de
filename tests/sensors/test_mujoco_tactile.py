"""Against MuJoCo's `tactile` sensor, at its vertices: its penetration is our depth of a point."""

import mujoco
import numpy as np
import pytest
import torch
from oracles.hard.contacts import TACTILE as SCENE
from oracles.hard.contacts import TACTILE_SHAPES, TACTILE_TOLERANCE, tactile_depth
from scipy.spatial.transform import Rotation

import tgdsl


@pytest.mark.parametrize("shape", TACTILE_SHAPES)
def test_depth_at_the_vertices_is_mujocos(shape):
    worst, num_touched = tactile_depth(shape)
    assert worst <= TACTILE_TOLERANCE
    assert num_touched > 500


OURS, THEIRS, FACETS = 5e-5, 5e-4, 3e-5
"""Distance errors on a ball of 2 cm [m]: the tolerance of our grid, the largest error of MuJoCo's octree of depth 6 (it
underestimates the ball), and the distance of the ball's facets from it."""


@pytest.mark.slow
def test_depth_of_a_mesh_agrees_with_mujocos_octree(tmp_path, monkeypatch):
    """MuJoCo's tactile sensor measures distances to a mesh on an octree, we on a grid: both within their errors of the ball."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    ball = '<mesh name="ball" builtin="sphere" params="4" scale=".02 .02 .02"/>'
    text = SCENE.format(shape="mesh", size="1").replace("</asset>", f"{ball}</asset>").replace('size="1"', 'mesh="ball"')
    (tmp_path / "scene.xml").write_text(text)
    spec = mujoco.MjSpec.from_string(text)
    next(mesh for mesh in spec.meshes if mesh.name == "ball").needsdf = True
    model = spec.compile()
    data = mujoco.MjData(model)
    pad, patch = model.geom("pad"), model.mesh("patch")
    local = model.mesh_vert[patch.vertadr[0] : patch.vertadr[0] + patch.vertnum[0]]
    vertices = Rotation.from_quat(pad.quat, scalar_first=True).apply(local) + pad.pos
    points = [{"pos": v.tolist(), "normal": [0, 0, 1], "radius": 5e-3} for v in vertices]
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(tmp_path / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
            },
            "objects": {"item": {"body": "item", "tolerance": OURS}},
            "sensors": {"d": {"kind": "surface_distance", "links": "pad", "feels": ["item"], "max_range": 0.01}},
        },
        dtype=torch.float64,
    )
    rng = np.random.default_rng(1)
    num_touched = 0
    for _ in range(10):
        data.qpos[:3] = np.array([0.01, 0.02, 0.03]) + 0.03 * rng.uniform(-1, 1, 3)
        mujoco.mj_forward(model, data)
        bodies = [model.body(name).id for name in touch.inputs.bodies]
        state = tgdsl.SceneState(
            body_pos=torch.from_numpy(data.xpos[bodies][None]), body_quat=torch.from_numpy(data.xquat[bodies][None])
        )
        distance = touch(state)["d"][0, :, 0].numpy()
        theirs = data.sensordata.reshape(3, -1)[0]
        is_shallow = (distance < 0) & (distance > -5e-3)  # within the band of our grid
        if data.ncon and is_shallow.any():
            centre = data.geom("item").xpos
            world = data.geom("pad").xpos + local @ data.geom("pad").xmat.reshape(3, 3).T
            depth = 0.02 - np.linalg.norm(world - centre, axis=1)[is_shallow]
            np.testing.assert_allclose(-distance[is_shallow], depth, atol=OURS + FACETS)
            np.testing.assert_allclose(theirs[is_shallow], depth, atol=THEIRS + FACETS)
            num_touched += int(is_shallow.sum())
    assert num_touched > 100
