"""Objects made of meshes: baked grids and nearest triangles against closed forms."""

import numpy as np
import pytest
import torch
import trimesh
from oracles.geometry import mesh_scene

import tgdsl
from tgdsl.errors import SpecError

R = 0.01
HALF = 0.02
TOLERANCE = 5e-5


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


L_SHAPE = trimesh.util.concatenate(
    [trimesh.creation.box((0.08, 0.02, 0.02)), trimesh.creation.box((0.02, 0.02, 0.06)).apply_translation((-0.03, 0, 0.02))]
)
"""A bar along x and an upright on its end at x < −0.02: concave where they meet."""


def test_the_hull_is_felt_by_default_with_a_warning():
    """A probe is halfway along the hull's slanted face from (x −.02, z .05) to (.04, .01), 20 mm above the bar."""
    probe = [(0.01, 0, 0.03)]
    with pytest.warns(
        UserWarning, match=r'object item: MuJoCo collides the convex hull of geom "item", up to [0-9.]+ mm off the mesh'
    ):
        touch, scene = mesh_scene(L_SHAPE, probe, query="raycast")
    assert touch(scene)["s"].item() == pytest.approx(R, abs=1e-6)
    touch, scene = mesh_scene(L_SHAPE, probe, query="raycast", surface="visual")
    assert touch(scene)["s"].item() == 0.0
    touch, scene = mesh_scene(L_SHAPE, [(0.01, 0, 0.014)], query="raycast", surface="visual")
    assert touch(scene)["s"].item() == pytest.approx(R - 0.004, abs=1e-6)


def test_a_named_geom_is_felt_instead_of_its_hull():
    geoms = (
        '<geom name="skin" type="mesh" mesh="item" contype="0" conaffinity="0"/><geom name="core" type="sphere" size=".005"/>'
    )
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    for surface, depth in (("collision", 0.0), ("visual", 0.005), ("core", 0.0), ("sk*", 0.005), ("item", 0.005)):
        touch, scene = mesh_scene(cube, [(0, 0, HALF + 0.005)], geoms=geoms, query="raycast", surface=surface)
        assert touch(scene)["s"].item() == pytest.approx(depth, abs=1e-6), surface


@pytest.mark.slow
def test_an_open_mesh_has_a_side_and_a_warning():
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    cube.update_faces(np.arange(len(cube.faces)) != 3)
    with pytest.warns(UserWarning, match='object item: geom "item" is not closed'):
        touch, scene = mesh_scene(cube, [(0, 0, 0), (0.03, 0, 0)], kind="surface_distance", surface="visual")
    inside, outside = touch(scene)["s"][0, :, 0].numpy()
    assert inside < -0.015 and outside == pytest.approx(0.01, abs=2e-4)


def test_a_grid_over_its_budget_is_refused():
    with pytest.raises(SpecError, match=r"objects\.item: "):
        mesh_scene(trimesh.creation.icosphere(radius=0.05), [(0, 0, 0)], tolerance=1e-7, max_bytes=100_000)


def test_explain_gives_size_and_accuracy_of_a_grid():
    touch, _ = mesh_scene(trimesh.creation.icosphere(subdivisions=4, radius=HALF), [(0, 0, HALF)])
    text = touch.explain()
    assert "tri" in text and "99 % within" in text and "bytes" in text
    accuracy = touch.plan.quantities["contact_depth"].geoms[0].accuracy[0][0]
    assert accuracy["p99"] <= accuracy["tolerance"] == TOLERANCE


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_a_loaded_artefact_reads_the_same(tmp_path, query):
    rng = np.random.default_rng(1)
    touch, scene = mesh_scene(trimesh.creation.icosphere(radius=HALF), rng.normal(scale=0.015, size=(50, 3)), query=query)
    tgdsl.save(touch, tmp_path / "a.safetensors")
    loaded = tgdsl.load(tmp_path / "a.safetensors", dtype=torch.float64)
    torch.testing.assert_close(loaded(scene)["s"], touch(scene)["s"], rtol=0, atol=0)


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_gradients_reach_the_pose(query):
    touch, scene = mesh_scene(trimesh.creation.icosphere(subdivisions=4, radius=HALF), [(0, 0, HALF + 0.004)], query=query)
    assert scene.body_pos is not None
    pos = scene.body_pos.clone().requires_grad_()
    scene.body_pos = pos
    (gradient,) = torch.autograd.grad(touch(scene)["s"].sum(), pos)
    item = touch.inputs.bodies.index("item")
    np.testing.assert_allclose(gradient[0, item].numpy(), [0, 0, 1], atol=0.05)
