"""Rows of taxels do not depend on rounding: samples of a surface and of copies from other files agree."""

from pathlib import Path

import numpy as np
import pytest
from oracles.setups.solids import ball, box, surface_of
from surfaces import HERE, placement, shaken

from tgdsl.formats.robot import export_model, load_model
from tgdsl.placement.sample.sample import Samples, sample
from tgdsl.schema.placement import Placement
from tgdsl.surfaces.surface import Surface

ROBOTS = Path(__file__).parents[3] / "robots"
PALMS = {"xhand1": "right_hand_link", "sharpa": "right_hand_C_MC"}
SAME = 2e-6
"""Metres: noise of 1e-7 over the least cosine of lattice and face, times the largest of about a hundred draws."""
SURFACES = {
    "ball": (surface_of(ball(0.01, subdivisions=3)), {"count": 120}),
    "box": (surface_of(box((0.02, 0.03, 0.05))), {"count": 200}),
    "spacing": (surface_of(box((0.02, 0.03, 0.05))), {"spacing": 0.003}),
    "cut_finely": (surface_of(box((0.02, 0.03, 0.05), cuts=3)), {"count": 200}),
    "overlapping": (surface_of(box((0.02, 0.02, 0.02)), box((0.02, 0.02, 0.02), (0.01, 0.01, 0.01))), {"count": 100}),
    "back_to_back": (surface_of(box((0.02, 0.02, 0.02)), box((0.02, 0.02, 0.02), (0.02, 0, 0))), {"count": 100}),
    "flush": (surface_of(box((0.02, 0.02, 0.02)), box((0.02, 0.02, 0.02), (0.01, 0, 0))), {"count": 100}),
    "inner_shell": (surface_of(ball(0.005, subdivisions=3), ball(0.01, subdivisions=3)), {"count": 100}),
    "at_the_angle": (surface_of(box((0.02, 0.03, 0.05))), {"count": 100, "region": {"facing": [1, 1, 0], "within": "45 deg"}}),
    "at_the_border": (
        surface_of(box((0.02, 0.03, 0.05))),
        {"count": 100, "region": {"box": {"min": [-1, -1, 0.01], "max": [0.01, 1, 1]}}},
    ),
    "in_a_sphere": (
        surface_of(ball(0.01, subdivisions=3)),
        {"count": 30, "region": {"sphere": {"center": [0.008, 0.002, 0.004], "radius": 0.006}}},
    ),
}


def equal_rows(one: Samples, other: Samples) -> float:
    """Return the share of rows with the same position."""
    num = min(len(one.pos), len(other.pos))
    is_equal = np.abs(one.pos[:num] - other.pos[:num]).max(axis=1) < SAME
    return is_equal.sum() / max(len(one.pos), len(other.pos))


def palm(hand: str, ending: str = ".xml", folder: Path | None = None) -> Surface:
    model = load_model((folder or ROBOTS / hand) / f"{hand}_right{ending}")
    return model.surface(model.touchable(PALMS[hand]))


@pytest.mark.parametrize("name", SURFACES)
def test_rows_stay_when_vertices_are_rounded(name):
    surface, keys = SURFACES[name]
    shares = shares_of(surface, placement("poisson", **keys), {1e-8: 1, 1e-7: 2})
    assert min(shares[1e-8]) == 1.0
    assert np.mean(shares[1e-7]) >= 0.99


@pytest.mark.parametrize(
    ("hand", "keys"),
    [
        pytest.param("xhand1", {"count": 297}, id="xhand1-count"),
        pytest.param("sharpa", {"spacing": 0.006}, id="sharpa-spacing", marks=pytest.mark.slow),
    ],
)
def test_rows_stay_on_real_palms(hand, keys):
    surface, shares = palm(hand), {1e-8: [], 1e-7: []}
    for seed in range(2):
        for noise, more_shares in shares_of(surface, placement("poisson", **keys, seed=seed), {1e-8: 1, 1e-7: 1}).items():
            shares[noise] += more_shares
    assert min(shares[1e-8]) == 1.0
    # Ten times the rounding of float32 files; a replaced taxel shifts the rows between its old and new index.
    assert np.mean(shares[1e-7]) >= 0.95


def shares_of(surface: Surface, where: Placement, draws: dict[float, int]) -> dict[float, list[float]]:
    """Return the shares of equal rows of a surface and of copies with noise, `{noise [m]: number of copies}`."""
    first = sample(surface, where, HERE)
    return {
        noise: [equal_rows(first, sample(shaken(surface, noise, seed), where, HERE)) for seed in range(num)]
        for noise, num in draws.items()
    }


@pytest.mark.filterwarnings("ignore:.*USD holds no", "ignore:.*collides the convex hull")
@pytest.mark.parametrize("hand", ["xhand1", pytest.param("sharpa", marks=pytest.mark.slow)])
def test_rows_stay_when_a_robot_is_exported_to_usd(hand, tmp_path):
    export_model(ROBOTS / hand / f"{hand}_right.xml", tmp_path / f"{hand}_right.usda")
    palms = palm(hand), palm(hand, ".usda", tmp_path)
    for keys in ({"count": 297, "seed": 3}, {"spacing": 0.006}):
        where = placement("poisson", **keys)
        first, second = (sample(surface, where, HERE) for surface in palms)
        assert len(first.pos) == len(second.pos)
        np.testing.assert_allclose(second.pos, first.pos, rtol=0, atol=1e-6)
        np.testing.assert_allclose(second.normal, first.normal, rtol=0, atol=1e-4)
        np.testing.assert_allclose(second.area, first.area, rtol=0.02)  # one more or less of the pool's points in a cell


def test_rows_follow_one_direction():
    samples = sample(surface_of(ball(0.01, subdivisions=3)), placement("poisson", count=50), HERE)
    assert (np.diff(samples.pos @ np.sqrt([0.2, 0.3, 0.5])) > 0).all()


def soup(surface: Surface, noise: float, seed: int) -> Surface:
    """Return the surface without shared vertices, with independent noise at each corner."""
    corners = surface.corners + np.random.default_rng(seed).uniform(-noise, noise, surface.corners.shape)
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return Surface(corners.reshape(-1, 3), faces, surface.face_geom, surface.geoms)


@pytest.mark.parametrize("at", [0.0, 0.3])
def test_rows_stay_when_faces_share_no_vertices(at):
    """A ball within a ball, far from the origin: if corners were not merged, both would get taxels."""
    center = (at, 0.5 * at, at)
    whole = surface_of(ball(0.005, center, subdivisions=3), ball(0.01, center, subdivisions=3))
    where = placement("poisson", count=60)
    first = sample(whole, where, HERE)
    np.testing.assert_allclose(np.linalg.norm(first.pos - center, axis=1), 0.01, rtol=0.02)
    noise = 1e-7 * float(np.abs(whole.vertices).max())
    assert [equal_rows(first, sample(soup(whole, noise, seed), where, HERE)) for seed in range(3)] == [1.0] * 3


@pytest.mark.parametrize("name", ["ball", "spacing", "overlapping", "at_the_angle", "at_the_border"])
def test_layouts_stay_whole_under_noise_of_float32(name):
    """8 copies of each surface, with noise of 1e-7 of the largest coordinate, keep all rows."""
    surface, keys = SURFACES[name]
    shares = shares_of(surface, placement("poisson", **keys), {1e-7 * float(np.abs(surface.vertices).max()): 8})
    assert [share for values in shares.values() for share in values] == [1.0] * 8
