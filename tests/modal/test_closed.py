"""Repairs of triangles, checked by the enclosed volume, and messages for irreparable ones."""

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import ball, box, surface_of
from ringing_bodies import hollow, thin_box

from tgdsl.errors import LowerError
from tgdsl.modal.cells import closed, enclosed
from tgdsl.surfaces.surface import Surface

CUBE = 0.1**3


def volume(surface: Surface) -> float:
    return enclosed(*closed(surface))


def changed(mesh: trimesh.Trimesh, vertices=None, faces=None) -> Surface:
    vertices = mesh.vertices if vertices is None else vertices
    return surface_of(trimesh.Trimesh(vertices, mesh.faces if faces is None else faces, process=False))


def test_sound_meshes_keep_their_volume():
    assert volume(surface_of(box((0.1, 0.1, 0.1)))) == pytest.approx(CUBE)
    assert volume(surface_of(thin_box(0.1, 0.002))) == pytest.approx(CUBE - 0.096**3)


def test_a_tiny_mesh_far_from_its_frame_keeps_its_volume():
    """10 µm across, 10 m away: whether a mesh is flat depends on its shape alone."""
    assert volume(surface_of(box((1e-5, 1e-5, 1e-5), at=(10.0, 0.0, 0.0)))) == pytest.approx(1e-15, rel=1e-6)


def test_triangles_with_separate_corners_are_joined():
    """As STL files store them, and slightly apart."""
    mesh = box((0.1, 0.1, 0.1))
    noise = 1e-10 * np.random.default_rng(0).standard_normal((36, 3))
    corners = mesh.vertices[mesh.faces].reshape(-1, 3) + noise
    vertices, faces = closed(changed(mesh, corners, np.arange(36).reshape(-1, 3)))
    assert len(vertices) == 8 and len(faces) == 12
    assert enclosed(vertices, faces) == pytest.approx(CUBE)


def test_an_inverted_mesh_is_flipped_and_keeps_its_cavity():
    mesh = thin_box(0.1, 0.002)
    assert volume(changed(mesh, faces=mesh.faces[:, ::-1])) == pytest.approx(CUBE - 0.096**3)


def test_inconsistent_neighbours_follow_the_majority_of_the_area():
    mesh = ball(0.05, subdivisions=2)
    faces = mesh.faces.copy()
    faces[:40] = faces[:40, ::-1]
    assert volume(changed(mesh, faces=faces)) == pytest.approx(mesh.volume)


def test_repeated_and_flat_triangles_are_dropped():
    mesh = box((0.1, 0.1, 0.1))
    faces = np.concatenate([mesh.faces, np.roll(mesh.faces[3:5], 1, axis=1), [[0, 0, 1]]])
    assert volume(changed(mesh, faces=faces)) == pytest.approx(CUBE)


def test_a_small_hole_is_closed():
    mesh = ball(0.05, subdivisions=3)
    repaired = volume(changed(mesh, faces=mesh.faces[1:]))
    assert repaired == pytest.approx(mesh.volume, rel=1e-4)


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        (
            changed(box((0.1, 0.1, 0.1)), faces=box((0.1, 0.1, 0.1)).faces[:-2]),
            r'"g0" is open: 400 mm of edges without a second',
        ),
        (surface_of(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])), r'"g0" is open: '),
        (
            changed(box((1, 1, 1)), box((1, 1, 1)).vertices * [1, 1, 0]),
            r'"g0" encloses no volume; a thin wall needs both of its sides',
        ),
        (changed(box((1, 1, 1)), np.full((8, 3), np.nan)), r'"g0" has a vertex that is no number'),
        (changed(box((1, 1, 1)), faces=np.array([[0, 0, 1]])), r'"g0" has no triangle with an area'),
        (Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), ()), "there are no triangles"),
    ],
    ids=["no lid", "sheet", "flat", "not a number", "no area", "nothing"],
)
def test_surfaces_without_an_inside_are_errors(surface, message):
    with pytest.raises(LowerError, match=message) as caught:
        closed(surface)
    assert caught.value.field == "modes"


def test_a_shell_wound_like_the_outer_one_is_no_cavity():
    """A screw in its hole is part of the body: only a shell wound the other way is a cavity."""
    inside = trimesh.util.concatenate([box((0.1, 0.1, 0.1)), box((0.096, 0.096, 0.096))])
    assert volume(surface_of(inside)) == pytest.approx(CUBE + 0.096**3), "counted as often as it is wound around"
    assert volume(surface_of(hollow(box((0.1, 0.1, 0.1)), box((0.096, 0.096, 0.096))))) == pytest.approx(CUBE - 0.096**3)
