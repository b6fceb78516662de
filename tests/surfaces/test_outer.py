"""The outer surface of a mesh of any parts: closed-form distances, and winding numbers of 1 or 0."""

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
    """Return one mesh of several parts, their vertices separate as in an OBJ file, or merged."""
    mesh = trimesh.util.concatenate(parts)
    if is_merged:
        mesh.merge_vertices()
    return Surface(np.array(mesh.vertices), np.array(mesh.faces), np.zeros(len(mesh.faces), int), (("mesh",),))


def distance(result: Outer, pos) -> np.ndarray:
    """Return signed distances [m] of points; require winding numbers of 0 or 1."""
    pos = np.array(pos, float)
    winding = winding_number(result.vertices, result.faces, pos)
    np.testing.assert_allclose(winding, np.round(winding), atol=1e-4)
    assert set(np.round(winding).tolist()) <= {0.0, 1.0}
    squared, *_ = igl.point_mesh_squared_distance(pos, result.vertices, result.faces)
    return np.where(winding > 0.5, -1.0, 1.0) * np.sqrt(squared)


def area(result: Outer) -> float:
    return 0.5 * float(igl.doublearea(result.vertices, result.faces).sum())


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
def test_distances_are_to_the_union_of_all_parts(name, is_merged):
    parts, pos, expected = CASES[name]
    result = outer(surface(*parts, is_merged=is_merged))
    np.testing.assert_allclose(distance(result, pos) / MM, expected, atol=1e-6)
    assert result.flaws == ((OPEN,) if "sheet" in name else ())


def test_parts_are_distinguished_by_their_vertices_in_the_file():
    """They share edges along a side of one, so positions alone do not say which faces are neighbours."""
    first, second = box((0.03, 0.03, 0.03), (-0.015, 0.005, 0), cuts=1), box((0.03, 0.01, 0.03), (0.015, 0, 0), cuts=1)
    bar, pos = box((0.006, 0.006, 0.05), (0.015, 0, 0)), [[-0.015, 0.005, 0], [0.015, 0, 0], [0, 0, 0], [0.01, 0.01, 0]]
    for parts in ((inverted(first), second, bar), (first, inverted(second), bar)):
        np.testing.assert_allclose(distance(outer(surface(*parts)), pos) / MM, [-15, -5, -5, 5], atol=1e-6)


@pytest.mark.parametrize("is_turned", [False, True])
def test_coincident_faces_are_kept_once(is_turned):
    """A bar through a cube is flush with two of its sides; their diagonals may cross."""
    bar = box((0.02, 0.02, 0.04))
    if is_turned:
        bar.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1]))
    for parts in ((CUBE, bar), (bar, CUBE)):
        assert area(outer(surface(*parts))) == pytest.approx(6 * 0.04**2)


def test_cuts_in_flat_faces_are_no_sharp_edges():
    """Faces of a cube are cut along the sides of a bar through it, and beyond."""
    solid = Solid(surface(CUBE, box((0.004, 0.004, 0.06))))
    np.testing.assert_allclose(solid.edge_distance(np.array([[0.013, 0.0019, 0.02], [0.0019, -0.013, -0.02]])) / MM, 7)


def test_lines_through_one_point_cut_a_triangle_into_six_cells():
    triangle = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0.0]])
    for turn in Rotation.random(20, rng=0).as_matrix():
        corners = triangle @ turn.T
        center = corners.mean(axis=0)
        ends = [[center - 3 * direction, center + 3 * direction] for direction in (corners - center)]
        cells = cut_cells(corners, np.array(ends), 1e-6)
        sides = [np.linalg.norm(cell - np.roll(cell, 1, axis=0), axis=1).min() for cell in cells]
        assert len(cells) == 6 and min(sides) > 0.1
        areas = [np.linalg.norm(np.cross(cell[1:-1] - cell[0], cell[2:] - cell[0]), axis=1).sum() / 2 for cell in cells]
        assert sum(areas) == pytest.approx(4.5)


def test_a_closed_mesh_is_unchanged():
    mesh = ball(0.02, subdivisions=3)
    result = outer(surface(mesh))
    np.testing.assert_array_equal(result.vertices[result.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(result.uncut, result.faces)


@pytest.mark.parametrize("is_inverted", [False, True])
def test_an_open_mesh_is_capped_and_flagged(is_inverted):
    cup = without_top(CUBE)
    result = outer(surface(inverted(cup) if is_inverted else cup))
    np.testing.assert_allclose(distance(result, [[0, 0, 0.017], [0, 0, 0.021], [0, 0, 0.025]]) / MM, [-3, 1, 5], atol=1e-9)
    assert result.flaws == (OPEN,)
    assert area(result) == pytest.approx(6 * 0.04**2)


def test_a_sheet_has_two_sides_and_no_inside():
    result = outer(surface(plate(np.array([0, 0, 1.0]), size=0.02)))
    np.testing.assert_allclose(distance(result, [[0, 0, 0.001], [0, 0, -0.001]]) / MM, [1, 1])
    assert area(result) == pytest.approx(2 * 0.02**2) and result.flaws == (OPEN,)


def test_faces_wound_against_their_part_are_flipped():
    mesh = ball(0.02, subdivisions=2)
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    result = outer(surface(trimesh.Trimesh(mesh.vertices, faces, process=False)))
    np.testing.assert_array_equal(np.sort(result.vertices[result.faces], axis=1), np.sort(mesh.vertices[mesh.faces], axis=1))
    assert distance(result, [[0, 0, 0]])[0] < -0.018 and not result.flaws


def test_a_repeated_face_opens_nothing():
    repeated = trimesh.Trimesh(CUBE.vertices, np.concatenate([CUBE.faces, CUBE.faces[3:4]]), process=False)
    result = outer(surface(repeated))
    assert len(result.faces) == 12 and not result.flaws


def test_a_moebius_band_is_flagged():
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([middle - 0.3 * across, middle + 0.3 * across])
    faces = [[k, k + 1, k + 24] for k in range(23)] + [[k + 1, k + 25, k + 24] for k in range(23)] + [[23, 24, 47], [24, 0, 47]]
    assert TWISTED in outer(surface(trimesh.Trimesh(vertices, faces, process=False))).flaws


@pytest.mark.parametrize("shift", [0.0, 1e-9, -1e-9])
def test_rounding_does_not_separate_touching_parts(shift):
    """A peg stands on a plate, up to single-precision rounding: there is no surface under it."""
    peg = trimesh.creation.cylinder(0.005, 0.02, sections=48).apply_translation((0.0031, 0.0017, 0.02 + shift))
    result = outer(surface(box((0.04, 0.04, 0.02)), peg))
    pos = [[0.0031, 0.0017, 0.01], [0.0031, 0.0017, 0.008], [0.015, 0, 0.009]]
    apothem = 5 * np.cos(np.pi / 48)
    np.testing.assert_allclose(distance(result, pos)[2] / MM, -1, atol=1e-5)
    # The nearest surface is the rim at the peg's corners.
    assert -5 - 1e-5 < distance(result, pos)[0] / MM <= -apothem + 1e-5
    assert -np.hypot(5, 2) - 1e-5 < distance(result, pos)[1] / MM <= -np.hypot(apothem, 2) + 1e-5


def test_overlapping_balls_are_cut_where_they_meet():
    """Each of 8 balls in a ring crosses its two neighbours, and every second one is inside out."""
    angle = np.arange(8) * 2 * np.pi / 8
    centers = 0.007 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    balls = [ball(0.004, tuple(center), subdivisions=3) for center in centers]
    result = outer(surface(*(inverted(part) if k % 2 else part for k, part in enumerate(balls))))
    pos = np.random.default_rng(0).uniform([-0.012, -0.012, -0.004], [0.012, 0.012, 0.004], (500, 3))
    expected = (np.linalg.norm(pos[:, None] - centers, axis=2) - 0.004).min(axis=1)
    is_clear = np.abs(expected) > 5e-5
    np.testing.assert_array_equal(distance(result, pos[is_clear]) < 0, expected[is_clear] < 0)
    # Two neighbours meet in a circle halfway between them.
    halfway = 0.007 * np.sin(np.pi / 8)
    middle = 0.5 * (centers[0] + centers[1])
    np.testing.assert_allclose(distance(result, [middle])[0], -np.sqrt(0.004**2 - halfway**2), atol=5e-5)


def test_random_boxes_are_merged_into_their_union():
    """Aligned on a lattice, so faces and edges coincide, or rotated; some inside out, unless another lies within."""
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

        # A box inside an inverted one would be its cavity.
        is_free = [(depth(part.vertices) > 1e-6).all(axis=1).sum() == 0 for part in parts]
        can_turn = all(is_free) and rng.uniform() < 0.7
        result = outer(surface(*(inverted(part) if can_turn and rng.uniform() < 0.4 else part for part in parts)))
        pos = rng.uniform(-0.035, 0.035, (500, 3))
        inner = depth(pos).max(axis=0)
        is_clear = np.abs(inner) > 1e-5
        measured = distance(result, pos[is_clear])
        np.testing.assert_array_equal(measured < 0, inner[is_clear] > 0)
        middle = result.vertices[result.faces].mean(axis=1)
        assert depth(middle).max() < 1e-8, f"seed {seed}: surface within"
        assert not result.flaws


@pytest.mark.parametrize("limit", ["MAX_PAIRS", "MAX_SEGMENTS"])
def test_beyond_the_limits_faces_stay_uncut_and_inner_parts_go(monkeypatch, limit):
    monkeypatch.setattr(f"tgdsl.surfaces.outer.{limit}", 2)
    bar = box((0.004, 0.004, 0.06))
    within = box((0.01, 0.01, 0.01))
    result = outer(surface(CUBE, bar, within))
    assert result.flaws == (UNCUT,)
    np.testing.assert_array_equal(sorted(result.vertices[result.faces].reshape(-1, 9).tolist()), sorted(
        np.concatenate([CUBE.triangles, bar.triangles]).reshape(-1, 9).tolist()
    ))  # fmt: skip


def test_a_surface_without_area_is_refused():
    with pytest.raises(BakeError, match=r"^a surface to bake needs a face with an area$"):
        outer(Surface(np.array([[0, 0, 0], [1, 0, 0], [2.0, 0, 0]]), np.array([[0, 1, 2]]), np.zeros(1, int), (("mesh",),)))


@pytest.mark.slow
def test_five_hundred_parts():
    """They fill a block; only its sides remain."""
    size = np.array([10, 10, 5]) * 0.02
    parts = [box((0.02, 0.02, 0.02), tuple(0.02 * np.array(at))) for at in np.ndindex(10, 10, 5)]
    result = outer(surface(*parts))
    assert area(result) == pytest.approx(2 * (size * np.roll(size, 1)).sum())
    np.testing.assert_allclose(distance(result, [[0.09, 0.09, 0.04]]), -0.05)
