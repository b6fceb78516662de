"""Crosstalk: any layout, and the sum is kept."""

import numpy as np
import pytest
import torch
from noise_cases import MM, Noise, line, make_layout
from noise_stages import CHANNELS

from tgdsl.sensors.noise.lower import crosstalk_kernel


def grid(rows: int, columns: int, spacing: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return spacing * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def sphere_cap() -> tuple[np.ndarray, np.ndarray]:
    polar, around = np.meshgrid([0.2, 0.5, 0.8, 1.1], 2 * np.pi * np.arange(9) / 9)
    normal = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1).reshape(-1, 3)
    return 8 * MM * normal, normal


CAP = sphere_cap()
LAYOUTS = {
    "grid": make_layout(grid(8, 6, 1.5 * MM)),
    "sphere cap": make_layout(*CAP),
    "irregular": make_layout(np.random.default_rng(5).uniform(0, 6 * MM, (40, 3)) * [1, 1, 0.2]),
    "inactive taxels": make_layout(grid(6, 6, MM), radius=np.where(np.arange(36) % 5 == 0, 0.0, 4 * MM)),
    "two links": make_layout(grid(5, 4, MM), link_id=[0] * 12 + [1] * 8),
    "opposite flanks": make_layout(grid(2, 10, MM), normal=[[0, 0, 1]] * 10 + [[0, 0, -1]] * 10),
}
BLUR = {"crosstalk": {"strength": 0.4, "sigma": "1.5 mm"}}


@pytest.mark.parametrize("knobs", [BLUR, {"crosstalk": {"strength": [0.2, 0.9], "sigma": ["1 mm", "3 mm"]}}])
@pytest.mark.parametrize("name", LAYOUTS)
def test_crosstalk_keeps_the_sum_of_each_unit_source(name, knobs):
    """So it does at centre, edge and corner."""
    layout = LAYOUTS[name]
    source = np.eye(layout.num_taxels)[:, :, None]
    spread = Noise(knobs, layout, num_envs=layout.num_taxels, dtype=torch.float32).read(source)[..., 0].numpy()
    np.testing.assert_allclose(spread.sum(axis=1), 1, rtol=0, atol=1e-6)
    assert (spread >= 0).all()
    is_inactive, alone = layout.radius == 0, np.eye(layout.num_taxels)
    np.testing.assert_allclose(spread[is_inactive], alone[is_inactive], atol=1e-7)
    np.testing.assert_allclose(spread[:, is_inactive], alone[:, is_inactive], atol=1e-7)
    assert (spread.diagonal()[~is_inactive] < 0.99).all()
    apart = layout.link_id[:, None] != layout.link_id
    assert (spread[apart] == 0).all()
    assert (spread[layout.normal @ layout.normal.T <= 0] == 0).all()


def test_the_papers_blur_loses_force_at_edges_and_ours_none():
    """A kernel that is padded with zeros keeps about half at an edge and a quarter at a corner, a blur of χ = 1 throughout."""
    layout = make_layout(grid(15, 15, MM))
    kernel = crosstalk_kernel(layout, np.full(225, 2 * MM))
    middle = 7 * 15 + 7
    padded = np.exp(-np.sum((layout.pos - layout.pos[:, None]) ** 2, axis=-1) / (2 * (2 * MM) ** 2))
    padded /= padded[middle].sum()
    assert padded[7].sum() < 0.62 and padded[0].sum() < 0.37
    np.testing.assert_allclose(kernel.sum(axis=0), 1, atol=1e-14)


@pytest.mark.parametrize("strength", [0.3, 1.0])
def test_a_blur_far_from_edges_has_the_variance_of_its_gaussian(strength):
    """Sums over a grid are integrals to 4π²σ²/h² e^(−2π²σ²/h²), 2e-7 for σ = h; the grid reaches 10 σ."""
    layout, sigma = make_layout(grid(21, 21, MM)), 1.0 * MM
    source = np.zeros((441, 1))
    source[220] = 1
    spread = Noise({"crosstalk": {"strength": strength, "sigma": sigma}}, layout).read(source)[0, :, 0].numpy()
    apart = layout.pos - layout.pos[220]
    np.testing.assert_allclose(spread @ apart[:, :2], 0, atol=1e-15)
    np.testing.assert_allclose(spread @ apart[:, :2] ** 2, strength * sigma**2, rtol=1e-6)


def test_no_crosstalk_is_the_identity():
    """A taxel whose strength is 0 gives nothing, but gets of what its neighbours give."""
    none, signal = {"crosstalk": {"strength": 0.0, "sigma": "1 mm"}}, np.array([[1.0], [2.0], [3.0]])
    assert Noise(none, 3).lowered.terms == ()
    more = Noise([none, BLUR, {}], 3).read(signal)[0, :, 0].numpy() - signal[:, 0]
    assert more[0] > 0 and more[2] > 0
    np.testing.assert_allclose(more[0], more[2], rtol=1e-12)
    np.testing.assert_allclose(more.sum(), 0, atol=1e-15)


def test_crosstalk_keeps_channels_apart():
    signal = np.zeros((6, 3))
    signal[2, 1] = 1
    found = Noise(BLUR, line(6), CHANNELS).read(signal)[0].numpy()
    assert (found[:, [0, 2]] == 0).all() and (found[:, 1] > 0).all()
