"""Meshes that break distance queries: no thickness, needles, coincident faces. Readings stay finite, right and steady."""

import numpy as np
import pytest
import torch
from oracles.hard import probes
from oracles.hard.probes import NUM_STEPS, TOLERANCE, jittered
from oracles.setups.brute import brute_force

import tgdsl
from tgdsl.module.state import SceneState

R = 0.006


CASES = probes.MESHES


def compiled(folder, mesh, probes, dtype, **target):
    mesh.export(folder / "item.stl")
    (folder / "scene.xml").write_text(
        '<mujoco><compiler balanceinertia="true"/><asset><mesh name="item" file="item.stl" inertia="shell"/></asset>'
        '<worldbody><body name="pad"><freejoint/><geom size=".05"/></body><body name="item"><freejoint/>'
        '<geom type="mesh" mesh="item" contype="0" conaffinity="0"/></body></worldbody></mujoco>'
    )
    points = [{"pos": list(map(float, probe)), "normal": [0, 0, 1], "radius": R} for probe in probes]
    sensor = {"links": "pad", "feels": ["item"], "gate": "geometric"}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(folder / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
            },
            "objects": {"item": {"body": "item", "surface": "visual", **target}},
            "sensors": {
                "depth": {"kind": "contact_depth", **sensor},
                "force": {"kind": "kinematic_taxel", "outputs": ["force"], **sensor},
            },
        },
        dtype=dtype,
    )
    rest = torch.zeros(1, 2, 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(1, 2, 1)
    return touch, SceneState(body_pos=rest, body_quat=quat, body_linvel=rest, body_angvel=rest)


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("query", ["sdf", "raycast"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_readings_at_rest_are_right_and_steady(tmp_path, name, query, dtype):
    make, probes = CASES[name]
    touch, state = compiled(tmp_path, make(), probes, dtype, query=query, tolerance=TOLERANCE)
    readings = touch(jittered(state, NUM_STEPS))
    depth, force = readings["depth"][..., 0].double(), readings["force"].double()
    distance, _ = brute_force(np.asarray(make().triangles), np.array(probes))  # all outside: no sign
    bound = 5 * TOLERANCE if query == "sdf" else 1e-6  # near creases a grid is held to five times its tolerance
    np.testing.assert_allclose(depth.numpy(), np.tile(R - distance, (NUM_STEPS, 1)), atol=bound)
    direction = force / force.norm(dim=2, keepdim=True)
    assert torch.isfinite(direction).all()
    spread = (direction - direction[:1]).norm(dim=2).max()
    assert spread < 1e-3, f"a normal turns by {spread:.2g} rad"


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_readings_deep_inside_and_on_the_surface_are_bounded(tmp_path, name, query):
    """Probes throughout the mesh, on its vertices and edges too: finite, and no deeper than its inner radius allows."""
    make, _ = CASES[name]
    mesh = make()
    rng = np.random.default_rng(0)
    along = rng.uniform(size=(20, 1))
    edges = mesh.vertices[mesh.edges[rng.integers(0, len(mesh.edges), 20)]]
    lower, upper = mesh.bounds
    probes = [*mesh.vertices, *(along * edges[:, 0] + (1 - along) * edges[:, 1]), *rng.uniform(lower, upper, (60, 3))]
    touch, state = compiled(tmp_path, mesh, probes, torch.float32, query=query, tolerance=TOLERANCE)
    readings = touch(jittered(state, 50))
    assert torch.isfinite(readings["depth"]).all() and torch.isfinite(readings["force"]).all()
    inner = min(mesh.extents) / 2
    assert readings["depth"].max() < R + inner + 10 * TOLERANCE
    assert readings["depth"][:, : len(mesh.vertices)].min() > R - 10 * TOLERANCE
