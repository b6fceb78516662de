"""Mode shapes on a grid: closed forms at nodes and antinodes, symmetry, and the error that is stated."""

import numpy as np
import pytest
from oracles import modes as oracles
from oracles.setups.solids import ball, bending, box, roots, surface_of

from tgdsl.fields.materials import MATERIALS
from tgdsl.modal import analysis as spectra
from tgdsl.modal.analysis import analysed
from tgdsl.modal.elasticity import ALONG, on_grid
from tgdsl.modal.modes import Modes, ShapeModes, interpolated, of_groups

LENGTH, HEIGHT, WIDTH = 0.4, 0.006, 0.01
SIDE, THICKNESS = 0.2, 0.004
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(spectra, "UNKNOWNS", 4000)


def modes(mesh) -> Modes:
    given = ShapeModes.model_construct(material=MATERIALS["steel"], count=6)
    return analysed("body", surface_of(mesh), given, 1e9)


def share(found: Modes, *pos: tuple[float, float, float], along: np.ndarray = UP) -> np.ndarray:
    return found.shapes.share(np.array(pos), np.broadcast_to(along, (len(pos), 3)))


@pytest.mark.parametrize("number", [0, 1])
def test_a_beam_is_not_struck_at_a_node_and_most_at_its_ends(number):
    """Along the beam's upper side, the way that it is thin: shares are in the ratios of the closed form, zero where that is."""
    found = oracles.struck_along_a_beam(number)
    assert np.abs(found.ours).argmax() in (0, len(found.ours) - 1) and np.abs(found.exact).min() < 1e-9


def test_the_first_node_of_a_beam_is_where_the_textbook_has_it():
    """0.2242 L from either end."""
    (node,) = roots(lambda at: bending(at, 0), 0.0, 0.5)
    assert 0.5 - node == pytest.approx(0.2242, abs=1e-4)


def test_the_other_side_is_struck_from_the_other_side():
    """Through a thin plate, displacement is that of both of its sides: shares differ by their sign alone."""
    found = modes(box((SIDE, SIDE, THICKNESS)))
    top = share(found, (0.03, 0.05, THICKNESS / 2), along=-UP)
    bottom = share(found, (0.03, 0.05, -THICKNESS / 2), along=UP)
    assert np.abs(top).max() > 0.5
    single = np.bincount(found.shapes.owner) == 1
    assert top[:, single] == pytest.approx(-bottom[:, single], abs=2e-3)
    assert top[:, ~single] == pytest.approx(bottom[:, ~single], abs=2e-3)


def test_the_centre_of_a_square_plate_excites_even_modes_alone():
    """Of the first four: xy, x² − y² and a pair have a node there; x² + y² has not."""
    found = modes(box((SIDE, SIDE, THICKNESS)))
    assert abs(share(found, (0.0, 0.0, THICKNESS / 2))[0, 2]) > 0.7


def test_points_that_symmetry_makes_equal_are_struck_alike():
    """The four quadrants of a square plate, and the diagonal's mirror, for pairs of modes too."""
    found = modes(box((SIDE, SIDE, THICKNESS)))
    x, y, z = 0.031, 0.072, THICKNESS / 2
    got = np.abs(share(found, *[(a, b, z) for p, q in ((x, y), (y, x)) for a in (p, -p) for b in (q, -q)]))
    assert got == pytest.approx(np.broadcast_to(got[0], got.shape), abs=0.01)
    assert (got[0] > 0.05).any()


@pytest.mark.parametrize(
    "mesh", [box((LENGTH, WIDTH, HEIGHT)), box((SIDE, SIDE, THICKNESS)), ball(0.05)], ids=["beam", "plate", "ball"]
)
def test_interpolation_is_as_exact_as_is_said(mesh, monkeypatch, tmp_path):
    """Against the elements' own displacement along the surface's normal, at points of the surface."""
    arguments = []
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    monkeypatch.setattr(spectra, "on_grid", lambda *given: arguments.append(given) or on_grid(*given))
    found = modes(mesh)
    ((elements, crossings, _, fields),) = arguments
    normal = np.einsum("xif,xi->xf", elements.displacement(crossings.cell, crossings.pos, fields), crossings.normal)
    exact = of_groups(normal, found.shapes.owner, len(found.frequency))
    size, middle = np.ptp(mesh.vertices, axis=0).max(), mesh.bounds.mean(axis=0)
    got = found.shapes.share(crossings.pos @ found.shapes.axes * size + middle, crossings.normal @ found.shapes.axes)
    off = np.sqrt(((np.abs(got) - np.abs(exact)) ** 2).mean(axis=0))
    assert found.shapes.error.max() < 0.03
    assert off.max() < max(3 * found.shapes.error.max(), 0.01)


def test_shares_are_one_in_the_mean_over_the_surface():
    """The energy of an impulse somewhere on the surface is that of the mean gain."""
    found, mesh = modes(box((SIDE, SIDE, THICKNESS))), box((SIDE, SIDE, THICKNESS))
    rng = np.random.default_rng(0)
    corners = rng.dirichlet(np.ones(3), 4000)
    which = rng.choice(len(mesh.faces), 4000, p=mesh.area_faces / mesh.area)
    pos = np.einsum("xk,xkj->xj", corners, mesh.triangles[which])
    got = found.shapes.share(pos, mesh.face_normals[which])
    assert np.sqrt((got**2).mean(axis=0)) == pytest.approx(np.ones(got.shape[1]), abs=0.05)


def test_a_body_that_is_moved_and_scaled():
    """Places are in the body's frame, in metres: points that correspond are struck alike."""
    first = modes(box((LENGTH, WIDTH, HEIGHT)))
    moved = modes(box((2 * LENGTH, 2 * WIDTH, 2 * HEIGHT), at=(0.1, -0.2, 0.5)))
    at = np.array([0.07, 0.002, 0.003])
    other = 2 * at + np.array([0.1, -0.2, 0.5])
    assert share(moved, tuple(other)) == pytest.approx(share(first, tuple(at)), abs=1e-5)


def test_linear_fields_are_interpolated_exactly_and_not_beyond_the_box():
    rng = np.random.default_rng(1)
    low, step, num = np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.25, 2.0]), np.array([3, 5, 2])
    node = low + step * np.stack(np.meshgrid(*(np.arange(n) for n in num), indexing="ij"), axis=-1).reshape(-1, 3)
    slope = rng.standard_normal((3, 3, 2))
    high, pos = low + step * (num - 1), rng.uniform(-2.0, 4.0, (200, 3))
    found = interpolated(low, step, num, np.einsum("nj,jif->nif", node, slope), pos)
    assert found == pytest.approx(np.einsum("nj,jif->nif", np.clip(pos, low, high), slope), abs=1e-12)
    assert ((pos < low) | (pos > high)).any(axis=1).mean() > 0.3
    assert list(ALONG) == sorted(ALONG)
