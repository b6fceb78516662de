import os
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
import trimesh
from oracles.setups.solids import ball, box, surface_of
from surfaces import plate

from tgdsl.files import cache as where
from tgdsl.geometry.grid import one_grid
from tgdsl.geometry.shapes import SHAPES
from tgdsl.quantities.bake import METHODS, Baked, BakeError, bake
from tgdsl.surfaces.outer import OPEN
from tgdsl.surfaces.surface import Surface

MARGIN, TOLERANCE = 0.004, 2e-4
COARSE = 1e-3
SLACK = 1.15
"""Factor on the tolerance, for percentiles of few points."""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """Return the list of numbers of points of each call of libigl's winding number."""
    result, real = [], igl.fast_winding_number
    monkeypatch.setattr(igl, "fast_winding_number", lambda v, f, pos: (result.append(len(pos)), real(v, f, pos))[1])
    return result


def rounded_cube(half: float = 0.02, radius: float = 0.004) -> trimesh.Trimesh:
    v = np.array(trimesh.creation.icosphere(subdivisions=4, radius=radius).vertices)
    return trimesh.Trimesh(v + np.sign(np.round(v, 9)) * (half - radius)).convex_hull


def ask(baked: Baked, pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    grid = one_grid(torch.tensor(baked.values), torch.tensor(baked.origin), torch.tensor(baked.cell, dtype=torch.float64))
    distance, gradient = METHODS[baked.method](tuple(torch.tensor(pos).unbind(-1)), grid)
    return distance.numpy(), torch.stack(gradient, dim=-1).numpy()


def around(surface: Surface, count: int = 3000, width: float = MARGIN, seed: int = 7) -> np.ndarray:
    """Return points around a surface, other than the compiler's."""
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    on_surface, _ = trimesh.sample.sample_surface(mesh, count, seed=seed)
    direction = np.random.default_rng(seed).normal(size=(count, 3))
    return on_surface + width * direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.linspace(0, 1, count)[
        :, None
    ] ** (1 / 3)


def box_distance(pos: np.ndarray, half: tuple[float, float, float]) -> np.ndarray:
    size = tuple(torch.tensor(part, dtype=torch.float64) for part in half)
    return SHAPES["box"](tuple(torch.tensor(pos).unbind(-1)), size)[0].numpy()


def check(baked: Baked, pos: np.ndarray, distance: np.ndarray, tolerance: float = TOLERANCE) -> None:
    result, gradient = ask(baked, pos)
    assert np.percentile(np.abs(result - distance), 99) <= SLACK * tolerance
    assert baked.errors.p99 <= tolerance
    assert baked.errors.rms <= baked.errors.max and baked.errors.count > 1000
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-9)


def test_a_box_holds_the_tolerance():
    surface, half = surface_of(box((0.04, 0.03, 0.02))), (0.02, 0.015, 0.01)
    baked = bake(surface, MARGIN, TOLERANCE)
    pos = around(surface)
    q = np.sort(np.array(half) - np.abs(pos), axis=1)
    is_edge = np.linalg.norm([np.abs(q[:, 0]), np.abs(q[:, 1])], axis=0) < baked.cell
    check(baked, pos[~is_edge], box_distance(pos, half)[~is_edge])
    assert np.abs(ask(baked, pos)[0] - box_distance(pos, half)).max() < baked.cell / 2
    assert baked.errors.edge_count > 0 and 0 < baked.errors.edge_p99 <= baked.errors.edge_max < baked.cell / 2
    assert not baked.flaws and baked.values.dtype == np.float32


def test_a_sphere_holds_the_tolerance():
    surface = surface_of(ball(0.02, at=(0.1, 0, 0)))
    baked = bake(surface, MARGIN, TOLERANCE)
    pos = around(surface)
    # The centres of 5,120 facets lie up to 40 µm inside the sphere.
    check(baked, pos, np.linalg.norm(pos - [0.1, 0, 0], axis=1) - 0.02, TOLERANCE + 4e-5)
    assert baked.errors.edge_count == 0 and baked.errors.edge_max == 0


@pytest.mark.slow
def test_a_rounded_cube_holds_the_tolerance():
    surface = surface_of(rounded_cube())
    baked = bake(surface, MARGIN, TOLERANCE)
    pos = around(surface)
    exact, *_ = igl.signed_distance(pos, surface.vertices, surface.faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
    check(baked, pos, exact)


def test_a_thin_plate_has_two_sides():
    surface, half = surface_of(box((0.02, 0.02, 0.0008))), (0.01, 0.01, 0.0004)
    baked = bake(surface, 0.002, TOLERANCE)
    result, gradient = ask(baked, np.array([[0, 0, 0.001], [0, 0, -0.001], [0.003, 0, 0.0004], [0.003, 0.001, 0]]))
    np.testing.assert_allclose(result, [6e-4, 6e-4, 0, -4e-4], atol=1.5 * TOLERANCE)
    np.testing.assert_allclose(gradient[:2], [[0, 0, 1], [0, 0, -1]], atol=1e-3)
    pos = around(surface, width=0.002)
    pos = pos[np.abs(pos[:, :2]).max(axis=1) < 0.008]
    check(baked, pos, box_distance(pos, half))


def test_needles_and_degenerate_triangles_change_nothing():
    mesh = box((0.03, 0.03, 0.03))
    middle = mesh.vertices[mesh.faces[0]].mean(axis=0)
    a, b, c = mesh.faces[0]
    near = mesh.vertices[a] + 1e-5 * (middle - mesh.vertices[a])
    vertices = np.concatenate([mesh.vertices, [near, middle]])
    needles = [[a, b, 8], [b, c, 8], [c, a, 8]]
    faces = np.concatenate([mesh.faces[1:], needles, [[0, 0, 1], [9, 9, 9]]])
    surface = Surface(vertices, faces, np.zeros(len(faces), int), (("needles",),))
    baked, plain = bake(surface, MARGIN, TOLERANCE), bake(surface_of(mesh), MARGIN, TOLERANCE)
    assert not baked.flaws
    pos = around(surface_of(mesh))
    assert np.abs(ask(baked, pos)[0] - ask(plain, pos)[0]).max() < 1e-4
    check(baked, pos, box_distance(pos, (0.015,) * 3), 2 * TOLERANCE)


def test_a_missing_face_is_capped():
    mesh = box((0.03, 0.03, 0.03))
    is_top = mesh.face_normals[:, 2] > 0.5
    mesh.update_faces(~is_top)
    baked, pos = bake(surface_of(mesh), MARGIN, TOLERANCE), around(surface_of(box((0.03, 0.03, 0.03))))
    assert baked.flaws == (OPEN,)
    check(baked, pos, box_distance(pos, (0.015,) * 3), 2 * TOLERANCE)


def test_an_open_sheet_has_no_inside():
    baked = bake(surface_of(plate(np.array([0, 0, 1.0]))), 0.002, TOLERANCE)
    result, _ = ask(baked, np.array([[0, 0, 0.001], [0, 0, -0.001], [0.012, 0, 0]]))
    np.testing.assert_allclose(result, [0.001, 0.001, 0.002], atol=1.5 * TOLERANCE)
    assert baked.flaws == (OPEN,)


@pytest.mark.parametrize("is_flipped", [False, True])
def test_an_inner_shell_is_solid_and_a_flipped_one_a_cavity(is_flipped):
    inner = ball(0.01, subdivisions=3)
    if is_flipped:
        inner.invert()
    baked = bake(surface_of(ball(0.02), inner), MARGIN, TOLERANCE)
    result, _ = ask(baked, np.array([[0.011, 0, 0], [0, 0, 0.009], [0.0225, 0, 0]]))
    expected = [-0.001, 0.001, 0.0025] if is_flipped else [-0.009, -0.011, 0.0025]
    np.testing.assert_allclose(result, expected, atol=3e-4)


def test_overlapping_parts_make_one_solid():
    """Inner surfaces do not count: inside the bar, the nearest surface is where it leaves the box."""
    baked = bake(surface_of(box((0.02, 0.02, 0.02)), box((0.004, 0.004, 0.05))), MARGIN, TOLERANCE)
    result, _ = ask(baked, np.array([[0, 0, 0.001], [0.002, 0, 0], [0.0, 0.0, 0.02], [0.004, 0, 0.02]]))
    np.testing.assert_allclose(result, [-np.hypot(0.009, 0.002), -0.008, -0.002, 0.002], atol=1.5 * TOLERANCE)


def test_an_inverted_mesh_is_the_same_solid():
    mesh = box((0.03, 0.02, 0.03))
    plain = bake(surface_of(mesh), MARGIN, TOLERANCE)
    mesh.invert()
    inverted, pos = bake(surface_of(mesh), MARGIN, TOLERANCE), around(surface_of(mesh))
    assert np.percentile(np.abs(ask(inverted, pos)[0] - ask(plain, pos)[0]), 98) < 2 * TOLERANCE


def test_baking_scales_with_units():
    """Baking with all lengths in millimetres gives the same grid, scaled."""
    metres, millimetres = (
        bake(surface_of(box(tuple(k * np.array([0.03, 0.02, 0.01])))), k * MARGIN, k * TOLERANCE) for k in (1, 1e3)
    )
    assert metres.method == millimetres.method
    np.testing.assert_allclose(millimetres.values, 1e3 * metres.values, atol=1e-5)


def test_far_points_read_far():
    baked = bake(surface_of(box((0.02, 0.02, 0.02))), MARGIN, TOLERANCE)
    pos = np.random.default_rng(0).normal(size=(500, 3)) * 0.3
    expected = box_distance(pos, (0.01,) * 3)
    assert (ask(baked, pos)[0] >= np.where(expected > MARGIN, MARGIN, expected - TOLERANCE)).all()


def test_the_coarsest_grid_has_sixteen_cells_along_the_longest_side():
    """A ball of 4 cm with a margin of 4 mm gets cells of 3 mm."""
    baked = bake(surface_of(ball(0.02, subdivisions=3)), MARGIN, 0.01)
    assert baked.cell == pytest.approx(0.048 / 16, rel=1e-12)


@pytest.mark.slow
def test_a_finer_tolerance_takes_more_bytes_and_has_smaller_errors():
    surface = surface_of(rounded_cube())
    coarse, fine = bake(surface, MARGIN, 4e-4), bake(surface, MARGIN, 8e-5)
    assert fine.values.nbytes > coarse.values.nbytes and fine.errors.p99 < coarse.errors.p99


def test_the_cache_gives_the_same_bytes_without_the_work(calls, cache):
    surface = surface_of(box((0.02, 0.02, 0.02)))
    first = bake(surface, MARGIN, COARSE)
    assert calls and len(list(cache.iterdir())) == 1
    calls.clear()
    second = bake(surface, MARGIN, COARSE)
    assert not calls
    assert first.values.tobytes() == second.values.tobytes() and first.origin.tobytes() == second.origin.tobytes()
    assert (first.cell, first.method, first.errors, first.flaws) == (
        second.cell,
        second.method,
        second.errors,
        second.flaws,
    )
    bake(surface, MARGIN, 2 * COARSE)
    assert calls and len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 nothing", None])
def test_a_damaged_cache_file_is_rewritten(damage, calls, cache):
    surface = surface_of(box((0.02, 0.02, 0.02)))
    first = bake(surface, MARGIN, COARSE)
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    calls.clear()
    assert bake(surface, MARGIN, COARSE).values.tobytes() == first.values.tobytes()
    assert calls
    calls.clear()
    bake(surface, MARGIN, COARSE)
    assert not calls and list(cache.iterdir()) == [file]


def test_without_a_writable_cache_it_works(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "file" / "below"))
    assert bake(surface_of(box((0.02, 0.02, 0.02))), MARGIN, COARSE).errors.p99 <= COARSE


def test_the_cache_folder_follows_the_environment(monkeypatch):
    assert where.folder() == Path(os.environ["TGDSL_CACHE"])
    monkeypatch.delenv("TGDSL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/there")
    assert where.folder() == Path("/there/tgdsl")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/someone")
    assert where.folder() == Path("/home/someone/.cache/tgdsl")


@pytest.mark.slow
def test_baking_is_repeatable(monkeypatch, tmp_path):
    result = []
    for name in "ab":
        monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / name))
        result.append(bake(surface_of(ball(0.02, subdivisions=3)), MARGIN, 4e-4))
    assert result[0].values.tobytes() == result[1].values.tobytes() and result[0].errors == result[1].errors


def test_a_grid_over_its_budget_is_refused():
    surface = surface_of(box((0.02, 0.02, 0.02)))
    with pytest.raises(BakeError) as caught:
        bake(surface, MARGIN, 1e-6, budget=2**20)
    text = str(caught.value)
    assert text.startswith("a grid of a tolerance of 0.001 mm needs about ")
    assert text.endswith(" and the budget is 1 MiB (1048576 bytes); raise the tolerance or the budget")
    assert int(text.split("(")[1].split()[0]) > 2**20


def test_surfaces_that_cannot_be_baked_are_refused():
    surface = surface_of(box((0.02, 0.02, 0.02)))
    flat = Surface(surface.vertices, np.array([[0, 0, 1]]), np.zeros(1, int), surface.geoms)
    for wrong, margin, tolerance in (
        (surface.keep(np.zeros(12, bool)), MARGIN, TOLERANCE),
        (surface, 0.0, 1e-4),
        (surface, 1.0, 0.0),
    ):
        with pytest.raises(BakeError, match="needs faces, finite vertices, and a margin and a tolerance above 0"):
            bake(wrong, margin, tolerance)
    with pytest.raises(BakeError, match="needs a face with an area"):
        bake(flat, MARGIN, TOLERANCE)
