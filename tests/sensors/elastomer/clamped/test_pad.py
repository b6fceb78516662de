"""Pads laid flat: isometric to the surface, whatever its triangles; invalid pads are refused by name.

Lengths agree to 1e-9 of the pad where the surface is exactly developable, else to the tolerance of the unrolling (2 %).
"""

from pathlib import Path

import numpy as np
import pads
import pytest
import trimesh
from pads import MM
from scipy.spatial.transform import Rotation

from tgdsl.errors import LowerError
from tgdsl.sensors.elastomer.clamped import pad as pad_module
from tgdsl.sensors.elastomer.clamped.pad import Pad, unroll
from tgdsl.surfaces.surface import Surface

EXACT = 1e-9
SIZE = 1 * MM
GRID = np.stack(np.meshgrid([2.0, 9.3, 17.1, 23.0], [1.7, 8.8, 18.0]), axis=-1).reshape(-1, 2) * MM
"""Taxels on a plate of 25 by 20 mm."""
PLATES = {
    "two triangles": pads.plate(),
    "fine": pads.plate(cells=(50, 40)),
    "slivers": pads.slivers(),
    "T-junctions": Surface.joined(
        [
            pads.plate(10 * MM, 20 * MM, (1, 3)),
            pads.moved(pads.plate(15 * MM, 20 * MM, (2, 4)), np.eye(3), np.array([10 * MM, 0, 0])),
        ]
    ),
}


def places(pad: Pad) -> np.ndarray:
    """Return the positions of the taxels in the plane."""
    return pad.at_taxels @ pad.basis.doflocs.T


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def angles(pad: Pad) -> np.ndarray:
    """Return the angles of the elements [deg]."""
    corners = pad.basis.mesh.p.T[pad.basis.mesh.t.T]
    u, v = np.roll(corners, -1, axis=1) - corners, np.roll(corners, -2, axis=1) - corners
    return np.degrees(np.arctan2(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0], (u * v).sum(axis=2)))


def area(pad: Pad) -> float:
    a, b, c = pad.basis.mesh.p.T[pad.basis.mesh.t]
    return float(0.5 * np.cross(np.c_[b - a, 0 * a[:, :1]], np.c_[c - a, 0 * a[:, :1]])[:, 2].sum())


def assert_frames(axes: np.ndarray, normal: np.ndarray) -> None:
    """Assert that axes are orthonormal and right-handed with the normal."""
    np.testing.assert_allclose(np.einsum("nux,nvx->nuv", axes, axes), np.tile(np.eye(2), (len(axes), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.cross(axes[:, 0], axes[:, 1]), normal, atol=1e-12)


@pytest.mark.parametrize("surface", PLATES.values(), ids=PLATES)
def test_a_plate_stays_itself_whatever_its_triangles(surface):
    pos, normal = pads.upward(GRID)
    pad = unroll(surface, pos, normal, SIZE)
    rim = pad.edge_pos
    on_rim = np.stack([rim[:, 0], 25 * MM - rim[:, 0], rim[:, 1], 20 * MM - rim[:, 1]]).min(axis=0)
    np.testing.assert_allclose(on_rim, 0, atol=EXACT * MM)
    np.testing.assert_allclose(rim[:, 2], 0, atol=EXACT * MM)
    shift = pad.basis.doflocs.T[pad.edge] - rim[:, :2]
    np.testing.assert_allclose(shift, np.tile(shift[0], (len(shift), 1)), atol=EXACT * MM)
    np.testing.assert_allclose(places(pad) - GRID, np.tile(shift[0], (len(GRID), 1)), atol=EXACT * MM)
    np.testing.assert_allclose(pad.edge_axes, np.tile(np.eye(3)[:2], (len(rim), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(pad.taxel_axes, np.tile(np.eye(3)[:2], (len(GRID), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(area(pad), 500 * MM**2, rtol=EXACT)
    assert angles(pad).min() > 25
    assert len(rim) == 2 * 90  # a corner each millimetre, and a middle between


@pytest.mark.parametrize("start", [0, 5, 40])
def test_an_edge_has_its_corners_and_even_pieces_wherever_its_loop_begins(start):
    """A rectangle of 4.5 by 2 elements with a vertex each quarter: five pieces of 0.9 and two of 1 to a side."""
    x, y = np.arange(0, 4.5, 0.25), np.arange(0, 2, 0.25)
    sides = [(x, 0 * x), (0 * y + 4.5, y), (4.5 - x, 0 * x + 2), (0 * y, 2 - y)]
    loop = np.roll(np.concatenate([np.stack(side, axis=1) for side in sides]), start, axis=0)
    points = pad_module._sampled(loop)
    expected = {(0.9 * i, 2.0 * j) for i in range(6) for j in range(2)} | {(0.0, 1.0), (4.5, 1.0)}
    assert {tuple(point) for point in np.round(points, 9).tolist()} == {
        tuple(np.round(point, 9).tolist()) for point in expected
    }


def test_a_face_of_a_box_in_any_pose():
    turn, shift = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix(), np.array([0.3, -1.2, 0.5])
    box = trimesh.creation.box((25 * MM, 20 * MM, 8 * MM))
    top = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] > 0.9])
    surface = pads.moved(pads.soup(np.array(top.triangles)), turn, shift)
    at = np.c_[GRID - [12.5 * MM, 10 * MM], np.full(len(GRID), 4 * MM)]
    pad = unroll(surface, at @ turn.T + shift, np.tile(turn[:, 2], (len(GRID), 1)), SIZE)
    np.testing.assert_allclose(distances(places(pad)), distances(GRID), atol=EXACT * MM)
    np.testing.assert_allclose(distances(pad.basis.doflocs.T[pad.edge]), distances(pad.edge_pos), atol=EXACT * MM)
    assert_frames(pad.edge_axes, pad.edge_normal)
    np.testing.assert_allclose(pad.edge_normal, np.tile(turn[:, 2], (len(pad.edge), 1)), atol=1e-9)
    np.testing.assert_allclose(area(pad), 500 * MM**2, rtol=EXACT)


@pytest.mark.parametrize(("surface", "expected"), [(pads.l_shape(), 300.0), (pads.ring(), 8 * np.sin(np.pi / 8) * 84.0)])
def test_corners_and_holes_are_respected(surface, expected):
    """Polygon with n sides: n/2 sin(2π/n) (R² − r²); n = 16."""
    pad = unroll(surface, *pads.upward(np.array([[-6.0, 1.0]]) * MM), SIZE)
    np.testing.assert_allclose(area(pad), expected * MM**2, rtol=EXACT)
    assert angles(pad).min() > 20
    ends = np.sort(pad.basis.mesh.t.T[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    sides, count = np.unique(ends, axis=0, return_counts=True)
    corners = np.unique(sides[count == 1])
    assert set(corners) <= set(pad.edge)
    assert len(pad.edge) == 2 * len(corners)
    x, y = pad.edge_pos[:, :2].T
    if expected > 299:
        on = (
            (np.abs(np.abs(x) - 10 * MM) < 1e-12) | (np.abs(np.abs(y) - 10 * MM) < 1e-12) | (np.minimum(abs(x), abs(y)) < 1e-12)
        )
    else:
        into = (np.arctan2(y, x) % (np.pi / 8)) - np.pi / 16
        apothem = np.hypot(x, y) * np.cos(into) / np.cos(np.pi / 16)
        on = (np.abs(apothem - 4 * MM) < 1e-12) | (np.abs(apothem - 10 * MM) < 1e-12)
        assert (apothem < 5 * MM).sum() >= 16
    assert on.all()


def test_parts_that_touch_in_a_point_are_separate():
    """Two squares that share only a corner: the one without taxels is dropped."""
    surface = Surface.joined(
        [pads.plate(10 * MM, 10 * MM), pads.moved(pads.plate(10 * MM, 10 * MM), np.eye(3), np.array([10, 10, 0]) * MM)]
    )
    pad = unroll(surface, *pads.upward(np.array([[3.0, 4.0]]) * MM), SIZE)
    np.testing.assert_allclose(area(pad), 100 * MM**2, rtol=EXACT)
    assert pad.edge_pos[:, :2].max() < 10.001 * MM


def test_an_edge_that_touches_itself():
    """Around a missing square with a corner on the outline, both loops pass through one point."""
    cells = [(i, j) for i in range(3) for j in range(3) if (i, j) not in ((1, 1), (2, 2))]
    parts = [pads.moved(pads.plate(5 * MM, 5 * MM), np.eye(3), np.array([5 * i, 5 * j, 0]) * MM) for i, j in cells]
    pad = unroll(Surface.joined(parts), *pads.upward(np.array([[2.0, 7.0]]) * MM), SIZE)
    np.testing.assert_allclose(area(pad), 175 * MM**2, rtol=EXACT)


def test_a_quadratic_field_is_interpolated_exactly():
    """At taxels inside and, by the same polynomial, just outside the meshed edge; a constant is exact too."""
    pad = unroll(PLATES["fine"], *pads.upward(np.concatenate([GRID, [[25.04 * MM, 7.7 * MM]]])), SIZE)
    x, y = pad.basis.doflocs / MM
    at_x, at_y = places(pad).T / MM
    np.testing.assert_allclose(pad.at_taxels @ np.ones(pad.basis.N), 1, rtol=1e-12)
    values = pad.at_taxels @ (x**2 - 3 * x * y + y + 2)
    np.testing.assert_allclose(values, at_x**2 - 3 * at_x * at_y + at_y + 2, rtol=1e-10)


@pytest.mark.parametrize("cells", [(64, 1), (64, 17), (300, 3)])
def test_a_half_cylinder_unrolls_to_its_arc(cells):
    radius, length = 8 * MM, 20 * MM
    angle, along = np.array([-1.4, -0.6, 0.05, 0.9, 1.5]), np.array([1, 19, 10, 4, 12]) * MM
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    pos = radius * normal + along[:, None] * pads.UP
    pad = unroll(pads.cylinder(radius, np.pi, length, cells), pos, normal, SIZE)
    facet = np.pi / cells[0]
    chord = 2 * radius * np.sin(facet / 2) / facet  # length of the polygon over its angle
    size = np.ptp(pad.basis.doflocs, axis=1)
    np.testing.assert_allclose(np.sort(size), [length, np.pi * chord], rtol=1e-6)
    np.testing.assert_allclose(area(pad), length * np.pi * chord, rtol=1e-6)
    flat = np.stack([radius * angle, along], axis=1)
    np.testing.assert_allclose(distances(places(pad)), distances(flat), atol=radius * facet**2)
    assert_frames(pad.edge_axes, pad.edge_normal)
    assert_frames(pad.taxel_axes, normal)
    arc = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    components = np.einsum("nux,nx->nu", pad.taxel_axes, arc)
    np.testing.assert_allclose(np.abs(components).max(axis=1), 1, atol=facet**2)
    np.testing.assert_allclose(components, np.tile(components[0], (len(components), 1)), atol=facet)
    np.testing.assert_allclose(np.hypot(*pad.edge_pos[:, :2].T), radius, atol=radius * facet**2)


def test_a_triangle_without_area_is_harmless():
    """On a half cylinder, next to an edge that a midpoint splits for only one of its two triangles."""
    corners = pads.cylinder(cells=(16, 3)).corners
    a, b, c = corners[40]
    middle = (a + b) / 2
    more = np.array([[a, middle, c], [middle, b, c], [a, b, middle]])
    surface = pads.soup(np.concatenate([np.delete(corners, 40, axis=0), more]))
    pad = unroll(surface, np.array([[8 * MM, 0, 5 * MM]]), np.array([[1.0, 0, 0]]), SIZE)
    np.testing.assert_allclose(area(pad), 20 * MM * 16 * 2 * 8 * MM * np.sin(np.pi / 32), rtol=1e-9)


def test_axes_are_the_derivative_of_the_surface():
    """Between neighbours on the edge, the step in space is the step in the plane along the axes, up to the facets' angle."""
    radius, facet = 8 * MM, 2.5 / 400
    surface = pads.cylinder(radius, 2.5, 20 * MM, (400, 4))
    pad = unroll(surface, np.array([[radius, 0, 5 * MM]]), np.array([[1.0, 0, 0]]), 0.5 * MM)
    gap = distances(pad.basis.doflocs.T[pad.edge])
    first, second = np.nonzero((gap > 0) & (gap < 0.6 * MM))
    step = pad.edge_pos[second] - pad.edge_pos[first]
    flat = pad.basis.doflocs.T[pad.edge[second]] - pad.basis.doflocs.T[pad.edge[first]]
    mean = 0.5 * (pad.edge_axes[first] + pad.edge_axes[second])
    assert len(step) > 300
    np.testing.assert_allclose(np.einsum("nu,nux->nx", flat, mean), step, atol=0.5 * facet * 0.6 * MM)


def test_a_cone_unrolls_to_a_sector():
    """A sector of angle φ sin α: distances along the surface follow from the law of cosines."""
    slope, turn = 0.3, 2.0
    surface = pads.sheet(
        lambda a, r: r[..., None] * np.stack([np.sin(slope) * np.cos(a), np.sin(slope) * np.sin(a), np.cos(slope) + 0 * a], -1),
        np.linspace(-turn / 2, turn / 2, 201),
        np.linspace(20, 40, 5) * MM,
    )
    r, a = np.array([22, 38, 30, 25]) * MM, np.array([-0.8, 0.1, 0.9, 0.45])
    pos = r[:, None] * np.stack([np.sin(slope) * np.cos(a), np.sin(slope) * np.sin(a), np.cos(slope) + 0 * a], axis=1)
    normal = np.stack([np.cos(slope) * np.cos(a), np.cos(slope) * np.sin(a), -np.sin(slope) + 0 * a], axis=1)
    pad = unroll(surface, pos, normal, SIZE)
    between = (a[:, None] - a[None]) * np.sin(slope)
    expected = np.sqrt(np.maximum(r[:, None] ** 2 + r[None] ** 2 - 2 * np.outer(r, r) * np.cos(between), 0))
    np.testing.assert_allclose(distances(places(pad)), expected, atol=1e-4 * 40 * MM)


def test_a_shallow_cap_is_a_pad():
    """At a half angle of 0.3 the circumference is 1.5 % short of a flat disc's; lengths along great circles agree within 2 %."""
    radius = 10 * MM
    polar, around = np.array([0.0, 0.1, 0.2, 0.28, 0.28]), np.array([0.0, 1.0, 2.5, 4.0, 5.5])
    normal = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=1)
    pad = unroll(pads.cap(radius, 0.3), radius * normal, normal, 0.4 * MM)
    great = radius * np.arccos(np.clip(normal @ normal.T, -1, 1))
    assert np.abs(distances(places(pad)) - great).max() < 0.02 * great.max()
    assert_frames(pad.taxel_axes, normal)
    assert_frames(pad.edge_axes, pad.edge_normal)


@pytest.mark.parametrize("offset", [-0.4, 0.4])
def test_taxels_off_a_coarse_cylinder_are_projected(offset):
    angle = np.linspace(-1.3, 1.3, 7)
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    pos = (8 + offset) * MM * normal + np.array([0, 0, 10 * MM])
    pad = unroll(pads.cylinder(cells=(24, 1)), pos, normal, SIZE)
    np.testing.assert_allclose(distances(places(pad)), 8 * MM * np.abs(angle[:, None] - angle), atol=0.02 * 8 * MM)


@pytest.mark.parametrize("facing", [(1, 0, 0), (0, 1, 0), (0, 0, -1)])
@pytest.mark.parametrize("part", ["finger_link2", "thumb_link2"])
def test_the_side_of_a_real_fingertip(part, facing):
    """Ragged outlines, slivers and a slight double curvature: area and distances to neighbours stay within 2 %."""
    body = trimesh.load_mesh(Path(__file__).parents[4] / "robots/xhand1/assets" / f"{part}.stl")
    candidates = np.flatnonzero(body.face_normals @ facing > np.cos(np.radians(20)))
    joined = body.face_adjacency[np.isin(body.face_adjacency, candidates).all(axis=1)]
    triangles = max(trimesh.graph.connected_components(joined, nodes=candidates), key=lambda part: body.area_faces[part].sum())
    at = triangles[np.argsort(-body.area_faces[triangles], kind="stable")[:12]]
    pad = unroll(pads.soup(np.array(body.triangles[triangles])), body.triangles_center[at], body.face_normals[at], 0.4 * MM)
    np.testing.assert_allclose(area(pad), body.area_faces[triangles].sum(), rtol=0.04)
    assert_frames(pad.taxel_axes, body.face_normals[at])
    assert_frames(pad.edge_axes, pad.edge_normal)
    assert distances(pad.edge_pos).max() < 1.02 * distances(pad.basis.doflocs.T[pad.edge]).max()


def overlapping_strip() -> Surface:
    """Return one and a half turns of a ring, as a helix of 0.1 mm: it unrolls onto itself."""
    return pads.sheet(
        lambda r, a: np.stack([r * np.cos(a), r * np.sin(a), 0.1 * MM * a / (2 * np.pi)], axis=-1),
        np.linspace(5, 10, 6) * MM,
        np.linspace(0, 3 * np.pi, 181),
    )


def folded_plate() -> Surface:
    """Return a flat plate with its last triangle folded back on it."""
    back = np.array([[[25, 20, 0], [25, 0, 0], [15, 12, 0]]]) * MM
    return Surface.joined([pads.plate(), pads.soup(back)])


def plate_with_fin() -> Surface:
    fin = np.array([[[25, 0, 0], [25, 20, 0], [25, 10, 9]], [[25, 0, 0], [25, 20, 0], [30, 10, 9]]]) * MM
    return Surface.joined([pads.plate(), pads.soup(fin)])


def inconsistent_winding() -> Surface:
    return pads.soup(np.array([[[0, 0, 0], [25, 0, 0], [25, 20, 0]], [[0, 0, 0], [0, 20, 0], [25, 20, 0]]]) * MM)


def ball() -> Surface:
    return pads.soup(np.array(trimesh.creation.icosphere(subdivisions=3, radius=10 * MM).triangles))


def separate_plates() -> Surface:
    return Surface.joined(
        [pads.plate(10 * MM, 20 * MM), pads.moved(pads.plate(10 * MM, 20 * MM), np.eye(3), np.array([15 * MM, 0, 0]))]
    )


REFUSED = {
    "a deep cap": (
        pads.cap(half_angle=1.0),
        [[0, 0, 10]],
        r"cannot be unrolled: an edge changes its length by \d+\.\d%, 2% are allowed",
    ),
    "a cap just too deep": (
        pads.cap(half_angle=0.5),
        [[0, 0, 10]],
        r"changes its length by [2-6]\.\d%.* flat or curved one way",
    ),
    "a tube": (
        pads.moved(pads.cylinder(turn=2 * np.pi), np.eye(3)[[1, 2, 0]], np.zeros(3)),
        [[0, 0, 8]],
        "cannot be unrolled.*does not close around",
    ),
    "a ball": (ball(), [[0, 0, 10]], "is closed: none of its 1280 triangles has an open edge.*select a part"),
    "an overlap": (overlapping_strip(), [[7, 0.5, 0]], r"overlaps itself when it is unrolled, near \("),
    "a fold": (folded_plate(), [[5, 5, 0]], "folds over: 1 of its 3 triangles are upside down"),
    "a fin": (plate_with_fin(), [[5, 5, 0]], r"not a sheet: 3 triangles meet in one edge near \(25, "),
    "wound against": (inconsistent_winding(), [[20, 2, 0]], r"not orientable: .* near \(.*counter-clockwise"),
    "two parts": (
        separate_plates(),
        [[5, 5, 0], [5, 6, 0], [20, 5, 0]],
        r"2 parts .* hold 2, 1 taxels: taxel 0 is on one, taxel 2 on another",
    ),
    "a taxel above": (pads.plate(), [[5, 5, 0], [5, 5, 1.5]], "taxel 1 is 1.5 mm off the pad's surface, 1 mm are allowed"),
    "a taxel beside": (pads.plate(), [[5, 5, 0], [25.4, 5, 0]], "taxel 1 is 0.4 mm beside the pad's edge, 0.1 mm are allowed"),
    "nothing": (pads.soup(np.zeros((0, 3, 3))), [[0, 0, 0]], "holds no triangle.*all taxels"),
}


@pytest.mark.parametrize(("surface", "at", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_pads_are_refused(surface, at, message):
    pos = np.array(at, dtype=float) * MM
    with pytest.raises(LowerError, match=message) as caught:
        unroll(surface, pos, np.tile(pads.UP, (len(pos), 1)), SIZE)
    assert caught.value.field == "boundary"
    assert caught.value.hint


def test_a_taxel_on_the_back_is_refused():
    with pytest.raises(LowerError, match="taxel 0 is not on the pad: no part of it faces as the taxel does"):
        unroll(pads.plate(), np.array([[5, 5, 0]]) * MM, -pads.UP[None], SIZE)


@pytest.mark.parametrize("size", [0.15, 0.05, 0.0005])
def test_too_fine_a_mesh_is_refused(size):
    with pytest.raises(LowerError, match=r"20000.*smaller region, a larger thickness or less drag"):
        unroll(pads.plate(100 * MM, 80 * MM), *pads.upward(GRID), size * MM)
