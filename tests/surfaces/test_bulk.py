"""Volumes, areas and boxes of geoms against closed forms, MuJoCo's masses, and surfaces of many triangles."""

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tgdsl.formats.model import SHAPE_NAMES
from tgdsl.surfaces.bulk import PRIMITIVES, bulk
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.surface import Surface, winding_number

RTOL = 1e-14  # of a few products in float64
SIZES = {
    "sphere": (0.04, 0.0, 0.0),
    "capsule": (0.01, 0.03, 0.0),
    "cylinder": (0.02, 0.05, 0.0),
    "ellipsoid": (0.01, 0.02, 0.04),
    "box": (0.01, 0.02, 0.03),
}


def geom(shape, size=None, pos=(0.0, 0.0, 0.0), rotation=None) -> Geom:
    size = SIZES.get(shape, (0.0,) * 3) if size is None else size
    return Geom(
        0, "", "", "body", shape, np.array(size), np.array(pos, dtype=float), np.eye(3) if rotation is None else rotation, True
    )


def surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.zeros(len(mesh.faces), np.int64), ((),))


def random_rotation(seed: int) -> np.ndarray:
    return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()


def test_closed_forms():
    """Textbook formulas of spheres, a capsule, a cylinder, a box and a prolate ellipsoid."""
    r, h = 0.01, 0.03
    result = bulk([SurfaceGeom(geom("capsule"), None)])
    assert result.volume == pytest.approx(np.pi * r**2 * 2 * h + 4 / 3 * np.pi * r**3, rel=RTOL)
    assert result.area == pytest.approx(2 * np.pi * r * 2 * h + 4 * np.pi * r**2, rel=RTOL)
    assert result.curvature == pytest.approx(50.0, rel=RTOL)
    result = bulk([SurfaceGeom(geom("sphere"), None)])
    assert (result.volume, result.area) == pytest.approx((4 / 3 * np.pi * 0.04**3, 4 * np.pi * 0.04**2), rel=RTOL)
    assert result.curvature == pytest.approx(25.0, rel=RTOL)
    result = bulk([SurfaceGeom(geom("cylinder"), None)])
    assert result.volume == pytest.approx(np.pi * 0.02**2 * 0.1, rel=RTOL)
    assert result.area == pytest.approx(2 * np.pi * 0.02 * 0.1 + 2 * np.pi * 0.02**2, rel=RTOL)
    assert result.curvature == pytest.approx(25.0, rel=RTOL)
    result = bulk([SurfaceGeom(geom("box"), None)])
    assert (result.volume, result.area) == pytest.approx(
        (0.02 * 0.04 * 0.06, 2 * (0.02 * 0.04 + 0.04 * 0.06 + 0.06 * 0.02)), rel=RTOL
    )
    assert result.curvature == 0
    a, c = 0.01, 0.03
    eccentricity = np.sqrt(1 - (a / c) ** 2)
    result = bulk([SurfaceGeom(geom("ellipsoid", (a, a, c)), None)])
    assert result.area == pytest.approx(2 * np.pi * a**2 * (1 + c / (a * eccentricity) * np.arcsin(eccentricity)), rel=1e-13)
    assert result.curvature == pytest.approx((a * a * c) ** (-1 / 3), rel=RTOL)
    assert bulk([SurfaceGeom(geom("ellipsoid", (a, a, a)), None)]).area == pytest.approx(4 * np.pi * a**2, rel=1e-13)


@pytest.mark.parametrize("shape", SIZES)
def test_volumes_match_the_masses_of_mujoco(shape):
    size = " ".join(map(str, SIZES[shape]))
    text = f'<mujoco><worldbody><body><geom type="{shape}" size="{size}" density="1000"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    assert SHAPE_NAMES[int(model.geom_type[0])] == shape
    assert 1000 * bulk([SurfaceGeom(geom(shape), None)]).volume == pytest.approx(model.body_mass[1], rel=1e-12)


@pytest.mark.parametrize("shape", SIZES)
def test_a_rotated_primitive_matches_its_mesh(shape):
    size, rotation, pos = SIZES[shape], random_rotation(3), np.array([0.1, -0.2, 0.3])
    mesh = {
        "sphere": lambda: trimesh.creation.icosphere(5, size[0]),
        "capsule": lambda: trimesh.creation.capsule(2 * size[1], size[0], count=(128, 128)),
        "cylinder": lambda: trimesh.creation.cylinder(size[0], 2 * size[1], sections=512),
        "ellipsoid": lambda: trimesh.creation.icosphere(5).apply_scale(size),
        "box": lambda: trimesh.creation.box(2 * np.array(size)),
    }[shape]()
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    exact = bulk([SurfaceGeom(geom(shape, size, pos, rotation), None)])
    meshed = bulk([SurfaceGeom(geom("mesh", None, pos, rotation), surface(mesh))])
    assert meshed.volume == pytest.approx(exact.volume, rel=2e-3)
    assert meshed.area == pytest.approx(exact.area, rel=2e-3)
    np.testing.assert_allclose(meshed.low, exact.low, atol=5e-5)
    np.testing.assert_allclose(meshed.high, exact.high, atol=5e-5)
    assert meshed.curvature == 0


@pytest.mark.parametrize("change", ["as it is", "inside out", "corners apart", "a face is missing"])
def test_bulk_does_not_depend_on_how_a_mesh_was_saved(change):
    """Volume and area of a 2 cm cube do not depend on winding, shared corners or a missing face."""
    mesh = trimesh.creation.box((0.02, 0.02, 0.02))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if change == "inside out":
        faces = faces[:, ::-1]
    if change == "corners apart":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(36).reshape(12, 3)
    if change == "a face is missing":
        faces = faces[1:]
    result = bulk([SurfaceGeom(geom("mesh", pos=(1, 2, 3)), Surface(vertices, faces, np.zeros(len(faces), np.int64), ((),)))])
    assert (result.volume, result.area) == pytest.approx((8e-6, 24e-4), rel=1e-12)
    np.testing.assert_allclose([result.low, result.high], [[0.99, 1.99, 2.99], [1.01, 2.01, 3.01]], atol=1e-12)


def test_bulk_is_of_the_mesh_rather_than_its_hull():
    """Three cubes in an L: the colliding hull has more volume than the cubes, which hold the heat."""
    cubes = [trimesh.creation.box((1, 1, 1)).apply_translation(at) for at in ((0, 0, 0), (1, 0, 0), (0, 1, 0))]
    bent = trimesh.util.concatenate(cubes)
    result = bulk([SurfaceGeom(geom("mesh"), surface(bent.convex_hull), surface(bent))])
    assert result.volume == pytest.approx(3.0, rel=1e-12)
    assert bulk([SurfaceGeom(geom("mesh"), surface(bent.convex_hull))]).volume == pytest.approx(3.5, rel=1e-12)


def test_several_geoms_are_summed():
    ball, block = geom("sphere", (0.02, 0, 0), pos=(0.1, 0, 0)), geom("box", (0.01, 0.01, 0.03))
    result = bulk([SurfaceGeom(ball, None), SurfaceGeom(block, None)])
    areas = 4 * np.pi * 0.02**2, 8 * (0.01 * 0.01 + 2 * 0.01 * 0.03)
    assert result.volume == pytest.approx(4 / 3 * np.pi * 0.02**3 + 0.02 * 0.02 * 0.06, rel=RTOL)
    assert result.area == pytest.approx(sum(areas), rel=RTOL)
    assert result.curvature == pytest.approx(50.0 * areas[0] / sum(areas), rel=RTOL)
    np.testing.assert_allclose([result.low, result.high], [[-0.01, -0.02, -0.03], [0.12, 0.02, 0.03]], atol=1e-15)


def test_every_primitive_is_covered():
    assert set(SIZES) | {"plane"} == set(PRIMITIVES)


def test_a_plane_is_a_half_space():
    result = bulk([SurfaceGeom(geom("plane", (1.0, 1.0, 0.1)), None)])
    assert (result.volume, result.area, result.curvature) == (np.inf, 0.0, 0.0)
    assert (result.center == 0).all()


@pytest.mark.parametrize("rounds", [0, 4])
def test_a_cube_winds_once_around_its_inside(rounds):
    """A corner sees an eighth of all directions; calls are repeatable."""
    cube = trimesh.creation.box((2, 2, 2))
    for _ in range(rounds):
        cube = cube.subdivide()
    vertices, faces = np.array(cube.vertices), np.array(cube.faces)
    positions = np.array(
        [[0, 0, 0], [0.5, 0.25, -0.75], [1, 1, 1], [0.3, 0.1, 1 + 1e-6], [0.3, 0.1, 1 - 1e-6], [0.5, 0.5, 1.5]]
    )
    windings = np.array([winding_number(vertices, faces, positions) for _ in range(20)])
    np.testing.assert_allclose(windings, np.tile([1, 1, 1 / 8, 0, 1, 0], (20, 1)), atol=1e-12)
