"""Mode shapes on a grid: closed forms at nodes and antinodes, symmetry, and the stated error."""

import numpy as np
import pytest
from oracles import modes as oracles
from oracles.setups.solids import ball, bending, box, roots, surface_of

from tgdsl.fields.materials import MATERIALS
from tgdsl.modal import analysis as spectra
from tgdsl.modal import cells
from tgdsl.modal.analysis import analysed
from tgdsl.modal.elasticity import ALONG, Elements, on_grid
from tgdsl.modal.modes import Modes, ShapeModes, interpolated, of_groups

LENGTH, HEIGHT, WIDTH = 0.4, 0.006, 0.01
SIDE, THICKNESS = 0.2, 0.004
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(spectra, "UNKNOWNS", 4000)


def modes(mesh) -> Modes:
    options = ShapeModes.model_construct(material=MATERIALS["steel"], count=6)
    return analysed("body", surface_of(mesh), options, 1e9)


def share(result: Modes, *pos: tuple[float, float, float], along: np.ndarray = UP) -> np.ndarray:
    return result.shapes.share(np.array(pos), np.broadcast_to(along, (len(pos), 3)))


@pytest.mark.parametrize("number", [0, 1])
def test_a_beam_responds_most_at_its_ends_and_not_at_nodes(number):
    """Along the upper side of a thin beam, shares have the ratios and zeros of the closed form."""
    shares = oracles.struck_along_a_beam(number)
    assert np.abs(shares.ours).argmax() in (0, len(shares.ours) - 1) and np.abs(shares.exact).min() < 1e-9


def test_the_first_node_of_a_beam_matches_the_textbook():
    """0.2242 L from either end."""
    (node,) = roots(lambda at: bending(at, 0), 0.0, 0.5)
    assert 0.5 - node == pytest.approx(0.2242, abs=1e-4)


def test_opposite_sides_respond_with_opposite_signs():
    """Both sides of a thin plate move together: their shares differ only in sign."""
    plate = modes(box((SIDE, SIDE, THICKNESS)))
    top = share(plate, (0.03, 0.05, THICKNESS / 2), along=-UP)
    bottom = share(plate, (0.03, 0.05, -THICKNESS / 2), along=UP)
    assert np.abs(top).max() > 0.5
    single = np.bincount(plate.shapes.owner) == 1
    assert top[:, single] == pytest.approx(-bottom[:, single], abs=2e-3)
    assert top[:, ~single] == pytest.approx(bottom[:, ~single], abs=2e-3)


def test_the_centre_of_a_square_plate_excites_only_even_modes():
    """Of the first four, xy, x² − y² and a pair have a node there; x² + y² does not."""
    plate = modes(box((SIDE, SIDE, THICKNESS)))
    assert abs(share(plate, (0.0, 0.0, THICKNESS / 2))[0, 2]) > 0.7


def test_symmetric_points_respond_equally():
    """The four quadrants of a square plate, mirrored at the diagonal, for pairs of modes too."""
    plate = modes(box((SIDE, SIDE, THICKNESS)))
    x, y, z = 0.031, 0.072, THICKNESS / 2
    shares = np.abs(share(plate, *[(a, b, z) for p, q in ((x, y), (y, x)) for a in (p, -p) for b in (q, -q)]))
    assert shares == pytest.approx(np.broadcast_to(shares[0], shares.shape), abs=0.01)
    assert (shares[0] > 0.05).any()


@pytest.mark.parametrize(
    "mesh", [box((LENGTH, WIDTH, HEIGHT)), box((SIDE, SIDE, THICKNESS)), ball(0.05)], ids=["beam", "plate", "ball"]
)
def test_the_stated_error_of_interpolation_holds(mesh, monkeypatch, tmp_path):
    """Against the elements' displacement along the normal, at points of the surface."""
    arguments = []
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    monkeypatch.setattr(spectra, "on_grid", lambda *values: arguments.append(values) or on_grid(*values))
    result = modes(mesh)
    ((elements, crossings, _, fields),) = arguments
    normal = np.einsum("xif,xi->xf", elements.displacement(crossings.cell, crossings.pos, fields), crossings.normal)
    exact = of_groups(normal, result.shapes.owner, len(result.frequency))
    size, middle = np.ptp(mesh.vertices, axis=0).max(), mesh.bounds.mean(axis=0)
    shares = result.shapes.share(crossings.pos @ result.shapes.axes * size + middle, crossings.normal @ result.shapes.axes)
    error = np.sqrt(((np.abs(shares) - np.abs(exact)) ** 2).mean(axis=0))
    assert result.shapes.error.max() < 0.03
    assert error.max() < max(3 * result.shapes.error.max(), 0.01)


def test_a_grid_has_the_fields_of_the_elements_at_their_nodes():
    """Of any field, in every cell: each node of the elements is one of the grid's."""
    vertices, faces = cells.closed(surface_of(box((1.0, 1.0, 1.0))))
    lines = (np.linspace(-0.5, 0.5, 5),) * 3
    filled, crossings = cells.filled(vertices, faces, lines, 3, 1e-6)
    elements = Elements.of(filled)
    fields = np.random.default_rng(0).standard_normal((3 * len(elements.pos), 2))
    grid = on_grid(elements, crossings, lines, fields)
    place = (elements.pos - grid.low) / grid.step
    assert place == pytest.approx(np.rint(place), abs=1e-9)
    node = np.ravel_multi_index(tuple(np.rint(place).astype(int).T), tuple(grid.num))
    assert grid.value[node] == pytest.approx(fields.reshape(-1, 3, 2), abs=1e-6), "rounded to float32"


def test_shares_average_to_one_over_the_surface():
    """Impulses all over the surface have, on average, the energy of the mean gain."""
    plate, mesh = modes(box((SIDE, SIDE, THICKNESS))), box((SIDE, SIDE, THICKNESS))
    rng = np.random.default_rng(0)
    corners = rng.dirichlet(np.ones(3), 4000)
    which = rng.choice(len(mesh.faces), 4000, p=mesh.area_faces / mesh.area)
    pos = np.einsum("xk,xkj->xj", corners, mesh.triangles[which])
    shares = plate.shapes.share(pos, mesh.face_normals[which])
    assert np.sqrt((shares**2).mean(axis=0)) == pytest.approx(np.ones(shares.shape[1]), abs=0.05)


def test_moving_and_scaling_a_body_keeps_its_shares():
    """Positions are in the body's frame, in metres: corresponding points respond equally."""
    first = modes(box((LENGTH, WIDTH, HEIGHT)))
    moved = modes(box((2 * LENGTH, 2 * WIDTH, 2 * HEIGHT), at=(0.1, -0.2, 0.5)))
    at = np.array([0.07, 0.002, 0.003])
    other = 2 * at + np.array([0.1, -0.2, 0.5])
    assert share(moved, tuple(other)) == pytest.approx(share(first, tuple(at)), abs=1e-5)


def test_linear_fields_are_interpolated_exactly_and_clamped_to_the_box():
    rng = np.random.default_rng(1)
    low, step, num = np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.25, 2.0]), np.array([3, 5, 2])
    node = low + step * np.stack(np.meshgrid(*(np.arange(n) for n in num), indexing="ij"), axis=-1).reshape(-1, 3)
    slope = rng.standard_normal((3, 3, 2))
    high, pos = low + step * (num - 1), rng.uniform(-2.0, 4.0, (200, 3))
    values = interpolated(low, step, num, np.einsum("nj,jif->nif", node, slope), pos)
    assert values == pytest.approx(np.einsum("nj,jif->nif", np.clip(pos, low, high), slope), abs=1e-12)
    assert ((pos < low) | (pos > high)).any(axis=1).mean() > 0.3
    assert list(ALONG) == sorted(ALONG)
