"""Objects with transparent geoms, as collision geoms often are: they still collide."""

import mujoco
import numpy as np
import pytest
from warp_cases import SCENE, module, warp

import tgdsl
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.scene.scene import geom_name, is_absent
from tgdsl.view.markers import Pose
from tgdsl.view.meshes import mesh_of

VARIANTS = [
    {"type": "box", "size": [0.02, 0.02, 0.02]},
    {"type": "sphere", "size": [0.015]},
    {"geoms": [{"type": "box", "size": [0.02, 0.02, 0.01]}, {"type": "box", "size": [0.01, 0.01, 0.01], "pos": [0, 0, 0.02]}]},
]
HEIGHT = [0.03, 0.025, 0.02]
"""Height of each variant's origin at rest on the table [m]."""
LOOKS = {"clear": 'rgba=".5 .5 .5 0"', "seen": 'rgba=".5 .5 .5 1"'}


def cube(folder, looks: str) -> tgdsl.TactileModule:
    text = SCENE.replace('mass=".25" friction="1"/>', f'{LOOKS[looks]} friction="1"/>')
    return module(folder, text, links=("table",), target={"variants": VARIANTS})


@pytest.mark.slow
@pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
def test_transparent_objects_rest_like_visible_ones(tmp_path, simulator):
    final_qpos = []
    for looks in LOOKS:
        sim = simulator(cube(tmp_path, looks), 3)
        for _ in range(60):
            sim.step()
        final_qpos.append(sim.qpos.numpy().copy())
    np.testing.assert_allclose(final_qpos[0][:, 2], HEIGHT, atol=1e-3)
    np.testing.assert_array_equal(final_qpos[0], final_qpos[1])


@pytest.mark.parametrize("looks", list(LOOKS))
def test_geoms_are_absent_where_the_plan_has_none(tmp_path, looks):
    touch = cube(tmp_path, looks)
    sim, target = BatchSimulation(touch, 3), touch.plan.scene.objects[0]
    for env in range(3):
        model = sim.env_model(env)
        body = model.body("cube")
        names = [model.geom(i).name for i in range(model.ngeom) if model.geom_bodyid[i] == body.id and not is_absent(model, i)]
        assert names == [geom_name(target, i) for i, geom in enumerate(target.variants[env]) if geom is not None]
        assert is_absent(model, model.geom("tgdsl/cube/0").id) == (target.variants[env][0] is None)


def test_pictures_show_transparent_geoms_and_no_absent_ones(tmp_path):
    """The triangles of each variant fill the bounding box of its geoms."""
    sizes = {}
    for looks in LOOKS:
        sim = BatchSimulation(cube(tmp_path, looks), 3)
        for env in range(3):
            model, data = sim.env_model(env), mujoco.MjData(sim.env_model(env))
            mujoco.mj_forward(model, data)
            mesh = mesh_of(model, Pose(data.xpos, data.xquat), {model.body("cube").id})
            sizes[looks, env] = np.ptp(mesh.corners.reshape(-1, 3), axis=0)
    for env, expected in enumerate([[0.04] * 3, [0.03] * 3, [0.04, 0.04, 0.04]]):
        for looks in LOOKS:
            np.testing.assert_allclose(sizes[looks, env], expected, rtol=0.02)
