"""Meshes from files, inverted, in parts or open: by either query they read like the solid that they represent."""

import warnings

import numpy as np
import pytest
import torch
import trimesh
from oracles.setups.solids import ball, box

import tgdsl
from tgdsl.module.state import SceneState

R = 0.005
TOLERANCE = 1e-4
BOUND = {"raycast": 1e-6, "sdf": 5 * TOLERANCE}
"""Largest error of a distance [m]: MuJoCo stores vertices in single precision; near creases a grid is held to five times its
tolerance."""
CUBE = (0.04, 0.04, 0.04)


def inverted(mesh):
    turned = mesh.copy()
    turned.invert()
    return turned


def read(folder, geom, pos, **target):
    """Return readings of probes facing down, in the frame of the geom, which descends on them at 10 cm/s."""
    (folder / "scene.xml").write_text(
        '<mujoco><asset><mesh name="item" file="item.stl" inertia="shell"/></asset><worldbody>'
        '<body name="pad"><freejoint/><geom size=".05"/></body><body name="item"><freejoint/>'
        f'<inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>{geom}</body></worldbody></mujoco>'
    )
    taxels = [{"pos": list(map(float, each)), "normal": [0, 0, 1], "radius": R} for each in pos]
    sensor = {"links": "pad", "feels": ["item"], "gate": "geometric"}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(folder / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": taxels}}}},
            },
            "objects": {"item": {"body": "item", "surface": "visual", **target}},
            "sensors": {
                "distance": {"kind": "surface_distance", "links": "pad", "feels": ["item"], "max_range": 0.025},
                "depth": {"kind": "contact_depth", **sensor},
                "contact": {"kind": "contact", **sensor},
                "force": {"kind": "kinematic_taxel", "outputs": ["force"], **sensor},
            },
        },
        dtype=torch.float64,
    )
    rest = torch.zeros(1, 2, 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(1, 2, 1)
    moving = rest.clone()
    moving[0, 1, 2] = -0.1
    return {key: values[0].numpy() for key, values in touch(SceneState(rest, quat, moving, rest)).items()}


def mesh_read(folder, parts, pos, query):
    trimesh.util.concatenate(parts).export(folder / "item.stl")
    geom = '<geom type="mesh" mesh="item" contype="0" conaffinity="0"/>'
    return read(folder, geom, pos, query=query, tolerance=TOLERANCE)


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


PAIR = (box(CUBE, (-0.02, 0, 0)), box(CUBE, (0.02, 0, 0)))
ALONG = [(x, 0, -0.017) for x in (-0.03, -0.02, -0.002, 0.0, 0.002, 0.02, 0.03)]
CASES = {
    "inside out": ([inverted(box(CUBE))], [(0, 0, -0.017), (0.003, 0.002, -0.023)], ".02 .02 .02"),
    "a face in common": (PAIR, ALONG, ".04 .02 .02"),
    "a face in common, one inside out": ((PAIR[0], inverted(PAIR[1])), ALONG, ".04 .02 .02"),
    "across each other, one inside out": (
        (box((0.05, 0.04, 0.04), (-0.015, 0, 0)), inverted(box((0.05, 0.04, 0.04), (0.015, 0, 0)))), ALONG, ".04 .02 .02",
    ),
    "a corner in common": ([box(CUBE), box((0.02, 0.02, 0.02), (-0.01,) * 3)], [(0, 0, -0.017), (-0.015, -0.01, -0.01)], ".02 .02 .02"),
    "65 parts, all but one within": (
        [box(CUBE), *(ball(5e-4, (2e-3 * k, 3e-3 * j, 0), 0) for k in range(-4, 4) for j in range(-4, 4))],
        [(0.0, 0, -0.017), (0.001, 0, -0.01)], ".02 .02 .02",
    ),
}  # fmt: skip
"""Parts, probes, and half sizes of the box that the parts form."""


@pytest.mark.parametrize("query", ["sdf", "raycast"])
@pytest.mark.parametrize("name", CASES)
def test_all_sensors_read_the_box_that_parts_form(tmp_path, name, query):
    parts, pos, half = CASES[name]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "mesh .* inertia|.*usually at ")
        readings = mesh_read(tmp_path, parts, pos, query)
        expected = read(tmp_path, f'<geom type="box" size="{half}" contype="0" conaffinity="0"/>', pos)
    bound = BOUND[query]
    np.testing.assert_allclose(readings["distance"], expected["distance"], rtol=0, atol=bound)
    np.testing.assert_allclose(readings["depth"], expected["depth"], rtol=0, atol=bound)
    np.testing.assert_array_equal(readings["contact"], expected["contact"])
    assert expected["contact"].all()
    stiffness = np.abs(expected["force"][..., 2]).max() / expected["depth"].max()
    np.testing.assert_allclose(readings["force"], expected["force"], rtol=0, atol=2 * stiffness * bound)


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_points_in_both_of_two_intersecting_parts_are_deep_inside(tmp_path, query):
    """The middle of two cubes 20 mm apart is 20 mm deep: faces inside the other cube are no surface."""
    parts = box(CUBE), inverted(box(CUBE, (0.02, 0, 0)))
    readings = mesh_read(tmp_path, parts, [(0.01, 0, 0), (0.0, 0, 0), (0.03, 0, 0.015)], query)
    np.testing.assert_allclose(readings["distance"][:, 0], [-0.02, -0.02, -0.005], rtol=0, atol=BOUND[query])


@pytest.mark.parametrize("is_inverted", [False, True])
@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_an_open_mesh_gets_a_lid_and_a_warning(tmp_path, query, is_inverted):
    cup = box(CUBE)
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    pos = [(0, 0, -0.017), (0, 0, 0.017), (0.001, 0, 0.023)]
    message = r'^object item: geom "item" is not closed; its winding number decides which points are inside$'
    with pytest.warns(UserWarning, match=message) as caught:
        readings = mesh_read(tmp_path, [inverted(cup) if is_inverted else cup], pos, query)
    assert sum("not closed" in str(warning.message) for warning in caught) == 1
    np.testing.assert_allclose(readings["distance"][:, 0], [-0.003, -0.003, 0.003], rtol=0, atol=BOUND[query])
