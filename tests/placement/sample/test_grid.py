"""Grids against closed forms."""

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import ball, box, surface_of
from surfaces import DOWN, HERE, error_of, placement, plate

from tgdsl.placement.sample import sample as sampling
from tgdsl.placement.sample.sample import sample

TOLERANCE = 1e-12  # metres: positions are a few sums of centimetres in float64


def test_taxels_on_a_box_face_are_cell_centres():
    grid = placement("grid", rows=2, columns=4, direction=[0, 0, -3])
    samples = sample(surface_of(box((0.02, 0.04, 0.06))), grid, HERE)
    # Columns run along y, rows along direction × columns = (−z) × y = x.
    x, y = np.meshgrid([-0.005, 0.005], [-0.015, -0.005, 0.005, 0.015], indexing="ij")
    np.testing.assert_allclose(samples.pos, np.stack([x, y, np.full_like(x, 0.03)], -1).reshape(-1, 3), atol=TOLERANCE)
    np.testing.assert_array_equal(samples.normal, np.tile([0.0, 0, 1], (8, 1)))
    np.testing.assert_array_equal(samples.tangent, np.tile([0.0, 1, 0], (8, 1)))
    np.testing.assert_allclose(samples.area, 1e-4, rtol=1e-12)
    np.testing.assert_array_equal(samples.radius, np.full(8, 0.002))
    np.testing.assert_array_equal(samples.cell, [(r, c) for r in range(2) for c in range(4)])
    assert samples.cell.dtype == np.int64


def test_columns_and_rows_are_right_handed_and_follow_columns_along():
    where = placement("grid", rows=2, columns=2, direction=DOWN, columns_along=[1, 0, 5])
    samples = sample(surface_of(box((0.02, 0.04, 0.06))), where, HERE)
    np.testing.assert_allclose(samples.pos[1] - samples.pos[0], [0.01, 0, 0], atol=TOLERANCE)
    np.testing.assert_allclose(samples.pos[2] - samples.pos[0], [0, -0.02, 0], atol=TOLERANCE)  # (−z) × x = −y
    np.testing.assert_allclose(samples.tangent, np.tile([1.0, 0, 0], (4, 1)), atol=TOLERANCE)


def test_grids_of_several_resolutions_compute_their_rectangle_once(monkeypatch):
    """Positions equal those of each grid alone to the bit; another region has another rectangle."""
    pad, cache, calls = surface_of(ball(0.01)), {}, []
    region = [{"box": {"min": [-0.004, -0.003, 0], "max": [0.004, 0.003, 1]}}]
    placements = [placement("grid", rows=n, columns=2, direction=DOWN, region=region) for n in (2, 3)]
    placements.append(placement("grid", rows=2, columns=2, direction=DOWN, region=[{"facing": [0, 0, 1], "within": 0.3}]))
    alone = [sample(pad, where, HERE) for where in placements]
    original = sampling.visible_rectangle
    monkeypatch.setattr(sampling, "visible_rectangle", lambda *arguments: calls.append(arguments) or original(*arguments))
    for where, expected in zip(placements, alone, strict=True):
        assert sample(pad, where, HERE, drawn=cache).pos.tobytes() == expected.pos.tobytes()
    assert len(calls) == 2


def test_reversed_rows_on_a_mirrored_pad_give_the_mirror_images_in_order():
    # An off-centre box on a flat pad; mirrored along y, and columns follow x on both, so rows run along −y, then along y.
    flip = np.array([1.0, -1, 1])
    pad = surface_of(box((0.04, 0.04, 0.01)))
    keys = {"rows": 3, "columns": 4, "count": 5, "direction": DOWN, "columns_along": [1, 0, 0]}
    one, other = (
        sample(pad, placement("grid", **keys, rows_reversed=is_mirrored, region={"box": bounds}), HERE)
        for is_mirrored, bounds in (
            (False, {"min": [-0.008, -0.003, 0], "max": [0.012, 0.015, 1]}),
            (True, {"min": [-0.008, -0.015, 0], "max": [0.012, 0.003, 1]}),
        )
    )
    # Cells of 5 mm × 6 mm: the middle two are kept, and the first three of the next four, which are equally far out.
    cell = [(0, 1), (0, 2), (1, 1), (1, 2), (2, 1)]
    x, y = np.array([-0.0055, -0.0005, 0.0045, 0.0095]), np.array([0.012, 0.006, 0.0])
    row, column = np.array(cell).T
    np.testing.assert_array_equal(one.cell, cell)
    np.testing.assert_allclose(one.pos, np.stack([x[column], y[row], np.full(5, 0.005)], axis=1), rtol=0, atol=TOLERANCE)
    np.testing.assert_array_equal(other.cell, one.cell)
    np.testing.assert_allclose(other.pos, one.pos * flip, rtol=0, atol=TOLERANCE)
    for name in ("normal", "tangent"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name) * flip, atol=TOLERANCE)
    np.testing.assert_allclose(other.area, one.area, rtol=1e-12)


def test_reversed_rows_flip_the_tangent_of_a_face_across_the_columns():
    surface = surface_of(plate(np.array([1, 0, 5e-4]) / np.hypot(1, 5e-4)))
    keys = {"rows": 1, "columns": 1, "direction": DOWN, "columns_along": [1, 0, 0]}
    for is_mirrored, expected in ((False, [0, -1, 0]), (True, [0, 1, 0])):
        samples = sample(surface, placement("grid", **keys, rows_reversed=is_mirrored), HERE)
        np.testing.assert_allclose(samples.tangent, [expected], atol=TOLERANCE)


@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 2, -3), (-0.3, 0.1, 0.2)])
def test_grid_on_a_sphere_hits_inside_its_disc(direction):
    radius, rows, columns = 0.01, 15, 10
    mesh = ball(radius)
    samples = sample(surface_of(mesh), placement("grid", rows=rows, columns=columns, direction=direction), HERE)
    sag = radius - np.linalg.norm(mesh.triangles.mean(axis=1), axis=1).min()
    distance = np.linalg.norm(samples.pos, axis=1)
    assert distance.max() <= radius + TOLERANCE
    assert distance.min() >= radius - sag - TOLERANCE
    row, column = ((np.arange(count) + 0.5) * 2 / count - 1 for count in (rows, columns))
    v, u = np.meshgrid(row, column, indexing="ij")
    off = np.hypot(u, v).ravel()
    assert not ((off > 0.99) & (off < 1.005)).any()  # no cell depends on the tessellation of the rim
    assert len(samples.pos) == (off < 1).sum()
    assert (samples.normal @ np.array(direction) < 0).all()
    np.testing.assert_allclose(samples.normal, samples.pos / distance[:, None], atol=0.06)  # facets of 3°
    np.testing.assert_allclose((samples.normal * samples.tangent).sum(1), 0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(samples.tangent, axis=1), 1, rtol=1e-14)


@pytest.mark.parametrize("degrees", [0, 30, 80])
def test_areas_of_a_tilted_plane_add_up(degrees):
    angle = np.radians(degrees)
    surface = surface_of(plate(np.array([np.sin(angle), 0, np.cos(angle)])))
    samples = sample(surface, placement("grid", rows=5, columns=3, direction=DOWN), HERE)
    assert len(samples.pos) == 15
    np.testing.assert_allclose(samples.area.sum(), 0.02**2, rtol=1e-12)


def test_steep_cells_count_at_most_ten_times_their_projection():
    angle = np.radians(89.9)
    surface = surface_of(plate(np.array([np.sin(angle), 0, np.cos(angle)])))
    samples = sample(surface, placement("grid", rows=1, columns=1, direction=DOWN), HERE)
    np.testing.assert_allclose(samples.area, 10 * 0.02**2 * np.cos(angle), rtol=1e-9)


def test_an_inside_out_mesh_gives_the_same_grid():
    where = placement("grid", rows=6, columns=5, direction=[1, 2, 3])
    mesh = ball(0.01)
    inverted = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    one, other = sample(surface_of(mesh), where, HERE), sample(surface_of(inverted), where, HERE)
    for name in ("pos", "normal", "tangent", "area", "cell"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=TOLERANCE)


def test_the_first_hit_is_never_on_an_inner_shell():
    surface = surface_of(ball(0.005), ball(0.01))
    samples = sample(surface, placement("grid", rows=9, columns=9, direction=DOWN), HERE)
    assert np.linalg.norm(samples.pos, axis=1).min() > 0.0099
    hidden = placement("grid", rows=9, columns=9, direction=DOWN, region={"geoms": "g0"})
    assert str(error_of(surface, hidden)) == "no part of the region is visible along [0, 0, -1]; turn `direction`"


@pytest.mark.parametrize("cuts", [0, 1, 3])
@pytest.mark.parametrize("shape", ["box", "ball"])
def test_a_box_region_inside_the_silhouette_gives_its_own_rectangle(cuts, shape):
    mesh = box((0.04, 0.04, 0.04), cuts=cuts) if shape == "box" else ball(0.02, subdivisions=1 + cuts)
    bounds = {"min": [-0.0071, -0.003, 0], "max": [0.0049, 0.0081, 1]}
    samples = sample(surface_of(mesh), placement("grid", rows=4, columns=3, direction=DOWN, region={"box": bounds}), HERE)
    x, y = (-0.0071 + 0.012 * (np.arange(4) + 0.5) / 4), (-0.003 + 0.0111 * (np.arange(3) + 0.5) / 3)
    expected = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    np.testing.assert_allclose(samples.pos[:, :2], expected, rtol=0, atol=1e-16)


def test_a_sphere_region_gives_the_bounding_square_of_its_disc():
    region = {"sphere": {"center": [0.001, 0.002, 0.003], "radius": 0.005}}
    where = placement("grid", rows=20, columns=20, direction=DOWN, region=region)
    samples = sample(surface_of(plate(np.array([0, 0, 1.0]))), where, HERE)
    np.testing.assert_allclose(samples.area, 0.008**2 / 400, rtol=1e-12)  # the plate cuts the sphere at a radius of 4 mm
    off = np.hypot(*np.meshgrid(np.arange(20) + 0.5 - 10, np.arange(20) + 0.5 - 10)) / 10
    assert len(samples.pos) == (off <= 1).sum()


def test_a_region_cut_by_an_occluder_is_known_to_a_raster_cell():
    cover = trimesh.Trimesh([[0, -1, 0.1], [1, -1, 0.1], [1, 1, 0.1], [0, 1, 0.1]], [[0, 1, 2], [0, 2, 3]])
    where = placement("grid", rows=1, columns=1, direction=DOWN, region={"geoms": "g0"})
    samples = sample(surface_of(plate(np.array([0, 0, 1.0])), cover), where, HERE)
    np.testing.assert_allclose(samples.area, 0.01 * 0.02, rtol=1 / 128)
    np.testing.assert_allclose(samples.pos[0], [-0.005, 0, 0], atol=0.01 / 128)


@pytest.mark.parametrize("noise", [0.0, 1e-10])
def test_count_keeps_the_central_cells_and_breaks_ties_by_row_and_column(noise):
    mesh = box((0.04, 0.04, 0.01))
    vertices = mesh.vertices + np.random.default_rng(1).normal(size=(8, 3)) * noise
    mesh = trimesh.Trimesh(vertices, mesh.faces, process=False)
    cells_by_count = {
        count: sample(surface_of(mesh), placement("grid", rows=4, columns=4, direction=DOWN, count=count), HERE).cell
        for count in (1, 4, 5, 12)
    }
    np.testing.assert_array_equal(cells_by_count[1], [(1, 1)])
    np.testing.assert_array_equal(cells_by_count[4], [(1, 1), (1, 2), (2, 1), (2, 2)])
    np.testing.assert_array_equal(cells_by_count[5], [(0, 1), (1, 1), (1, 2), (2, 1), (2, 2)])
    corners = {(0, 0), (0, 3), (3, 0), (3, 3)}
    assert {tuple(cell) for cell in cells_by_count[12].tolist()} == {(r, c) for r in range(4) for c in range(4)} - corners


def test_count_measures_in_metres():
    surface = surface_of(box((0.01, 0.04, 0.01)))  # cells of 2.5 mm × 10 mm: neighbours along y are far
    samples = sample(surface, placement("grid", rows=4, columns=4, direction=DOWN, count=8), HERE)
    assert {tuple(cell) for cell in samples.cell.tolist()} == {(r, c) for r in range(4) for c in (1, 2)}


def test_grid_errors_say_what_to_change():
    surface = surface_of(ball(0.01))
    assert str(error_of(surface, placement("grid", rows=2, columns=3, direction=DOWN, columns_along=[0, 0, 2]))) == (
        "`columns_along` [0, 0, 2] is parallel to `direction` [0, 0, -1]; choose an axis across it"
    )
    assert str(error_of(surface, placement("grid", rows=10, columns=10, direction=DOWN, count=99))) == (
        "only 80 of the grid's 100 cells hit the surface, expected `count` 99; lower `count`, or give more `rows` and `columns`"
    )
    pads = surface_of(box((0.01, 0.01, 0.01), (0.02, 0, 0)), box((0.01, 0.01, 0.01), (-0.02, 0, 0)))
    assert str(error_of(pads, placement("grid", rows=1, columns=1, direction=DOWN))) == (
        "none of the grid's 1 cells hits the surface along [0, 0, -1]; `direction` points into the surface: "
        "is [0, 0, 1] meant? Else give more `rows` and `columns`"
    )
    up = placement("grid", rows=1, columns=1, direction=DOWN, region={"facing": [0, 0, -1], "within": "80 deg"})
    assert str(error_of(surface, up)) == "no part of the region is visible along [0, 0, -1]; turn `direction`"
