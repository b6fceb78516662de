"""Even samples against closed forms and statistics."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import ball, box, surface_of
from scipy.spatial import KDTree
from surfaces import DOWN, HERE, error_of, placement

from tgdsl.placement.sample import poisson
from tgdsl.placement.sample.sample import sample
from tgdsl.surfaces import meshlab
from tgdsl.surfaces.region import Region


@pytest.mark.parametrize("count", [1, 7, 120])
def test_poisson_gives_the_exact_count_evenly_on_the_surface(count):
    radius = 0.01
    mesh = ball(radius)
    samples = sample(surface_of(mesh), placement("poisson", count=count), HERE)
    assert samples.pos.shape == (count, 3)
    np.testing.assert_allclose(samples.area.sum(), mesh.area, rtol=1e-9)
    assert (samples.area > 0).all()
    np.testing.assert_array_equal(samples.cell, np.full((count, 2), -1))
    _, face = KDTree(mesh.triangles_center).query(samples.pos, k=8)
    height = ((samples.pos[:, None] - mesh.triangles_center[face]) * mesh.face_normals[face]).sum(-1)
    nearest_face = np.abs((samples.normal[:, None] * mesh.face_normals[face]).sum(-1) - 1).argmin(axis=1)
    assert np.abs(height[np.arange(count), nearest_face]).max() < 1e-9  # in the plane of the face with its normal
    if count >= 50:
        ideal = np.sqrt(2 * mesh.area / (np.sqrt(3) * count))  # hexagonal packing
        nearest = KDTree(samples.pos).query(samples.pos, k=2)[0][:, 1]
        assert nearest.min() > 0.7 * ideal
        random = np.random.default_rng(0).normal(size=(count, 3))
        random *= radius / np.linalg.norm(random, axis=1, keepdims=True)
        uniform = KDTree(random).query(random, k=2)[0][:, 1]
        assert nearest.mean() > 1.4 * uniform.mean()  # bluer: uniform points have 1/2√density
        assert nearest.std() / nearest.mean() < 0.12
        assert samples.area.std() / samples.area.mean() < 0.25


def test_poisson_is_repeatable_and_differs_by_seed():
    def bytes_of(seed: int, **keys: object) -> bytes:
        samples = sample(surface_of(box((0.01, 0.02, 0.03))), placement("poisson", seed=seed, **keys), HERE)
        return b"".join(getattr(samples, name).tobytes() for name in ("pos", "normal", "tangent", "area"))

    for keys in ({"count": 40}, {"spacing": 0.003}):
        assert bytes_of(3, **keys) == bytes_of(3, **keys)
        assert bytes_of(3, **keys) != bytes_of(4, **keys)


@pytest.mark.parametrize("spacing", [0.002, 0.0051, 0.1])
def test_samples_keep_their_spacing_without_gaps(spacing):
    surface = surface_of(box((0.02, 0.02, 0.01)))
    samples = sample(surface, placement("poisson", spacing=spacing), HERE)
    if len(samples.pos) > 1:
        assert KDTree(samples.pos).query(samples.pos, k=2)[0][:, 1].min() >= spacing
    pool = poisson.pool(meshlab.outer_shell(surface), Region(None, (), (), ()), 0, None, spacing)
    assert KDTree(samples.pos).query(pool.pos)[0].max() <= spacing
    np.testing.assert_allclose(samples.area.sum(), 2 * (0.0004 + 0.0002 + 0.0002), rtol=1e-9)


@pytest.mark.parametrize("sign", [1, -1], ids=["outward", "inside_out"])
def test_poisson_leaves_out_an_inner_shell(sign):
    inner, outer = ball(0.005, (0.002, 0, 0)), ball(0.01)
    inner.faces, outer.faces = inner.faces[:, ::sign], outer.faces[:, ::-sign]
    for meshes in ((inner, outer), (outer, inner), (trimesh.util.concatenate([outer, inner]),)):
        samples = sample(surface_of(*meshes), placement("poisson", count=100), HERE)
        assert np.linalg.norm(samples.pos, axis=1).min() > 0.0098
        assert ((samples.normal * samples.pos).sum(axis=1) > 0).all()
        np.testing.assert_allclose(samples.area.sum(), outer.area, rtol=1e-9)


def test_poisson_samples_the_union_of_overlapping_boxes():
    samples = sample(surface_of(box((2, 2, 2)), box((2, 2, 2), (1, 1, 1))), placement("poisson", count=600), HERE)
    for corner in (np.zeros(3), np.ones(3)):
        assert (np.abs(samples.pos - corner).max(axis=1) > 1 - 1e-9).all()
    np.testing.assert_allclose(samples.area.sum(), 2 * 24 - 6, rtol=0.01)


@pytest.mark.parametrize(("shift", "size", "area"), [((2, 0, 0), (2, 2, 2), 40), ((1, 0, 0), (2, 2, 2), 32)])
def test_poisson_counts_touching_and_flush_faces_once(shift, size, area):
    samples = sample(surface_of(box((2, 2, 2)), box(size, shift)), placement("poisson", count=300), HERE)
    np.testing.assert_allclose(samples.area.sum(), area, rtol=0.01)
    assert KDTree(samples.pos).query(samples.pos, k=2)[0][:, 1].min() > 0.2


def test_poisson_leaves_out_a_pocket_behind_a_pinhole():
    inner, outer = ball(0.008, subdivisions=3), ball(0.01, subdivisions=3)
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
    samples = sample(surface_of(mesh), placement("poisson", count=100), HERE)
    assert (np.linalg.norm(samples.pos, axis=1) < 0.0098).sum() <= 1


def test_components_are_closed_if_they_have_no_border():
    whole, holed, turned = (trimesh.creation.icosphere(3, 0.01) for _ in range(3))
    holed.update_faces(np.arange(len(holed.faces)) > 0)
    turned.faces[0] = turned.faces[0, ::-1]
    for i, mesh in enumerate((whole, holed, turned)):
        mesh.apply_translation([0.03 * i, 0, 0])
    shell = meshlab.outer_shell(surface_of(trimesh.util.concatenate([whole, holed])))
    assert shell.is_solid.tolist() == [True, True] and shell.is_closed.tolist() == [True, False]
    assert meshlab.outer_shell(surface_of(turned)).is_closed.tolist() == [True]  # cleaning unifies the windings


def test_visible_points_of_closed_meshes_need_no_winding_numbers(monkeypatch):
    """Another ball lies inside a ball except for a cap; only points hidden from the first directions need winding numbers."""
    num_asked, winding = list[int](), meshlab.Shell.winding
    monkeypatch.setattr(
        meshlab.Shell, "winding", lambda shell_object, i, pos: num_asked.append(len(pos)) or winding(shell_object, i, pos)
    )
    small = ball(0.005)
    small.apply_translation([0.01, 0, 0])
    surface = surface_of(trimesh.util.concatenate([ball(0.01), small]))
    shell = meshlab.outer_shell(surface)
    num_asked.clear()
    samples = poisson.pool(shell, Region(None, (), (), ()), seed=0, count=1, spacing=None)
    # They meet in a circle at x = 8.75 mm: caps of 1.25 mm and 3.75 mm are inside the other ball.
    outside = 2 * np.pi * (0.01 * 0.01875 + 0.005 * 0.00625)
    assert samples is not None and samples.area == pytest.approx(outside, rel=0.01)
    assert sum(num_asked) < 0.5 * len(samples.pos)


def test_points_inside_other_solids_are_viewed_from_one_direction(monkeypatch):
    num_rays, is_clear = [], poisson.is_clear
    monkeypatch.setattr(poisson, "is_clear", lambda view, rays: num_rays.append(len(rays)) or is_clear(view, rays))
    balls = [ball(0.01), ball(0.01).apply_translation([0.004, 0, 0])]
    shell = meshlab.outer_shell(surface_of(*balls))
    pool = poisson.pool(shell, Region(None, (), (), ()), seed=0, count=1, spacing=None)
    assert pool is not None
    num_drawn = len(pool.pos) * sum(each.area for each in balls) / pool.area  # 40 % are in the other ball
    assert sum(num_rays) < 1.2 * num_drawn


def test_poisson_on_open_meshes():
    bowl = ball(0.01)
    bowl.update_faces(bowl.triangles_center[:, 2] > 0)
    marble = ball(0.002)
    samples = sample(surface_of(bowl, marble), placement("poisson", count=200), HERE)
    assert (np.linalg.norm(samples.pos, axis=1) < 0.0021).any()  # a bowl encloses nothing
    np.testing.assert_allclose(samples.area.sum(), bowl.area + marble.area, rtol=0.01)
    punctured = trimesh.Trimesh((shell := ball(0.01)).vertices, shell.faces[3:], process=False)
    samples = sample(surface_of(punctured, marble), placement("poisson", count=200), HERE)
    assert np.linalg.norm(samples.pos, axis=1).min() > 0.0098  # a few missing triangles do not make a bowl


def test_poisson_repairs_inconsistent_windings():
    mesh = ball(0.01)
    faces = mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    mixed = trimesh.Trimesh(mesh.vertices, faces, process=False)
    samples = sample(surface_of(mixed), placement("poisson", count=80), HERE)
    assert ((samples.normal * samples.pos).sum(axis=1) > 0).all()


def test_poisson_densifies_for_a_small_region():
    region = {"sphere": {"center": [0.03, 0, 0.05], "radius": "0.5 mm"}}
    samples = sample(surface_of(box((0.1, 0.1, 0.1))), placement("poisson", count=300, region=region), HERE)
    assert len(samples.pos) == 300
    np.testing.assert_allclose(samples.area.sum(), np.pi * 0.0005**2, rtol=0.03)


def test_poisson_errors_say_what_to_change(monkeypatch):
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


PYMESHLAB = """
import sys; sys.path[:0] = ["tests/helpers", "tests"]
from oracles.setups.solids import box, surface_of
from surfaces import HERE, placement
from tgdsl.placement.sample.sample import sample
samples = sample(surface_of(box((0.01, 0.02, 0.03))), placement("poisson", count=40, sampler="pymeshlab"), HERE)
sys.stdout.write((samples.pos.tobytes() + samples.normal.tobytes() + samples.area.tobytes()).hex())
"""


def test_pymeshlab_draws_the_same_bytes_in_every_process():
    def bytes_of(**keys: object) -> str:
        samples = sample(surface_of(box((0.01, 0.02, 0.03))), placement("poisson", count=40, **keys), HERE)
        return (samples.pos.tobytes() + samples.normal.tobytes() + samples.area.tobytes()).hex()

    root = Path(__file__).parents[3]
    fresh = subprocess.run([sys.executable, "-c", PYMESHLAB], cwd=root, capture_output=True, text=True, check=True).stdout
    assert bytes_of(sampler="pymeshlab") == bytes_of(sampler="pymeshlab") == fresh
    assert fresh not in (bytes_of(sampler="pymeshlab", seed=1), bytes_of(sampler="lattice"))
    assert bytes_of(sampler="lattice") == bytes_of()


@pytest.mark.parametrize("keys", [{"count": 7}, {"count": 120}, {"spacing": 0.0015}], ids=str)
def test_pymeshlab_spreads_samples_evenly_over_the_region(keys):
    radius, region = 0.01, {"facing": [0, 0, 1], "within": "60 deg"}
    mesh = ball(radius, subdivisions=3)
    samples = sample(surface_of(mesh), placement("poisson", sampler="pymeshlab", region=region, **keys), HERE)
    is_in = mesh.face_normals[:, 2] >= 0.5
    np.testing.assert_allclose(samples.area.sum(), mesh.area_faces[is_in].sum(), rtol=1e-9)
    triangles = mesh.triangles[is_in]
    from_plane = ((samples.pos[:, None] - triangles[:, 0]) * mesh.face_normals[is_in]).sum(axis=2)
    of_normal = np.linalg.norm(samples.normal[:, None] - mesh.face_normals[is_in], axis=2).argmin(axis=1)
    assert np.abs(from_plane[np.arange(len(samples.pos)), of_normal]).max() < 1e-9  # on the face with its normal
    nearest = KDTree(samples.pos).query(samples.pos, k=2)[0][:, 1]
    if "count" in keys:
        assert len(samples.pos) == keys["count"]
        ideal = np.sqrt(2 * samples.area.sum() / (np.sqrt(3) * keys["count"]))  # hexagonal packing
        assert nearest.min() > 0.6 * ideal and nearest.std() / nearest.mean() < 0.12
    else:
        assert nearest.min() >= keys["spacing"]
        gaps = KDTree(samples.pos).query(triangles.mean(axis=1))[0]
        assert gaps.max() <= 1.05 * keys["spacing"]  # up to the distances of the pool's points
