"""Integrals over what a body fills of a grid, and over its surface, against closed forms."""

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


def integral(found: cells.Filled, function) -> float:
    """Return ∫ f dV by the weights of the cells' points."""
    points = cells.gauss(cells.POINTS)[0]
    local = np.stack(np.meshgrid(points, points, points, indexing="ij"), axis=-1).reshape(-1, 3)
    at = found.low[:, None] + found.size[:, None] * local
    return float((found.weight * function(at) * found.size.prod(axis=1)[:, None]).sum())


def test_a_box_is_exact_in_every_moment():
    """Up to degree four along each axis; cells end where it ends."""
    found, on = cut(surface_of(box((2.0, 1.0, 0.5))), 0.3)
    assert (found.weight > 0).all()
    for powers in [(0, 0, 0), (2, 0, 0), (0, 4, 2), (4, 4, 4), (3, 0, 0)]:
        wanted = np.prod(
            [0 if p % 2 else 2 * (side / 2) ** (p + 1) / (p + 1) for side, p in zip((2.0, 1.0, 0.5), powers, strict=True)]
        )
        axes = cells.axes(*closed(surface_of(box((2.0, 1.0, 0.5)))))
        mine = np.abs(axes).argmax(axis=0)  # which of the grid's axes is the body's x, y, z
        got = integral(found, lambda at, p=powers, m=mine: np.prod([at[..., m[i]] ** p[i] for i in range(3)], axis=0))
        assert got == pytest.approx(wanted, abs=1e-12)
    assert on.area.sum() == pytest.approx(2 * (2 + 1 + 0.5), rel=1e-12)


def test_a_ball_that_is_cut_by_its_cells():
    mesh = ball(1.0, subdivisions=5)
    found, on = cut(surface_of(mesh), 0.45)
    assert found.volume.sum() == pytest.approx(mesh.volume, rel=1e-3)
    second = integral(found, lambda at: (at**2).sum(axis=-1))
    assert second == pytest.approx(4 * np.pi / 5, rel=2e-3)
    assert on.area.sum() == pytest.approx(4 * np.pi, rel=5e-3)
    assert (on.normal * on.pos).sum(axis=1) == pytest.approx(np.ones(len(on.pos)), abs=2e-3)
    for axis in range(3):  # ∫ n² dA = A/3
        assert (on.area * on.normal[:, axis] ** 2).sum() == pytest.approx(4 * np.pi / 3, rel=5e-3)


def test_a_thin_wall_askew_in_its_cells():
    """2 mm of wall in cells of 25 mm that do not follow it: what they hold of it is right to a percent."""
    mesh = turned(thin_box(0.1, 0.002), (0.3, 0.5, 0.2), (0.0, 0.0, 0.0))
    found, on = cut(surface_of(mesh), 0.025, along=np.eye(3))
    assert found.volume.sum() == pytest.approx(0.1**3 - 0.096**3, rel=0.01)
    assert on.area.sum() == pytest.approx(6 * (0.1**2 + 0.096**2), rel=0.01)
    assert (on.area[:, None] * on.normal).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-3 * on.area.sum())


def test_geoms_that_overlap_or_touch_are_one_solid():
    """Their common volume counts once, and surfaces between them not at all."""
    wanted_volume, wanted_area = 0.1**3 - 0.096**3, 6 * (0.1**2 + 0.096**2)
    found, on = cut(surface_of(*slabs(0.1, 0.002)), 0.02)
    assert found.volume.sum() == pytest.approx(wanted_volume, rel=1e-9)
    assert on.area.sum() == pytest.approx(wanted_area, rel=1e-9)
    crossing = surface_of(box((0.1, 0.02, 0.02)), box((0.02, 0.1, 0.02)), box((0.02, 0.02, 0.1)))
    found, on = cut(crossing, 0.01)
    arms = 3 * 0.1 * 0.02**2 - 2 * 0.02**3
    assert found.volume.sum() == pytest.approx(arms, rel=1e-9)
    assert on.area.sum() == pytest.approx(6 * 0.02**2 + 6 * 4 * 0.04 * 0.02, rel=1e-9)


def test_a_screw_in_its_hole_is_part_of_the_body():
    inside = trimesh.util.concatenate([box((0.1, 0.1, 0.1)), box((0.05, 0.05, 0.05))])
    found, on = cut(surface_of(inside), 0.03)
    assert found.volume.sum() == pytest.approx(1e-3, rel=1e-9)
    assert on.area.sum() == pytest.approx(0.06, rel=1e-9)
    found, _ = cut(surface_of(hollow(box((0.1, 0.1, 0.1)), box((0.05, 0.05, 0.05)))), 0.03)
    assert found.volume.sum() == pytest.approx(1e-3 - 0.05**3, rel=1e-9)


@pytest.mark.parametrize(("sections", "cell"), [(8, 0.1), (96, 0.1), (8, 0.037)])
def test_edges_where_lines_of_sight_are(sections, cell):
    """A cylinder's edges and those of its caps run through its axis, along diagonals too, as lines of sight lie."""
    mesh = trimesh.creation.cylinder(0.3, 0.5, sections=sections)
    for sight in (3, 12):
        found, _ = cut(surface_of(mesh), cell, sight)
        assert found.volume.sum() == pytest.approx(mesh.volume, rel=0.02)
    tube = trimesh.creation.annulus(0.28, 0.3, 0.5, sections=sections)
    assert cut(surface_of(tube), cell)[0].volume.sum() == pytest.approx(tube.volume, rel=0.03)


def test_axes_follow_the_flat_faces():
    """Of a box that is turned, its own; of a rod with round ends its length; of a ball the frame's."""
    vector = (0.3, 0.8, -0.4)
    mesh = turned(box((0.3, 0.2, 0.1)), vector, (1.0, 2.0, 3.0))
    found = cells.axes(*closed(surface_of(mesh)))
    own = turned(trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False), vector, (0.0, 0.0, 0.0)).vertices
    assert np.abs(found @ own.T).max(axis=1) == pytest.approx(np.ones(3))
    assert np.linalg.det(found) == pytest.approx(1.0)
    rod = turned(trimesh.creation.capsule(0.3, 0.02, count=[24, 24]), vector, (0.0, 0.0, 0.0))
    assert np.abs(cells.axes(*closed(surface_of(rod))) @ own[2]).max() == pytest.approx(1.0, abs=1e-4)


def test_lines_keep_thin_walls_and_leave_out_small_steps():
    """Walls of a hundredth of a cell; and a step of two small faces beside a large one."""
    wall = cells.Planes(np.array([0.0, 0.001, 0.999, 1.0]), np.array([1.0, 0.99, 0.99, 1.0]))
    assert cells.lines(wall, 0.0, 1.0, 0.5) == pytest.approx([0.0, 0.001, 0.5, 0.999, 1.0])
    step = cells.Planes(np.array([0.0, 0.001, 1.0]), np.array([1.0, 0.05, 1.0]))
    assert cells.lines(step, 0.0, 1.0, 0.5) == pytest.approx([0.0, 0.5, 1.0])
    assert cells.lines(cells.Planes(np.zeros(0), np.zeros(0)), -1.0, 1.0, 1.0) == pytest.approx([-1.0, 0.0, 1.0])


def test_faces_that_rounding_puts_a_little_apart_are_one_plane():
    """As coordinates of a mesh in float32 are: no cell is thinner than that."""
    noisy = cells.Planes(np.array([2e-8, 0.5, 1 - 3e-8]), np.array([1.0, 1.0, 1.0]))
    assert cells.lines(noisy, 0.0, 1.0, 0.5).tolist() == [0.0, 0.5, 1.0]
    mesh = turned(thin_box(0.1, 0.002), (0.3, 0.5, 0.2), (0.01, 0.02, 0.03))
    mesh.vertices = mesh.vertices.astype(np.float32)
    found, _ = cut(surface_of(mesh), 0.02)
    assert found.size.min() == pytest.approx(0.002, rel=1e-3)
    assert found.weight.sum(axis=1) == pytest.approx(np.ones(len(found.index)), abs=1e-3)
