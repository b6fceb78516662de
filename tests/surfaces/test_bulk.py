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


def turned(seed: int) -> np.ndarray:
    return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()


def test_closed_forms():
    """By the textbook, in numbers: spheres, a capsule as its cylinder and two halves of a sphere, a prolate ellipsoid."""
    r, h = 0.01, 0.03
    found = bulk([SurfaceGeom(geom("capsule"), None)])
    assert found.volume == pytest.approx(np.pi * r**2 * 2 * h + 4 / 3 * np.pi * r**3, rel=RTOL)
    assert found.area == pytest.approx(2 * np.pi * r * 2 * h + 4 * np.pi * r**2, rel=RTOL)
    assert found.curvature == pytest.approx(50.0, rel=RTOL)
    found = bulk([SurfaceGeom(geom("sphere"), None)])
    assert (found.volume, found.area) == pytest.approx((4 / 3 * np.pi * 0.04**3, 4 * np.pi * 0.04**2), rel=RTOL)
    assert found.curvature == pytest.approx(25.0, rel=RTOL)
    found = bulk([SurfaceGeom(geom("cylinder"), None)])
    assert found.volume == pytest.approx(np.pi * 0.02**2 * 0.1, rel=RTOL)
    assert found.area == pytest.approx(2 * np.pi * 0.02 * 0.1 + 2 * np.pi * 0.02**2, rel=RTOL)
    assert found.curvature == pytest.approx(25.0, rel=RTOL)
    found = bulk([SurfaceGeom(geom("box"), None)])
    assert (found.volume, found.area) == pytest.approx(
        (0.02 * 0.04 * 0.06, 2 * (0.02 * 0.04 + 0.04 * 0.06 + 0.06 * 0.02)), rel=RTOL
    )
    assert found.curvature == 0
    a, c = 0.01, 0.03
    eccentricity = np.sqrt(1 - (a / c) ** 2)
    found = bulk([SurfaceGeom(geom("ellipsoid", (a, a, c)), None)])
    assert found.area == pytest.approx(2 * np.pi * a**2 * (1 + c / (a * eccentricity) * np.arcsin(eccentricity)), rel=1e-13)
    assert found.curvature == pytest.approx((a * a * c) ** (-1 / 3), rel=RTOL)
    assert bulk([SurfaceGeom(geom("ellipsoid", (a, a, a)), None)]).area == pytest.approx(4 * np.pi * a**2, rel=1e-13)


@pytest.mark.parametrize("shape", SIZES)
def test_volumes_are_the_masses_of_mujoco(shape):
    size = " ".join(map(str, SIZES[shape]))
    text = f'<mujoco><worldbody><body><geom type="{shape}" size="{size}" density="1000"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    assert SHAPE_NAMES[int(model.geom_type[0])] == shape
    assert 1000 * bulk([SurfaceGeom(geom(shape), None)]).volume == pytest.approx(model.body_mass[1], rel=1e-12)


@pytest.mark.parametrize("shape", SIZES)
def test_a_turned_primitive_is_its_own_mesh(shape):
    """The support of an analytic primitive bounds that of inscribed triangles, and exceeds it by what their number says."""
    size, rotation, pos = SIZES[shape], turned(3), np.array([0.1, -0.2, 0.3])
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
def test_meshes_however_they_were_saved(change):
    """A cube of 2 cm: its volume and area do not depend on which way faces turn, shared corners, or a small hole."""
    mesh = trimesh.creation.box((0.02, 0.02, 0.02))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if change == "inside out":
        faces = faces[:, ::-1]
    if change == "corners apart":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(36).reshape(12, 3)
    if change == "a face is missing":
        faces = faces[1:]
    found = bulk([SurfaceGeom(geom("mesh", pos=(1, 2, 3)), Surface(vertices, faces, np.zeros(len(faces), np.int64), ((),)))])
    assert (found.volume, found.area) == pytest.approx((8e-6, 24e-4), rel=1e-12)
    np.testing.assert_allclose([found.low, found.high], [[0.99, 1.99, 2.99], [1.01, 2.01, 3.01]], atol=1e-12)


def test_a_hull_stands_for_its_mesh():
    """An angle of three cubes: the hull, which collides, has more volume than what is there to hold heat."""
    cubes = [trimesh.creation.box((1, 1, 1)).apply_translation(at) for at in ((0, 0, 0), (1, 0, 0), (0, 1, 0))]
    bent = trimesh.util.concatenate(cubes)
    found = bulk([SurfaceGeom(geom("mesh"), surface(bent.convex_hull), surface(bent))])
    assert found.volume == pytest.approx(3.0, rel=1e-12)
    assert bulk([SurfaceGeom(geom("mesh"), surface(bent.convex_hull))]).volume == pytest.approx(3.5, rel=1e-12)


def test_several_geoms_are_summed():
    ball, block = geom("sphere", (0.02, 0, 0), pos=(0.1, 0, 0)), geom("box", (0.01, 0.01, 0.03))
    found = bulk([SurfaceGeom(ball, None), SurfaceGeom(block, None)])
    areas = 4 * np.pi * 0.02**2, 8 * (0.01 * 0.01 + 2 * 0.01 * 0.03)
    assert found.volume == pytest.approx(4 / 3 * np.pi * 0.02**3 + 0.02 * 0.02 * 0.06, rel=RTOL)
    assert found.area == pytest.approx(sum(areas), rel=RTOL)
    assert found.curvature == pytest.approx(50.0 * areas[0] / sum(areas), rel=RTOL)
    np.testing.assert_allclose([found.low, found.high], [[-0.01, -0.02, -0.03], [0.12, 0.02, 0.03]], atol=1e-15)


def test_every_primitive_is_here():
    assert set(SIZES) | {"plane"} == set(PRIMITIVES)


def test_a_plane_is_a_half_space():
    found = bulk([SurfaceGeom(geom("plane", (1.0, 1.0, 0.1)), None)])
    assert (found.volume, found.area, found.curvature) == (np.inf, 0.0, 0.0)
    assert (found.center == 0).all()


@pytest.mark.parametrize("rounds", [0, 4])
def test_a_cube_winds_once_around_what_is_inside(rounds):
    """At a corner it covers an eighth of all directions; the same at each call."""
    cube = trimesh.creation.box((2, 2, 2))
    for _ in range(rounds):
        cube = cube.subdivide()
    vertices, faces = np.array(cube.vertices), np.array(cube.faces)
    places = np.array([[0, 0, 0], [0.5, 0.25, -0.75], [1, 1, 1], [0.3, 0.1, 1 + 1e-6], [0.3, 0.1, 1 - 1e-6], [0.5, 0.5, 1.5]])
    found = np.array([winding_number(vertices, faces, places) for _ in range(20)])
    np.testing.assert_allclose(found, np.tile([1, 1, 1 / 8, 0, 1, 0], (20, 1)), atol=1e-12)
