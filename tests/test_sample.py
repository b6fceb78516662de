"""The surface sampler against closed forms, brute force and statistics."""

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import TypeAdapter
from scipy.spatial import KDTree

from tgdsl.compiler import meshlab
from tgdsl.compiler.rays import Region, View, first_hits
from tgdsl.compiler.sample import SampleError, sample
from tgdsl.geometry.surface import Surface
from tgdsl.schema.placement import Placement

TOLERANCE = 1e-12  # metres: parts are centimetres in float64, and a position is a few sums
HERE = Path()
DOWN = [0, 0, -1]


def placement(method: str, **keys: object) -> Placement:
    keys = {"method": method, "radius": 0.002} | keys
    return TypeAdapter(Placement).validate_python({key: value for key, value in keys.items() if value is not None})


def surface_of(*meshes: trimesh.Trimesh) -> Surface:
    parts = [
        Surface(np.array(mesh.vertices), np.array(mesh.faces), np.zeros(len(mesh.faces), int), ((f"g{i}", f"mesh{i}"),))
        for i, mesh in enumerate(meshes)
    ]
    return Surface.joined(parts)


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0), cuts: int = 0) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    return mesh.apply_translation(at)


def ball(radius: float, at: tuple[float, float, float] = (0, 0, 0), subdivisions: int = 4) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).apply_translation(at)


def plate(normal: np.ndarray, size: float = 0.02) -> trimesh.Trimesh:
    """An open square whose edges run along y and across."""
    across = np.cross([0.0, 1.0, 0.0], normal)
    corners = [a * across + b * np.array([0, 1.0, 0]) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return trimesh.Trimesh(size / 2 * np.array(corners), [[0, 2, 1], [0, 3, 2]], process=False)


def error_of(surface: Surface, where: Placement, folder: Path = HERE) -> SampleError:
    with pytest.raises(SampleError) as caught:
        sample(surface, where, folder)
    return caught.value


# Grids ---------------------------------------------------------------------------------------------------------------


def test_grid_on_a_box_face_is_the_cell_centres():
    found = sample(surface_of(box((0.02, 0.04, 0.06))), placement("grid", rows=2, columns=4, direction=[0, 0, -3]), HERE)
    # Columns run along y, rows along direction × columns = (−z) × y = x.
    x, y = np.meshgrid([-0.005, 0.005], [-0.015, -0.005, 0.005, 0.015], indexing="ij")
    np.testing.assert_allclose(found.pos, np.stack([x, y, np.full_like(x, 0.03)], -1).reshape(-1, 3), atol=TOLERANCE)
    np.testing.assert_array_equal(found.normal, np.tile([0.0, 0, 1], (8, 1)))
    np.testing.assert_array_equal(found.tangent, np.tile([0.0, 1, 0], (8, 1)))
    np.testing.assert_allclose(found.area, 1e-4, rtol=1e-12)
    np.testing.assert_array_equal(found.radius, np.full(8, 0.002))
    np.testing.assert_array_equal(found.cell, [(r, c) for r in range(2) for c in range(4)])
    assert found.cell.dtype == np.int64


def test_columns_and_rows_are_right_handed_and_follow_columns_along():
    where = placement("grid", rows=2, columns=2, direction=DOWN, columns_along=[1, 0, 5])
    found = sample(surface_of(box((0.02, 0.04, 0.06))), where, HERE)
    np.testing.assert_allclose(found.pos[1] - found.pos[0], [0.01, 0, 0], atol=TOLERANCE)
    np.testing.assert_allclose(found.pos[2] - found.pos[0], [0, -0.02, 0], atol=TOLERANCE)  # (−z) × x = −y
    np.testing.assert_allclose(found.tangent, np.tile([1.0, 0, 0], (4, 1)), atol=TOLERANCE)


@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 2, -3), (-0.3, 0.1, 0.2)])
def test_grid_on_a_sphere_hits_inside_its_disc(direction):
    radius, rows, columns = 0.01, 15, 10
    mesh = ball(radius)
    found = sample(surface_of(mesh), placement("grid", rows=rows, columns=columns, direction=direction), HERE)
    sag = radius - np.linalg.norm(mesh.triangles.mean(axis=1), axis=1).min()
    distance = np.linalg.norm(found.pos, axis=1)
    assert distance.max() <= radius + TOLERANCE
    assert distance.min() >= radius - sag - TOLERANCE
    v, u = np.meshgrid((np.arange(rows) + 0.5) * 2 / rows - 1, (np.arange(columns) + 0.5) * 2 / columns - 1, indexing="ij")
    off = np.hypot(u, v).ravel()
    assert not ((off > 0.99) & (off < 1.005)).any()  # no cell so near the rim that the tessellation decides
    assert len(found.pos) == (off < 1).sum()
    assert (found.normal @ np.array(direction) < 0).all()
    np.testing.assert_allclose(found.normal, found.pos / distance[:, None], atol=0.06)  # facets of 3°
    np.testing.assert_allclose((found.normal * found.tangent).sum(1), 0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(found.tangent, axis=1), 1, rtol=1e-14)


@pytest.mark.parametrize("degrees", [0, 30, 80])
def test_areas_of_a_tilted_plane_add_up(degrees):
    angle = np.radians(degrees)
    surface = surface_of(plate(np.array([np.sin(angle), 0, np.cos(angle)])))
    found = sample(surface, placement("grid", rows=5, columns=3, direction=DOWN), HERE)
    assert len(found.pos) == 15
    np.testing.assert_allclose(found.area.sum(), 0.02**2, rtol=1e-12)


def test_steep_cells_count_at_most_ten_times_their_projection():
    angle = np.radians(89.9)
    surface = surface_of(plate(np.array([np.sin(angle), 0, np.cos(angle)])))
    found = sample(surface, placement("grid", rows=1, columns=1, direction=DOWN), HERE)
    np.testing.assert_allclose(found.area, 10 * 0.02**2 * np.cos(angle), rtol=1e-9)


def test_an_inside_out_mesh_gives_the_same_grid():
    where = placement("grid", rows=6, columns=5, direction=[1, 2, 3])
    mesh = ball(0.01)
    turned = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    one, other = sample(surface_of(mesh), where, HERE), sample(surface_of(turned), where, HERE)
    for name in ("pos", "normal", "tangent", "area", "cell"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=TOLERANCE)


def test_rays_agree_with_brute_force_on_a_triangle_soup():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (300, 1, 3)) + rng.uniform(-0.4, 0.4, (300, 3, 3))
    surface = Surface(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3), np.zeros(300, int), (("soup",),))
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes[2] *= np.linalg.det(axes)
    uv = rng.uniform(-1.5, 1.5, (2000, 2))
    view = View.of(surface, axes)
    hits = first_hits(view, uv)
    origin = uv @ axes[:2] - 10 * axes[2]
    matrix = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], np.tile(-axes[2], (300, 1))], -1)
    solution = np.linalg.solve(matrix[None], (origin[:, None] - corners[None, :, 0])[..., None])[..., 0]
    is_hit = (solution[..., :2] >= 0).all(-1) & (solution[..., :2].sum(-1) <= 1)
    depth = np.where(is_hit, solution[..., 2] - 10, np.inf)
    np.testing.assert_allclose(hits.depth, depth.min(axis=1), atol=1e-8)
    face = np.where(hits.face >= 0, view.face_id[hits.face], -1)
    np.testing.assert_array_equal(face, np.where(is_hit.any(1), depth.argmin(axis=1), -1))


def test_the_first_hit_is_never_on_an_inner_shell():
    surface = surface_of(ball(0.005), ball(0.01))
    found = sample(surface, placement("grid", rows=9, columns=9, direction=DOWN), HERE)
    assert np.linalg.norm(found.pos, axis=1).min() > 0.0099
    hidden = placement("grid", rows=9, columns=9, direction=DOWN, region={"geoms": "g0"})
    assert str(error_of(surface, hidden)) == "no part of the region is seen along [0, 0, -1]; turn `direction`"


@pytest.mark.parametrize("cuts", [0, 1, 3])
@pytest.mark.parametrize("shape", ["box", "ball"])
def test_a_box_region_inside_the_silhouette_gives_its_own_rectangle(cuts, shape):
    mesh = box((0.04, 0.04, 0.04), cuts=cuts) if shape == "box" else ball(0.02, subdivisions=1 + cuts)
    bounds = {"min": [-0.0071, -0.003, 0], "max": [0.0049, 0.0081, 1]}
    found = sample(surface_of(mesh), placement("grid", rows=4, columns=3, direction=DOWN, region={"box": bounds}), HERE)
    x, y = (-0.0071 + 0.012 * (np.arange(4) + 0.5) / 4), (-0.003 + 0.0111 * (np.arange(3) + 0.5) / 3)
    expected = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    np.testing.assert_allclose(found.pos[:, :2], expected, rtol=0, atol=1e-16)


def test_a_sphere_region_gives_the_bounding_square_of_its_disc():
    region = {"sphere": {"center": [0.001, 0.002, 0.003], "radius": 0.005}}
    where = placement("grid", rows=20, columns=20, direction=DOWN, region=region)
    found = sample(surface_of(plate(np.array([0, 0, 1.0]))), where, HERE)
    np.testing.assert_allclose(found.area, 0.008**2 / 400, rtol=1e-12)  # radius 4 mm where the plate cuts the sphere
    off = np.hypot(*np.meshgrid(np.arange(20) + 0.5 - 10, np.arange(20) + 0.5 - 10)) / 10
    assert len(found.pos) == (off <= 1).sum()


def test_a_region_cut_by_an_occluder_is_known_to_a_raster_cell():
    cover = trimesh.Trimesh([[0, -1, 0.1], [1, -1, 0.1], [1, 1, 0.1], [0, 1, 0.1]], [[0, 1, 2], [0, 2, 3]])
    where = placement("grid", rows=1, columns=1, direction=DOWN, region={"geoms": "g0"})
    found = sample(surface_of(plate(np.array([0, 0, 1.0])), cover), where, HERE)
    np.testing.assert_allclose(found.area, 0.01 * 0.02, rtol=1 / 128)
    np.testing.assert_allclose(found.pos[0], [-0.005, 0, 0], atol=0.01 / 128)


@pytest.mark.parametrize("noise", [0.0, 1e-10])
def test_count_keeps_the_central_cells_and_breaks_ties_by_row_and_column(noise):
    mesh = box((0.04, 0.04, 0.01))
    mesh = trimesh.Trimesh(mesh.vertices + np.random.default_rng(1).normal(size=(8, 3)) * noise, mesh.faces, process=False)
    kept = {
        count: sample(surface_of(mesh), placement("grid", rows=4, columns=4, direction=DOWN, count=count), HERE).cell
        for count in (1, 4, 5, 12)
    }
    np.testing.assert_array_equal(kept[1], [(1, 1)])
    np.testing.assert_array_equal(kept[4], [(1, 1), (1, 2), (2, 1), (2, 2)])
    np.testing.assert_array_equal(kept[5], [(0, 1), (1, 1), (1, 2), (2, 1), (2, 2)])
    corners = {(0, 0), (0, 3), (3, 0), (3, 3)}
    assert {tuple(cell) for cell in kept[12].tolist()} == {(r, c) for r in range(4) for c in range(4)} - corners


def test_count_measures_in_metres():
    surface = surface_of(box((0.01, 0.04, 0.01)))  # cells of 2.5 mm × 10 mm: the neighbours in the row are far
    found = sample(surface, placement("grid", rows=4, columns=4, direction=DOWN, count=8), HERE)
    assert {tuple(cell) for cell in found.cell.tolist()} == {(r, c) for r in range(4) for c in (1, 2)}


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
        "none of the grid's 1 cells hits the surface; give more `rows` and `columns`"
    )
    up = placement("grid", rows=1, columns=1, direction=DOWN, region={"facing": [0, 0, -1], "within": "80 deg"})
    assert str(error_of(surface, up)) == "no part of the region is seen along [0, 0, -1]; turn `direction`"


# Even samples --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3, 7, 50, 120, 500])
def test_poisson_gives_the_exact_count_evenly_on_the_surface(count):
    radius = 0.01
    mesh = ball(radius)
    found = sample(surface_of(mesh), placement("poisson", count=count), HERE)
    assert found.pos.shape == (count, 3)
    np.testing.assert_allclose(found.area.sum(), mesh.area, rtol=1e-9)
    assert (found.area > 0).all()
    np.testing.assert_array_equal(found.cell, np.full((count, 2), -1))
    _, face = KDTree(mesh.triangles_center).query(found.pos, k=8)
    height = ((found.pos[:, None] - mesh.triangles_center[face]) * mesh.face_normals[face]).sum(-1)
    own = np.abs((found.normal[:, None] * mesh.face_normals[face]).sum(-1) - 1).argmin(axis=1)
    assert np.abs(height[np.arange(count), own]).max() < 1e-9  # in the plane of the face whose normal it has
    if count >= 50:
        ideal = np.sqrt(2 * mesh.area / (np.sqrt(3) * count))  # hexagonal packing
        nearest = KDTree(found.pos).query(found.pos, k=2)[0][:, 1]
        assert nearest.min() > 0.7 * ideal
        random = np.random.default_rng(0).normal(size=(count, 3))
        random *= radius / np.linalg.norm(random, axis=1, keepdims=True)
        uniform = KDTree(random).query(random, k=2)[0][:, 1]
        assert nearest.mean() > 1.4 * uniform.mean()  # bluer: uniform points have 1/2√density
        assert nearest.std() / nearest.mean() < 0.12
        assert found.area.std() / found.area.mean() < 0.25


def test_poisson_is_the_same_bytes_each_time_and_differs_by_seed():
    def bytes_of(seed: int, **keys: object) -> bytes:
        found = sample(surface_of(box((0.01, 0.02, 0.03))), placement("poisson", seed=seed, **keys), HERE)
        return b"".join(getattr(found, name).tobytes() for name in ("pos", "normal", "tangent", "area"))

    for keys in ({"count": 40}, {"spacing": 0.003}):
        assert bytes_of(3, **keys) == bytes_of(3, **keys)
        assert bytes_of(3, **keys) != bytes_of(4, **keys)


@pytest.mark.parametrize("spacing", [0.002, 0.0051, 0.1])
def test_spacing_is_kept_and_leaves_no_gap(spacing):
    surface = surface_of(box((0.02, 0.02, 0.01)))
    found = sample(surface, placement("poisson", spacing=spacing), HERE)
    if len(found.pos) > 1:
        assert KDTree(found.pos).query(found.pos, k=2)[0][:, 1].min() >= spacing
    pool = meshlab.pool(meshlab.outer_shell(surface), Region(None, (), (), ()), 0, None, spacing)
    assert KDTree(found.pos).query(pool.pos)[0].max() <= spacing
    np.testing.assert_allclose(found.area.sum(), 2 * (0.0004 + 0.0002 + 0.0002), rtol=1e-9)


@pytest.mark.parametrize("sign", [1, -1], ids=["outward", "inside_out"])
def test_poisson_leaves_out_an_inner_shell(sign):
    inner, outer = ball(0.005, (0.002, 0, 0)), ball(0.01)
    inner.faces, outer.faces = inner.faces[:, ::sign], outer.faces[:, ::-sign]
    for meshes in ((inner, outer), (outer, inner), (trimesh.util.concatenate([outer, inner]),)):
        found = sample(surface_of(*meshes), placement("poisson", count=100), HERE)
        assert np.linalg.norm(found.pos, axis=1).min() > 0.0098
        assert ((found.normal * found.pos).sum(axis=1) > 0).all()
        np.testing.assert_allclose(found.area.sum(), outer.area, rtol=1e-9)


def test_poisson_samples_the_union_of_overlapping_boxes():
    found = sample(surface_of(box((2, 2, 2)), box((2, 2, 2), (1, 1, 1))), placement("poisson", count=600), HERE)
    for corner in (np.zeros(3), np.ones(3)):
        assert (np.abs(found.pos - corner).max(axis=1) > 1 - 1e-9).all()
    np.testing.assert_allclose(found.area.sum(), 2 * 24 - 6, rtol=0.01)


@pytest.mark.parametrize(("shift", "size", "area"), [((2, 0, 0), (2, 2, 2), 40), ((1, 0, 0), (2, 2, 2), 32)])
def test_poisson_counts_touching_and_flush_faces_as_the_union_does(shift, size, area):
    found = sample(surface_of(box((2, 2, 2)), box(size, shift)), placement("poisson", count=300), HERE)
    np.testing.assert_allclose(found.area.sum(), area, rtol=0.01)
    assert KDTree(found.pos).query(found.pos, k=2)[0][:, 1].min() > 0.2


def test_poisson_leaves_out_a_pocket_behind_a_pinhole():
    inner, outer = ball(0.008), ball(0.01)
    inner.faces = inner.faces[:, ::-1]
    hole = [mesh.faces[np.argmax(mesh.triangles_center[:, 2])] for mesh in (inner, outer)]
    joined = trimesh.util.concatenate([inner, outer])
    rim = [hole[0][::-1], hole[1] + len(inner.vertices)]
    corner = [np.argmin(np.linalg.norm(joined.vertices[rim[0]] * 1.25 - joined.vertices[i], axis=1)) for i in rim[1]]
    a, b = rim[0][corner], rim[1]
    tunnel = [f for i in range(3) for f in ([b[i], a[i], b[i - 2]], [a[i], a[i - 2], b[i - 2]])]
    faces = [f for f in joined.faces.tolist() if set(f) not in (set(rim[0]), set(rim[1]))]
    mesh = trimesh.Trimesh(joined.vertices, faces + tunnel, process=False)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    found = sample(surface_of(mesh), placement("poisson", count=300), HERE)
    assert (np.linalg.norm(found.pos, axis=1) < 0.0098).sum() <= 3


def test_poisson_on_open_meshes():
    bowl = ball(0.01)
    bowl.update_faces(bowl.triangles_center[:, 2] > 0)
    marble = ball(0.002)
    found = sample(surface_of(bowl, marble), placement("poisson", count=200), HERE)
    assert (np.linalg.norm(found.pos, axis=1) < 0.0021).any()  # a bowl encloses nothing
    np.testing.assert_allclose(found.area.sum(), bowl.area + marble.area, rtol=0.01)
    punctured = trimesh.Trimesh((shell := ball(0.01)).vertices, shell.faces[3:], process=False)
    found = sample(surface_of(punctured, marble), placement("poisson", count=200), HERE)
    assert np.linalg.norm(found.pos, axis=1).min() > 0.0098  # a few missing triangles do not make a bowl


def test_poisson_mends_windings_that_disagree():
    mesh = ball(0.01)
    faces = mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    found = sample(surface_of(trimesh.Trimesh(mesh.vertices, faces, process=False)), placement("poisson", count=80), HERE)
    assert ((found.normal * found.pos).sum(axis=1) > 0).all()


def test_poisson_densifies_for_a_small_region():
    region = {"sphere": {"center": [0.03, 0, 0.05], "radius": "0.5 mm"}}
    found = sample(surface_of(box((0.1, 0.1, 0.1))), placement("poisson", count=300, region=region), HERE)
    assert len(found.pos) == 300
    np.testing.assert_allclose(found.area.sum(), np.pi * 0.0005**2, rtol=0.03)


def test_poisson_errors(monkeypatch):
    surface = surface_of(ball(0.01))
    away = placement("poisson", count=3, region={"box": {"min": [1, 1, 1], "max": [2, 2, 2]}})
    assert str(error_of(surface, away)) == "no part of the link's outer surface is in the region; widen `region`"
    inside = placement("poisson", count=3, region={"geoms": "g0"})
    assert str(error_of(surface_of(ball(0.005), ball(0.01)), inside)) == (
        "no part of the link's outer surface is in the region; widen `region`"
    )
    assert str(error_of(surface, placement("poisson", spacing=1e-5))) == (
        "a spacing of 1e-05 m is too fine for a surface of 0.00126 m²; expected at least 0.0004 m"
    )
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    assert str(error_of(surface, placement("poisson", count=3))).startswith("`poisson` needs pymeshlab: ")
    assert len(sample(surface, placement("grid", rows=1, columns=1, direction=DOWN), HERE).pos) == 1


# Regions -------------------------------------------------------------------------------------------------------------

REGIONS = [
    ({"facing": [0, 0, 2], "within": "30 deg"}, lambda pos, normal: normal[:, 2] >= np.cos(np.radians(30)) - 1e-9),
    (
        {"box": {"min": [-0.002, -1, -1], "max": [0.005, 1, 1]}},
        lambda pos, normal: (pos[:, 0] + 0.002) * (0.005 - pos[:, 0]) >= -1e-9,
    ),
    (
        {"sphere": {"center": [0, 0.01, 0], "radius": 0.006}},
        lambda pos, normal: np.linalg.norm(pos - [0, 0.01, 0], axis=1) <= 0.006 + 2e-7,
    ),
    ({"geoms": ["no", "mesh0"]}, lambda pos, normal: pos[:, 0] < 0.012),
    ({"geoms": {"include": ["g*"], "exclude": ["*1"]}}, lambda pos, normal: pos[:, 0] < 0.012),
]


@pytest.mark.parametrize(
    "keys", [{"method": "poisson", "count": 150}, {"method": "grid", "rows": 9, "columns": 11, "direction": [0, -1, -1]}]
)
@pytest.mark.parametrize("parts", [*[[i] for i in range(len(REGIONS))], [1, 2, 3], [0, 1]], ids=str)
def test_regions(keys, parts):
    surface = surface_of(ball(0.01), ball(0.01, (0.03, 0, 0)))
    regions = [REGIONS[i][0] for i in parts]
    found = sample(surface, placement(**keys, region=regions if len(parts) > 1 else regions[0]), HERE)
    assert len(found.pos)
    for i in parts:
        assert REGIONS[i][1](found.pos, found.normal).all()
    if parts in ([3], [4]) and keys["method"] == "poisson":
        np.testing.assert_allclose(found.area.sum(), ball(0.01).area, rtol=1e-9)


def test_geoms_that_do_not_exist():
    surface = surface_of(box((1, 1, 1)), box((1, 1, 1)))
    assert str(error_of(surface, placement("poisson", count=3, region={"geoms": "mesh7"}))) == (
        'no geom or mesh of this link matches "mesh7"; did you mean "mesh1"?'
    )
    nothing = {"geoms": {"include": ["g0"], "exclude": ["*0"]}}
    assert str(error_of(surface, placement("poisson", count=3, region=nothing))) == (
        "`exclude` leaves none of the geoms that `include` takes; exclude less"
    )


# Points --------------------------------------------------------------------------------------------------------------


def test_points_are_taken_as_they_are():
    points = [
        {"pos": [9, 8, 7], "normal": [0, 0, 5], "area": "2 mm2"},
        {"pos": [1, 2, 3], "normal": [1e-200, 0, 0], "radius": 0.01},
        {"pos": [0, 0, 0], "normal": [0, 1, 0], "radius": 0},
    ]
    found = sample(surface_of(ball(0.01)), placement("points", points=points), HERE)
    np.testing.assert_array_equal(found.pos, [[9, 8, 7], [1, 2, 3], [0, 0, 0]])
    np.testing.assert_array_equal(found.normal, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(found.tangent, [[0, 1, 0], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(found.radius, [0.002, 0.01, 0])
    np.testing.assert_allclose(found.area, [2e-6, np.pi * 1e-4, 0], rtol=1e-12)
    np.testing.assert_array_equal(found.cell, np.full((3, 2), -1))


def test_points_from_a_file(tmp_path):
    text = "x, y, z, nx, ny, nz, radius, area\n1,2,3,0,0,2,,\n\n4,5,6,0,-3,4,0.01,1e-6\n"
    (tmp_path / "pads.csv").write_text("\ufeff" + text, encoding="utf-8")
    found = sample(surface_of(ball(1)), placement("points", points="pads.csv"), tmp_path)
    np.testing.assert_array_equal(found.pos, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(found.normal, [[0, 0, 1], [0, -0.6, 0.8]], rtol=1e-15)
    np.testing.assert_array_equal(found.radius, [0.002, 0.01])
    np.testing.assert_allclose(found.area, [np.pi * 0.002**2, 1e-6], rtol=1e-15)


HEADER = "x,y,z,nx,ny,nz"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z,nx,ny\n", "p.csv:1: no column nz; expected the header x,y,z,nx,ny,nz"),
        ("", "p.csv:1: no column x, y, z, nx, ny, nz; expected the header x,y,z,nx,ny,nz"),
        (f"{HEADER},radus\n", 'p.csv:1: unknown column "radus"; did you mean "radius"?'),
        (f"{HEADER}\n", "p.csv has no points"),
        (f"{HEADER},radius\n0,0,0,0,0,1,1\n0,0,b,0,0,1,1\n", 'p.csv:3: z is "b", expected a number'),
        (f"{HEADER},radius\n0,0,inf,0,0,1,1\n", 'p.csv:2: z is "inf", expected a number'),
        (f"{HEADER},radius\n0,,0,0,0,1,1\n", "p.csv:2: y is empty, expected a number"),
        (f"{HEADER}\n0,0,0,0,0,1,1\n", "p.csv:2: more values than the header has columns"),
        (f"{HEADER},radius\n0,0,0,0,0,1,-1\n", "p.csv:2: radius -1 is out of range, expected at least 0"),
        (f"{HEADER},area\n0,0,0,0,0,1,0\n", "p.csv:2: area 0 is out of range, expected more than 0"),
        (
            f"{HEADER},radius\n0,0,0,0,0,0,1\n",
            "p.csv:2: normal [0, 0, 0] has no direction; expected a vector of non-zero length",
        ),
        (
            f"{HEADER}\n0,0,0,0,0,1\n",
            "p.csv:2: the point has no radius; add a column `radius`, or give one `radius` for the whole file",
        ),
    ],
)
def test_bad_files_of_points(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    where = placement("points", points="p.csv", radius=None)
    assert str(error_of(surface_of(ball(1)), where, tmp_path)) == message


def test_a_missing_file_of_points(tmp_path):
    error = error_of(surface_of(ball(1)), placement("points", points="no.csv"), tmp_path)
    assert (error.what, error.hint) == ("cannot read the points of no.csv: No such file or directory", "")
