"""The clamped boundary against closed forms: slabs, discs (Bessel), exact plane waves, and its own refinement.

Errors are relative to the largest displacement prescribed on the edge. At the rule's element size the finite elements err by
less than `RULE`; the polygon of a curved outline adds to that.
"""

import numpy as np
import pads
import pytest
from pads import MM
from scipy.special import iv

from tgdsl.errors import LowerError
from tgdsl.sensors.elastomer.clamped.pad import Pad, correction, element_size, unroll
from tgdsl.surfaces.surface import Surface

THICKNESS, DRAG = 2 * MM, 3.0
RATE = np.sqrt(DRAG) / THICKNESS
"""√β/t of the boundary layer [1/m]."""
RULE = 1e-3
SIZE = element_size(THICKNESS, DRAG, 20 * MM)
RANDOM = np.random.default_rng(3)


def plate_pad(surface: Surface, places: np.ndarray, size: float = SIZE) -> Pad:
    """Return a pad in the plane z = 0, with plane axes x and y."""
    pad = unroll(surface, *pads.upward(places), size)
    np.testing.assert_allclose(pad.edge_axes, np.tile(np.eye(3)[:2], (len(pad.edge), 1, 1)), atol=1e-9)
    return pad


def displacements(pad: Pad, field, bulk: float, drag: float = DRAG) -> np.ndarray:
    """Return the displacement (taxel, 2) of a flat pad whose edge `field` of (x, y) displaces."""
    return (correction(pad, THICKNESS, drag, bulk) @ field(pad.edge_pos[:, :2]).T.ravel()).reshape(2, -1).T


def waves(bulk: float, turn: float = 0.4):
    """Return a sum of three exact solutions: d exp(κ d·x) along itself, κ² = β/(t² (1 + K)), and across itself, κ² = β/t²."""
    along, across = RATE / np.sqrt(1 + bulk), RATE
    parts = [(along, turn, 0.0, 1.0), (across, turn + 2.1, np.pi / 2, 0.7), (along, turn + 4.0, 0.0, -0.5)]

    def field(at: np.ndarray) -> np.ndarray:
        total = np.zeros_like(at)
        for rate, angle, tilt, size in parts:
            d = np.array([np.cos(angle), np.sin(angle)])
            u = np.array([np.cos(angle + tilt), np.sin(angle + tilt)])
            total += size * np.exp(rate * (at @ d - 10 * MM))[:, None] * u
        return total

    return field


def test_the_waves_solve_the_equation():
    """By central differences, to verify the oracle of this file."""
    h, at = 0.02 * MM, RANDOM.uniform(-8, 8, (12, 2)) * MM
    for bulk in (0.0, 2.0):
        u = waves(bulk)
        step = h * np.eye(2)
        laplacian = sum(u(at + s) - 2 * u(at) + u(at - s) for s in step) / h**2
        mixed = (u(at + step.sum(0)) - u(at + step[0] - step[1]) - u(at - step[0] + step[1]) + u(at - step.sum(0))) / (4 * h**2)
        xx, yy = ((u(at + s) - 2 * u(at) + u(at - s)) / h**2 for s in step)
        slope = np.stack([xx[:, 0] + mixed[:, 1], mixed[:, 0] + yy[:, 1]], axis=1)
        residual = -laplacian + RATE**2 * u(at) - bulk * slope
        assert np.abs(residual).max() < 1e-3 * np.abs(RATE**2 * u(at)).max()


@pytest.mark.parametrize(("shape", "bulk"), [("l_shape", 5.0), ("ring", 0.5), ("plate", 0.0)])
def test_displacements_match_exact_solutions(shape, bulk):
    surface = {
        "l_shape": pads.l_shape(),
        "ring": pads.ring(),
        "plate": pads.moved(pads.plate(), np.eye(3), -10 * MM * np.array([1, 1, 0])),
    }
    places = RANDOM.uniform(-9, 9, (100, 2)) * MM
    x, y = places.T
    inside = {"l_shape": (x < 0) | (y < 0), "ring": (np.hypot(x, y) > 4 * MM) & (np.hypot(x, y) < 9.7 * MM), "plate": x == x}
    places = places[inside[shape]]
    pad = plate_pad(surface[shape], places)
    field = waves(bulk)
    error = np.abs(displacements(pad, field, bulk) - field(places)).max()
    assert error < RULE * np.abs(field(pad.edge_pos[:, :2])).max()


def test_order_of_convergence(monkeypatch):
    """Quadratic elements of one size on a polygon converge with third order."""
    monkeypatch.setattr("tgdsl.sensors.elastomer.clamped.pad.GRADE", 1e-3)
    places = RANDOM.uniform(-9, 9, (100, 2)) * MM
    reach = np.hypot(*places.T)
    places = places[(reach > 4 * MM) & (reach < 9.7 * MM)]
    field = waves(2.0)
    sizes = np.array([1.2, 0.6, 0.3]) * MM
    errors = []
    for size in sizes:
        error = displacements(plate_pad(pads.ring(), places, float(size)), field, 2.0) - field(places)
        errors.append(np.sqrt((error**2).mean()))
    assert np.polyfit(np.log(sizes), np.log(errors), 1)[0] > 2.7


@pytest.mark.parametrize("axis", [0, 1])
def test_a_long_strip(axis):
    """One long side moves, the other is held: sinh κ(W − y) / sinh κW; κ is smaller by √(1 + K) for motion across it."""
    width, bulk = 8 * MM, 3.0
    y = np.linspace(0.3, 7.5, 25) * MM
    pad = plate_pad(pads.plate(60 * MM, width), np.stack([np.full(25, 30 * MM), y], axis=1), 0.29 * MM)

    def side(at: np.ndarray) -> np.ndarray:
        moved = np.zeros_like(at)
        moved[at[:, 1] < 1e-9, axis] = 1.0
        return moved

    rate = RATE / np.sqrt(1 + bulk) if axis == 1 else RATE
    expected = np.zeros((25, 2))
    expected[:, axis] = np.sinh(rate * (width - y)) / np.sinh(rate * width)
    np.testing.assert_allclose(displacements(pad, side, bulk), expected, atol=RULE)
    if axis == 0:  # as on a half-plane, far from the other side
        np.testing.assert_allclose(expected[:10, 0], np.exp(-rate * y[:10]), atol=3e-3)


@pytest.mark.parametrize(("data", "bulk"), [("radial", 4.0), ("around", 4.0), ("constant", 0.0)])
def test_a_disc(data, bulk):
    """I1(κr)/I1(κR) for radial data (κ with K) and data around (without); I0(κr)/I0(κR) for a shift of the edge (K = 0)."""
    radius = 10 * MM
    polar, reach = RANDOM.uniform(0, 2 * np.pi, 80), RANDOM.uniform(0.5, 9.6, 80) * MM
    places = reach[:, None] * np.stack([np.cos(polar), np.sin(polar)], axis=1)
    pad = plate_pad(pads.disc(radius), places)
    directions = {
        "radial": lambda at: at / np.hypot(*at.T)[:, None],
        "around": lambda at: at[:, ::-1] * [-1, 1] / np.hypot(*at.T)[:, None],
        "constant": lambda at: np.tile([0.6, -0.8], (len(at), 1)),
    }
    rate = RATE / np.sqrt(1 + bulk) if data == "radial" else RATE
    order = 0 if data == "constant" else 1
    expected = (iv(order, rate * reach) / iv(order, rate * radius))[:, None] * directions[data](places)
    np.testing.assert_allclose(displacements(pad, directions[data], bulk), expected, atol=RULE)


def test_without_drag_a_linear_displacement_is_exact():
    """The patch test: shift, rotation and stretch of the edge reach every taxel unchanged, up to rounding."""
    places = RANDOM.uniform(-9, -1, (30, 2)) * MM
    pad = plate_pad(pads.l_shape(), places)
    matrix, shift = RANDOM.normal(size=(2, 2)) / (10 * MM), RANDOM.normal(size=2)
    np.testing.assert_allclose(
        displacements(pad, lambda at: at @ matrix.T + shift, 7.0, 0.0), places @ matrix.T + shift, atol=1e-9
    )


def test_one_triangle_without_inner_nodes():
    """All six nodes are on the edge: a quadratic displacement is interpolated exactly."""
    surface = pads.soup(np.array([[[0, 0, 0], [6, 0, 0], [1, 5, 0]]]) * MM)
    places = np.array([[2.0, 1.0], [1.5, 2.5]]) * MM
    pad = plate_pad(surface, places, 50 * MM)
    assert pad.basis.N == len(pad.edge) == 6
    np.testing.assert_allclose(displacements(pad, lambda at: (at / MM) ** 2, 1.0), (places / MM) ** 2, rtol=1e-9)


def test_only_drag_over_thickness_squared_matters():
    pad = plate_pad(pads.plate(), np.array([[3.0, 4.0], [11.0, 2.0]]) * MM, 1 * MM)
    np.testing.assert_allclose(correction(pad, 2 * MM, 3.0, 1.0), correction(pad, 4 * MM, 12.0, 1.0), atol=1e-12)


def test_a_taxel_at_the_edge_moves_with_it():
    places = np.array([[0.0, 7.3], [25.0, 20.0], [12.1, 0.0]]) * MM
    pad = plate_pad(pads.plate(), places)
    np.testing.assert_allclose(displacements(pad, lambda at: at / MM, 1.0), places / MM, atol=1e-8)


def test_the_triangulation_does_not_matter():
    """Many equal triangles, or slivers."""
    places = RANDOM.uniform([1, 1], [24, 19], (40, 2)) * MM
    expected = displacements(plate_pad(pads.plate(), places), waves(2.0), 2.0)
    for surface in (pads.plate(cells=(40, 32)), pads.slivers()):
        np.testing.assert_allclose(
            displacements(plate_pad(surface, places), waves(2.0), 2.0), expected, atol=RULE * np.abs(expected).max()
        )


def test_a_half_cylinder_equals_the_rectangle_of_its_arc():
    """A field of arc and height on its edge reaches the taxels as on the flat rectangle; facets shift the edge by their angle."""
    radius, length = 8 * MM, 20 * MM
    arc, along = RANDOM.uniform(-11.5, 11.5, 50) * MM, RANDOM.uniform(1, 19, 50) * MM
    field = lambda at: waves(2.0, 1.1)(at - [0, 10 * MM])  # noqa: E731
    flat_surface = pads.moved(pads.plate(np.pi * radius, length), np.eye(3), np.array([-np.pi / 2 * radius, 0, 0]))
    flat = plate_pad(flat_surface, np.stack([arc, along], axis=1))
    expected = displacements(flat, field, 2.0)
    normal = np.stack([np.cos(arc / radius), np.sin(arc / radius), 0 * arc], axis=1)
    pad = unroll(pads.cylinder(radius, np.pi, length, (64, 1)), radius * normal + along[:, None] * pads.UP, normal, SIZE)
    angle = np.arctan2(pad.edge_pos[:, 1], pad.edge_pos[:, 0])
    on_edge = field(np.stack([radius * angle, pad.edge_pos[:, 2]], axis=1))
    tangents = np.stack(
        [np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1), np.tile(pads.UP, (len(angle), 1))], axis=1
    )
    prescribed = np.einsum("eux,evx,ev->ue", pad.edge_axes, tangents, on_edge)
    moved = (correction(pad, THICKNESS, DRAG, 2.0) @ prescribed.ravel()).reshape(2, -1)
    in_space = np.einsum("tux,ut->tx", pad.taxel_axes, moved)
    around = np.stack([-normal[:, 1], normal[:, 0], 0 * arc], axis=1)
    result = np.stack([(in_space * around).sum(axis=1), in_space[:, 2]], axis=1)
    np.testing.assert_allclose(result, expected, atol=RULE * np.abs(field(flat.edge_pos[:, :2])).max())


def test_the_rule_of_the_element_size():
    """A quarter of the layer on pads larger than it; a 24th of the pad on smaller ones and without drag."""
    np.testing.assert_allclose(element_size(2 * MM, 3.0, 25 * MM), 2 * MM / np.sqrt(3) / 4)
    np.testing.assert_allclose(element_size(20 * MM, 3.0, 24 * MM), 1 * MM)
    np.testing.assert_allclose(element_size(2 * MM, 0.0, 24 * MM), 1 * MM)
    with pytest.raises(
        LowerError, match=r"layer of 0\.0577 mm \(thickness 0\.1 mm over √3\) along a pad of 80 mm .* 20000 are"
    ) as caught:
        element_size(0.1 * MM, 3.0, 80 * MM)
    assert caught.value.field == "boundary"


def test_the_rule_estimates_the_corners():
    """For a square it counts at least the corners of the mesh, and not many more."""
    side = 40 * MM
    size = element_size(1.5 * MM, DRAG, side)
    pad = plate_pad(pads.plate(side, side), np.array([[1.0, 1.0]]) * MM, size)
    corners = pad.basis.mesh.nvertices
    assert corners < 9 * 4 * side / size < 2 * corners
