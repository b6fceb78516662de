"""Objects made of meshes: baked grids and nearest triangles against closed forms."""

import numpy as np
import pytest
import torch
import trimesh

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.module.state import SceneState

R = 0.01
HALF = 0.02
TOLERANCE = 5e-5


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.mktemp("cache")))


def compiled(folder, mesh, probes, *, kind="contact_depth", dtype=torch.float64, geoms="", scale=1.0, **target):
    """Return a module whose probes feel a mesh (or the geoms given as MJCF), and its scene with all at the origin."""
    if mesh is not None:
        mesh.copy().apply_scale(1 / scale).export(folder / "item.stl")
        geoms = geoms or '<geom name="item" type="mesh" mesh="item"/>'
    asset = f'<asset><mesh name="item" file="item.stl" scale="{scale} {scale} {scale}"/></asset>' if mesh is not None else ""
    (folder / "scene.xml").write_text(
        f'<mujoco>{asset}<worldbody><body name="pad"><freejoint/><geom size=".05"/></body>'
        f'<body name="item"><freejoint/>{geoms}</body></worldbody></mujoco>'
    )
    points = [{"pos": np.asarray(p).tolist(), "normal": [0, 0, 1], "radius": R} for p in probes]
    gate = {} if kind == "surface_distance" else {"gate": "geometric"}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(folder / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
            },
            "objects": {"item": {"body": "item", **target}},
            "sensors": {"s": {"kind": kind, "links": "pad", "feels": ["item"], **gate}},
        },
        dtype=dtype,
    )
    num = len(touch.inputs.bodies)
    rest = torch.zeros(1, num, 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, num, 4)
    return touch, SceneState(body_pos=rest, body_quat=quat, body_linvel=rest, body_angvel=rest)


L_SHAPE = trimesh.util.concatenate(
    [trimesh.creation.box((0.08, 0.02, 0.02)), trimesh.creation.box((0.02, 0.02, 0.06)).apply_translation((-0.03, 0, 0.02))]
)
"""A bar along x and one up from its end at x < −0.02: concave where they meet."""


def test_the_hull_is_felt_by_default_and_said_to_be(tmp_path):
    """A probe half way on the hull's slanted face, which leads from (x −.02, z .05) to (.04, .01), 20 mm above the bar."""
    probe = [(0.01, 0, 0.03)]
    with pytest.warns(
        UserWarning, match=r'object item: MuJoCo collides the convex hull of geom "item", up to [0-9.]+ mm off the mesh'
    ):
        touch, scene = compiled(tmp_path, L_SHAPE, probe, query="raycast")
    assert touch(scene)["s"].item() == pytest.approx(R, abs=1e-6)
    touch, scene = compiled(tmp_path, L_SHAPE, probe, query="raycast", surface="visual")
    assert touch(scene)["s"].item() == 0.0
    touch, scene = compiled(tmp_path, L_SHAPE, [(0.01, 0, 0.014)], query="raycast", surface="visual")
    assert touch(scene)["s"].item() == pytest.approx(R - 0.004, abs=1e-6)


def test_a_named_geom_is_felt_as_it_is(tmp_path):
    geoms = (
        '<geom name="skin" type="mesh" mesh="item" contype="0" conaffinity="0"/><geom name="core" type="sphere" size=".005"/>'
    )
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    for surface, depth in (("collision", 0.0), ("visual", 0.005), ("core", 0.0), ("sk*", 0.005), ("item", 0.005)):
        touch, scene = compiled(tmp_path, cube, [(0, 0, HALF + 0.005)], geoms=geoms, query="raycast", surface=surface)
        assert touch(scene)["s"].item() == pytest.approx(depth, abs=1e-6), surface


@pytest.mark.slow
def test_an_open_mesh_has_a_side_and_a_warning(tmp_path):
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    cube.update_faces(np.arange(len(cube.faces)) != 3)
    with pytest.warns(UserWarning, match='object item: geom "item" is not closed'):
        touch, scene = compiled(tmp_path, cube, [(0, 0, 0), (0.03, 0, 0)], kind="surface_distance", surface="visual")
    inside, outside = touch(scene)["s"][0, :, 0].numpy()
    assert inside < -0.015 and outside == pytest.approx(0.01, abs=2e-4)


def test_a_grid_over_its_budget_is_refused(tmp_path):
    with pytest.raises(SpecError, match=r"objects\.item: "):
        compiled(tmp_path, trimesh.creation.icosphere(radius=0.05), [(0, 0, 0)], tolerance=1e-7, max_bytes=100_000)


def test_explain_tells_what_a_grid_costs(tmp_path):
    touch, _ = compiled(tmp_path, trimesh.creation.icosphere(subdivisions=4, radius=HALF), [(0, 0, HALF)])
    text = touch.explain()
    assert "tri" in text and "99 % within" in text and "bytes" in text
    accuracy = touch.plan.quantities["contact_depth"].geoms[0].accuracy[0][0]
    assert accuracy["p99"] <= accuracy["tolerance"] == TOLERANCE


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_an_artefact_keeps_the_mesh(tmp_path, query):
    rng = np.random.default_rng(1)
    touch, scene = compiled(
        tmp_path, trimesh.creation.icosphere(radius=HALF), rng.normal(scale=0.015, size=(50, 3)), query=query
    )
    tgdsl.save(touch, tmp_path / "a.safetensors")
    again = tgdsl.load(tmp_path / "a.safetensors", dtype=torch.float64)
    torch.testing.assert_close(again(scene)["s"], touch(scene)["s"], rtol=0, atol=0)


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_gradients_reach_the_pose(tmp_path, query):
    touch, scene = compiled(
        tmp_path, trimesh.creation.icosphere(subdivisions=4, radius=HALF), [(0, 0, HALF + 0.004)], query=query
    )
    assert scene.body_pos is not None
    pos = scene.body_pos.clone().requires_grad_()
    scene.body_pos = pos
    (gradient,) = torch.autograd.grad(touch(scene)["s"].sum(), pos)
    item = touch.inputs.bodies.index("item")
    np.testing.assert_allclose(gradient[0, item].numpy(), [0, 0, 1], atol=0.05)
