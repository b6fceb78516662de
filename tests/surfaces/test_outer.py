"""What bounds a mesh, whatever its parts: distances in closed form, and the winding number of what is left, 1 or 0."""

import igl
import numpy as np
import pytest
import trimesh
from oracles.setups.solids import ball, box
from scipy.spatial.transform import Rotation
from surfaces import plate

from tgdsl.errors import BakeError
from tgdsl.surfaces.outer import OPEN, TWISTED, UNCUT, Outer, cut_cells, outer
from tgdsl.surfaces.solid import Solid
from tgdsl.surfaces.surface import Surface, winding_number

MM = 1e-3
CUBE = box((0.04, 0.04, 0.04))


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    turned = mesh.copy()
    turned.invert()
    return turned


def with_first_face_turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces[:1, ::-1], mesh.faces[1:]]), process=False)


def without_top(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    opened = mesh.copy()
    opened.update_faces(opened.face_normals[:, 2] < 0.5)
    return opened


def surface(*parts: trimesh.Trimesh, is_merged: bool = False) -> Surface:
    """One mesh of several parts: as an OBJ file has their vertices, or as MuJoCo has those of an STL file, all in places of their own."""
    mesh = trimesh.util.concatenate(parts)
    if is_merged:
        mesh.merge_vertices()
    return Surface(np.array(mesh.vertices), np.array(mesh.faces), np.zeros(len(mesh.faces), int), (("mesh",),))


def distance(found: Outer, pos) -> np.ndarray:
    """Signed distance [m] of points; around each the surface winds once or not at all."""
    pos = np.array(pos, float)
    winding = winding_number(found.vertices, found.faces, pos)
    np.testing.assert_allclose(winding, np.round(winding), atol=1e-4)
    assert set(np.round(winding).tolist()) <= {0.0, 1.0}
    squared, *_ = igl.point_mesh_squared_distance(pos, found.vertices, found.faces)
    return np.where(winding > 0.5, -1.0, 1.0) * np.sqrt(squared)


def area(found: Outer) -> float:
    return 0.5 * float(igl.doublearea(found.vertices, found.faces).sum())


ALONG = [[x * MM, 0, 17 * MM] for x in (-30, -20, -2, 0, 2, 20, 30)]
CASES = {
    "a box": ([CUBE], [[0, 0, 0.017], [0, 0, 0], [0, 0, 0.03]], [-3, -20, 10]),
    "inside out": ([inverted(CUBE)], [[0, 0, 0.017], [0, 0, 0], [0, 0, 0.03]], [-3, -20, 10]),
    "one of several inside out": ([CUBE, inverted(box((0.02, 0.02, 0.02), (0.05, 0, 0)))], [[0, 0, 0.017], [0.05, 0, 0]], [-3, -10]),
    "across": ([CUBE, box((0.04, 0.04, 0.04), (0.02, 0, 0))], [[0.01, 0, 0], [0, 0, 0], [0.05, 0, 0]], [-20, -20, 10]),
    "across, one inside out": (
        [CUBE, inverted(box((0.04, 0.04, 0.04), (0.02, 0, 0)))], [[0.01, 0, 0], [0, 0, 0.017], [0.02, 0, 0.017]], [-20, -3, -3],
    ),
    "a face in common": ([box((0.04, 0.04, 0.04), (x, 0, 0)) for x in (-0.02, 0.02)], ALONG, [-3] * 7),
    "a face in common, one inside out": (
        [box((0.04, 0.04, 0.04), (-0.02, 0, 0)), inverted(box((0.04, 0.04, 0.04), (0.02, 0, 0)))], ALONG, [-3] * 7,
    ),
    "on part of a face": (
        [box((0.04, 0.04, 0.04), (-0.02, 0, 0)), box((0.04, 0.02, 0.02), (0.02, 0, 0))],
        [[0.02, 0, 0], [-0.005, 0, 0], [-0.001, 0, 0.015]], [-10, -np.hypot(5, 10), -1],
    ),
    "a corner in common": ([CUBE, box((0.02, 0.02, 0.02), (-0.01, -0.01, -0.01))], [[0, 0, 0], [-0.01, -0.01, -0.01]], [-20, -10]),
    "a corner in common, one inside out": (
        [CUBE, inverted(box((0.02, 0.02, 0.02), (-0.01, -0.01, -0.01)))], [[0, 0, 0], [-0.01, -0.01, -0.01]], [-20, -10],
    ),
    "an edge in common": (
        [box((0.02, 0.02, 0.02), (-0.01, -0.01, 0)), inverted(box((0.02, 0.02, 0.02), (0.01, 0.01, 0)))],
        [[-0.01, -0.01, 0], [0.01, 0.01, 0], [0.003, -0.004, 0]], [-10, -10, 3],
    ),
    "nested": ([CUBE, box((0.02, 0.02, 0.02))], [[0, 0, 0], [0, 0, 0.009], [0, 0, 0.017]], [-20, -11, -3]),
    "a cavity": ([CUBE, inverted(box((0.02, 0.02, 0.02)))], [[0, 0, 0], [0, 0, 0.009], [0, 0, 0.011]], [10, 1, -1]),
    "a cavity, all inside out": ([inverted(CUBE), box((0.02, 0.02, 0.02))], [[0, 0, 0], [0, 0, 0.009], [0, 0, 0.011]], [10, 1, -1]),
    "a cavity whose first face is turned": (
        [CUBE, with_first_face_turned(inverted(box((0.02, 0.02, 0.02))))], [[0, 0, 0], [0, 0, 0.009], [0, 0, 0.011]], [10, 1, -1],
    ),
    "screw in a cavity, all inside out": (
        [inverted(CUBE), box((0.03, 0.03, 0.03)), inverted(box((0.01, 0.01, 0.01)))],
        [[0, 0, 0], [0, 0, 0.01], [0, 0, 0.016]], [-5, 5, -1],
    ),
    "twice the same": ([CUBE, CUBE], [[0, 0, 0.017], [0, 0, 0.021]], [-3, 1]),
    "each face from both sides": ([CUBE, inverted(CUBE)], [[0, 0, 0.017], [0, 0, 0.021]], [-3, 1]),
    "a sheet on a box": ([CUBE, plate(np.array([0, 0, 1.0])).apply_translation((0, 0, 0.03))], [[0, 0, 0.017], [0, 0, 0.029]], [-3, 1]),
    "65 in a row": ([box((0.01, 0.01, 0.01), (0.01 * k, 0, 0)) for k in range(65)], [[0.32, 0, 0.004], [0.325, 0, 0]], [-1, -5]),
    "65, all but one within": (
        [CUBE, *(box((0.001, 0.001, 0.001), (0.002 * k, 0.003 * j, 0)) for k in range(-4, 4) for j in range(-4, 4))],
        [[0, 0, 0], [0.001, 0, 0.019]], [-20, -1],
    ),
}  # fmt: skip


@pytest.mark.parametrize("is_merged", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_distances_are_to_the_outside_of_all_parts(name, is_merged):
    parts, pos, expected = CASES[name]
    found = outer(surface(*parts, is_merged=is_merged))
    np.testing.assert_allclose(distance(found, pos) / MM, expected, atol=1e-6)
    assert found.flaws == ((OPEN,) if "sheet" in name else ())


def test_parts_are_told_apart_by_their_vertices_in_the_file():
    """They share edges along a side of one of them, so that by their places it could not be told which faces are neighbours."""
    first, second = box((0.03, 0.03, 0.03), (-0.015, 0.005, 0), cuts=1), box((0.03, 0.01, 0.03), (0.015, 0, 0), cuts=1)
    bar, pos = box((0.006, 0.006, 0.05), (0.015, 0, 0)), [[-0.015, 0.005, 0], [0.015, 0, 0], [0, 0, 0], [0.01, 0.01, 0]]
    for parts in ((inverted(first), second, bar), (first, inverted(second), bar)):
        np.testing.assert_allclose(distance(outer(surface(*parts)), pos) / MM, [-15, -5, -5, 5], atol=1e-6)


@pytest.mark.parametrize("is_turned", [False, True])
def test_faces_that_cover_each_other_are_there_once(is_turned):
    """A bar through a cube, flush with two of its sides, whose diagonals the bar's may cross."""
    bar = box((0.02, 0.02, 0.04))
    if is_turned:
        bar.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1]))
    for parts in ((CUBE, bar), (bar, CUBE)):
        assert area(outer(surface(*parts))) == pytest.approx(6 * 0.04**2)


def test_edges_along_which_flat_faces_are_cut_are_not_sharp():
    """Faces of a cube are cut along the sides of a bar through it, and beyond."""
    solid = Solid(surface(CUBE, box((0.004, 0.004, 0.06))))
    np.testing.assert_allclose(solid.edge_distance(np.array([[0.013, 0.0019, 0.02], [0.0019, -0.013, -0.02]])) / MM, 7)


def test_lines_through_one_point_cut_a_triangle_into_cells_with_sides():
    triangle = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0.0]])
    for turn in Rotation.random(20, rng=0).as_matrix():
        corners = triangle @ turn.T
        center = corners.mean(axis=0)
        ends = [[center - 3 * way, center + 3 * way] for way in (corners - center)]
        found = cut_cells(corners, np.array(ends), 1e-6)
        sides = [np.linalg.norm(cell - np.roll(cell, 1, axis=0), axis=1).min() for cell in found]
        assert len(found) == 6 and min(sides) > 0.1
        areas = [np.linalg.norm(np.cross(cell[1:-1] - cell[0], cell[2:] - cell[0]), axis=1).sum() / 2 for cell in found]
        assert sum(areas) == pytest.approx(4.5)


def test_a_closed_mesh_stays_as_it_is():
    mesh = ball(0.02, subdivisions=3)
    found = outer(surface(mesh))
    np.testing.assert_array_equal(found.vertices[found.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(found.uncut, found.faces)


@pytest.mark.parametrize("is_inverted", [False, True])
def test_an_open_mesh_gets_a_lid_and_is_said_to_be_open(is_inverted):
    cup = without_top(CUBE)
    found = outer(surface(inverted(cup) if is_inverted else cup))
    np.testing.assert_allclose(distance(found, [[0, 0, 0.017], [0, 0, 0.021], [0, 0, 0.025]]) / MM, [-3, 1, 5], atol=1e-9)
    assert found.flaws == (OPEN,)
    assert area(found) == pytest.approx(6 * 0.04**2)


def test_a_sheet_has_two_sides_and_no_inside():
    found = outer(surface(plate(np.array([0, 0, 1.0]), size=0.02)))
    np.testing.assert_allclose(distance(found, [[0, 0, 0.001], [0, 0, -0.001]]) / MM, [1, 1])
    assert area(found) == pytest.approx(2 * 0.02**2) and found.flaws == (OPEN,)


def test_faces_that_disagree_with_their_part_are_turned():
    mesh = ball(0.02, subdivisions=2)
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    found = outer(surface(trimesh.Trimesh(mesh.vertices, faces, process=False)))
    np.testing.assert_array_equal(np.sort(found.vertices[found.faces], axis=1), np.sort(mesh.vertices[mesh.faces], axis=1))
    assert distance(found, [[0, 0, 0]])[0] < -0.018 and not found.flaws


def test_a_face_that_is_there_twice_opens_nothing():
    repeated = trimesh.Trimesh(CUBE.vertices, np.concatenate([CUBE.faces, CUBE.faces[3:4]]), process=False)
    found = outer(surface(repeated))
    assert len(found.faces) == 12 and not found.flaws


def test_a_band_with_one_side_is_named():
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([middle - 0.3 * across, middle + 0.3 * across])
    faces = [[k, k + 1, k + 24] for k in range(23)] + [[k + 1, k + 25, k + 24] for k in range(23)] + [[23, 24, 47], [24, 0, 47]]
    assert TWISTED in outer(surface(trimesh.Trimesh(vertices, faces, process=False))).flaws


@pytest.mark.parametrize("shift", [0.0, 1e-9, -1e-9])
def test_rounding_does_not_part_what_touches(shift):
    """A peg stands on a plate, up to what single precision makes of its vertices: under it there is no surface."""
    peg = trimesh.creation.cylinder(0.005, 0.02, sections=48).apply_translation((0.0031, 0.0017, 0.02 + shift))
    found = outer(surface(box((0.04, 0.04, 0.02)), peg))
    pos = [[0.0031, 0.0017, 0.01], [0.0031, 0.0017, 0.008], [0.015, 0, 0.009]]
    apothem = 5 * np.cos(np.pi / 48)
    np.testing.assert_allclose(distance(found, pos)[2] / MM, -1, atol=1e-5)
    # The nearest surface is the rim, which the peg's corners are on.
    assert -5 - 1e-5 < distance(found, pos)[0] / MM <= -apothem + 1e-5
    assert -np.hypot(5, 2) - 1e-5 < distance(found, pos)[1] / MM <= -np.hypot(apothem, 2) + 1e-5


def test_balls_across_each_other_are_cut_where_they_meet():
    """Of 8 in a ring, each crosses its two neighbours, and every second is inside out."""
    angle = np.arange(8) * 2 * np.pi / 8
    centers = 0.007 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    balls = [ball(0.004, tuple(center), subdivisions=3) for center in centers]
    found = outer(surface(*(inverted(each) if k % 2 else each for k, each in enumerate(balls))))
    pos = np.random.default_rng(0).uniform([-0.012, -0.012, -0.004], [0.012, 0.012, 0.004], (500, 3))
    true = (np.linalg.norm(pos[:, None] - centers, axis=2) - 0.004).min(axis=1)
    is_clear = np.abs(true) > 5e-5
    np.testing.assert_array_equal(distance(found, pos[is_clear]) < 0, true[is_clear] < 0)
    # Where two meet: halfway between them, their circle.
    halfway = 0.007 * np.sin(np.pi / 8)
    middle = 0.5 * (centers[0] + centers[1])
    np.testing.assert_allclose(distance(found, [middle])[0], -np.sqrt(0.004**2 - halfway**2), atol=5e-5)


def test_boxes_at_random_make_their_union():
    """On a lattice, so that faces and edges coincide, and turned at random; some of them inside out, as long as none is within one."""
    for seed in range(16):
        rng = np.random.default_rng(seed)
        parts, frames = [], []
        for _ in range(rng.integers(2, 7)):
            half, at, turn = rng.integers(1, 4, 3) * 0.005, rng.integers(-3, 4, 3) * 0.005, np.eye(4)
            if seed % 2:
                turn = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
            parts.append(trimesh.creation.box(2 * half).apply_transform(turn).apply_translation(at))
            frames.append((turn[:3, :3], at, half))

        def depth(pos: np.ndarray, frames=frames) -> np.ndarray:
            return np.array([(half - np.abs((pos - at) @ turn)).min(axis=1) for turn, at, half in frames])

        # One that is within an inverted one would be a cavity of it.
        is_free = [(depth(part.vertices) > 1e-6).all(axis=1).sum() == 0 for part in parts]
        can_turn = all(is_free) and rng.uniform() < 0.7
        found = outer(surface(*(inverted(part) if can_turn and rng.uniform() < 0.4 else part for part in parts)))
        pos = rng.uniform(-0.035, 0.035, (500, 3))
        inner = depth(pos).max(axis=0)
        is_clear = np.abs(inner) > 1e-5
        measured = distance(found, pos[is_clear])
        np.testing.assert_array_equal(measured < 0, inner[is_clear] > 0)
        middle = found.vertices[found.faces].mean(axis=1)
        assert depth(middle).max() < 1e-8, f"seed {seed}: surface within"
        assert not found.flaws


@pytest.mark.parametrize("limit", ["MAX_PAIRS", "MAX_SEGMENTS"])
def test_where_faces_are_not_cut_it_is_said_and_only_those_wholly_inside_go(monkeypatch, limit):
    monkeypatch.setattr(f"tgdsl.surfaces.outer.{limit}", 2)
    bar = box((0.004, 0.004, 0.06))
    within = box((0.01, 0.01, 0.01))
    found = outer(surface(CUBE, bar, within))
    assert found.flaws == (UNCUT,)
    np.testing.assert_array_equal(sorted(found.vertices[found.faces].reshape(-1, 9).tolist()), sorted(
        np.concatenate([CUBE.triangles, bar.triangles]).reshape(-1, 9).tolist()
    ))  # fmt: skip


def test_what_has_no_area_is_no_surface():
    with pytest.raises(BakeError, match=r"^a surface to bake needs a face with an area$"):
        outer(Surface(np.array([[0, 0, 0], [1, 0, 0], [2.0, 0, 0]]), np.array([[0, 1, 2]]), np.zeros(1, int), (("mesh",),)))


@pytest.mark.slow
def test_five_hundred_parts():
    """They fill a block; each of its sides is all that is left of theirs."""
    size = np.array([10, 10, 5]) * 0.02
    parts = [box((0.02, 0.02, 0.02), tuple(0.02 * np.array(at))) for at in np.ndindex(10, 10, 5)]
    found = outer(surface(*parts))
    assert area(found) == pytest.approx(2 * (size * np.roll(size, 1)).sum())
    np.testing.assert_allclose(distance(found, [[0.09, 0.09, 0.04]]), -0.05)
