"""Integrals over the filled part of grid cells, and over a body's surface, against closed forms."""

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import ball, box, surface_of
from ringing_bodies import hollow, slabs, thin_box, turned

from tgdsl.modal import cells
from tgdsl.modal.cells import closed
from tgdsl.surfaces.surface import Surface


def cut(
    surface: Surface, cell: float, sight: int = 12, along: np.ndarray | None = None
) -> tuple[cells.Filled, cells.Crossings]:
    vertices, faces = closed(surface)
    vertices = vertices @ (cells.axes(vertices, faces) if along is None else along).T
    x, y, z = (
        cells.lines(cells.planes(vertices, faces, axis), vertices[:, axis].min(), vertices[:, axis].max(), cell)
        for axis in range(3)
    )
    return cells.filled(vertices, faces, (x, y, z), sight, 1e-6)


def integral(filled: cells.Filled, function) -> float:
    """Return ∫ f dV, weighting the points of each cell."""
    points = cells.gauss(cells.POINTS)[0]
    local = np.stack(np.meshgrid(points, points, points, indexing="ij"), axis=-1).reshape(-1, 3)
    at = filled.low[:, None] + filled.size[:, None] * local
    return float((filled.weight * function(at) * filled.size.prod(axis=1)[:, None]).sum())


def test_a_box_is_exact_in_every_moment():
    """Up to degree four along each axis; cells end at the faces of the box."""
    filled, crossings = cut(surface_of(box((2.0, 1.0, 0.5))), 0.3)
    assert (filled.weight > 0).all()
    for powers in [(0, 0, 0), (2, 0, 0), (0, 4, 2), (4, 4, 4), (3, 0, 0)]:
        expected = np.prod(
            [0 if p % 2 else 2 * (side / 2) ** (p + 1) / (p + 1) for side, p in zip((2.0, 1.0, 0.5), powers, strict=True)]
        )
        axes = cells.axes(*closed(surface_of(box((2.0, 1.0, 0.5)))))
        grid_axes = np.abs(axes).argmax(axis=0)  # which of the grid's axes is the body's x, y, z
        moment = integral(filled, lambda at, p=powers, m=grid_axes: np.prod([at[..., m[i]] ** p[i] for i in range(3)], axis=0))
        assert moment == pytest.approx(expected, abs=1e-12)
    assert crossings.area.sum() == pytest.approx(2 * (2 + 1 + 0.5), rel=1e-12)


def test_moments_of_a_ball_that_cells_cut():
    mesh = ball(1.0, subdivisions=5)
    filled, crossings = cut(surface_of(mesh), 0.45)
    assert filled.volume.sum() == pytest.approx(mesh.volume, rel=1e-3)
    second = integral(filled, lambda at: (at**2).sum(axis=-1))
    assert second == pytest.approx(4 * np.pi / 5, rel=2e-3)
    assert crossings.area.sum() == pytest.approx(4 * np.pi, rel=5e-3)
    assert (crossings.normal * crossings.pos).sum(axis=1) == pytest.approx(np.ones(len(crossings.pos)), abs=2e-3)
    for axis in range(3):  # ∫ n² dA = A/3
        assert (crossings.area * crossings.normal[:, axis] ** 2).sum() == pytest.approx(4 * np.pi / 3, rel=5e-3)


def test_a_thin_wall_oblique_to_its_cells():
    """2 mm walls in cells of 25 mm that do not follow them: volume and area are right to a percent."""
    mesh = turned(thin_box(0.1, 0.002), (0.3, 0.5, 0.2), (0.0, 0.0, 0.0))
    filled, crossings = cut(surface_of(mesh), 0.025, along=np.eye(3))
    assert filled.volume.sum() == pytest.approx(0.1**3 - 0.096**3, rel=0.01)
    assert crossings.area.sum() == pytest.approx(6 * (0.1**2 + 0.096**2), rel=0.01)
    assert (crossings.area[:, None] * crossings.normal).sum(axis=0) == pytest.approx(
        np.zeros(3), abs=1e-3 * crossings.area.sum()
    )


def test_overlapping_or_touching_geoms_are_one_solid():
    """Common volume counts once; surfaces between the geoms do not count."""
    expected_volume, expected_area = 0.1**3 - 0.096**3, 6 * (0.1**2 + 0.096**2)
    filled, crossings = cut(surface_of(*slabs(0.1, 0.002)), 0.02)
    assert filled.volume.sum() == pytest.approx(expected_volume, rel=1e-9)
    assert crossings.area.sum() == pytest.approx(expected_area, rel=1e-9)
    crossing = surface_of(box((0.1, 0.02, 0.02)), box((0.02, 0.1, 0.02)), box((0.02, 0.02, 0.1)))
    filled, crossings = cut(crossing, 0.01)
    arms = 3 * 0.1 * 0.02**2 - 2 * 0.02**3
    assert filled.volume.sum() == pytest.approx(arms, rel=1e-9)
    assert crossings.area.sum() == pytest.approx(6 * 0.02**2 + 6 * 4 * 0.04 * 0.02, rel=1e-9)


def test_a_screw_in_its_hole_is_part_of_the_body():
    inside = trimesh.util.concatenate([box((0.1, 0.1, 0.1)), box((0.05, 0.05, 0.05))])
    filled, crossings = cut(surface_of(inside), 0.03)
    assert filled.volume.sum() == pytest.approx(1e-3, rel=1e-9)
    assert crossings.area.sum() == pytest.approx(0.06, rel=1e-9)
    filled, _ = cut(surface_of(hollow(box((0.1, 0.1, 0.1)), box((0.05, 0.05, 0.05)))), 0.03)
    assert filled.volume.sum() == pytest.approx(1e-3 - 0.05**3, rel=1e-9)


@pytest.mark.parametrize(("sections", "cell"), [(8, 0.1), (96, 0.1), (8, 0.037)])
def test_edges_may_lie_on_lines_of_sight(sections, cell):
    """The edges of a cylinder and of its caps meet its axis, along diagonals too, where lines of sight lie."""
    mesh = trimesh.creation.cylinder(0.3, 0.5, sections=sections)
    for sight in (3, 12):
        filled, _ = cut(surface_of(mesh), cell, sight)
        assert filled.volume.sum() == pytest.approx(mesh.volume, rel=0.02)
    tube = trimesh.creation.annulus(0.28, 0.3, 0.5, sections=sections)
    assert cut(surface_of(tube), cell)[0].volume.sum() == pytest.approx(tube.volume, rel=0.03)


def test_axes_follow_the_flat_faces():
    """The axes of a turned box; the length of a rod with round ends; the frame of a ball."""
    vector = (0.3, 0.8, -0.4)
    mesh = turned(box((0.3, 0.2, 0.1)), vector, (1.0, 2.0, 3.0))
    axes = cells.axes(*closed(surface_of(mesh)))
    body_axes = turned(trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False), vector, (0.0, 0.0, 0.0)).vertices
    assert np.abs(axes @ body_axes.T).max(axis=1) == pytest.approx(np.ones(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    rod = turned(trimesh.creation.capsule(0.3, 0.02, count=[24, 24]), vector, (0.0, 0.0, 0.0))
    assert np.abs(cells.axes(*closed(surface_of(rod))) @ body_axes[2]).max() == pytest.approx(1.0, abs=1e-4)


def test_lines_keep_thin_walls_and_drop_small_steps():
    """Walls of a hundredth of a cell; a step of two small faces next to a large one."""
    wall = cells.Planes(np.array([0.0, 0.001, 0.999, 1.0]), np.array([1.0, 0.99, 0.99, 1.0]))
    assert cells.lines(wall, 0.0, 1.0, 0.5) == pytest.approx([0.0, 0.001, 0.5, 0.999, 1.0])
    step = cells.Planes(np.array([0.0, 0.001, 1.0]), np.array([1.0, 0.05, 1.0]))
    assert cells.lines(step, 0.0, 1.0, 0.5) == pytest.approx([0.0, 0.5, 1.0])
    assert cells.lines(cells.Planes(np.zeros(0), np.zeros(0)), -1.0, 1.0, 1.0) == pytest.approx([-1.0, 0.0, 1.0])


def test_faces_that_differ_by_rounding_are_one_plane():
    """Coordinates of a mesh in float32 create no thinner cells."""
    noisy = cells.Planes(np.array([2e-8, 0.5, 1 - 3e-8]), np.array([1.0, 1.0, 1.0]))
    assert cells.lines(noisy, 0.0, 1.0, 0.5).tolist() == [0.0, 0.5, 1.0]
    mesh = turned(thin_box(0.1, 0.002), (0.3, 0.5, 0.2), (0.01, 0.02, 0.03))
    mesh.vertices = mesh.vertices.astype(np.float32)
    filled, _ = cut(surface_of(mesh), 0.02)
    assert filled.size.min() == pytest.approx(0.002, rel=1e-3)
    assert filled.weight.sum(axis=1) == pytest.approx(np.ones(len(filled.index)), abs=1e-3)
