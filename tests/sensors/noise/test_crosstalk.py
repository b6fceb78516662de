"""Crosstalk: any layout, and the sum is preserved."""

import numpy as np
import pytest
import torch
from noise_stages import CHANNELS
from oracles import filters
from oracles.filters import BLUR, UNEVEN
from oracles.setups.signals import Noise, line

LAYOUTS = filters.layouts()


@pytest.mark.parametrize("knobs", [BLUR, UNEVEN])
@pytest.mark.parametrize("name", LAYOUTS)
def test_crosstalk_stays_on_a_link_and_side_and_leaves_out_inactive_taxels(name, knobs):
    layout = LAYOUTS[name]
    source = np.eye(layout.num_taxels)[:, :, None]
    spread = Noise(knobs, layout, num_envs=layout.num_taxels, dtype=torch.float32).read(source)[..., 0].numpy()
    is_inactive, alone = layout.radius == 0, np.eye(layout.num_taxels)
    np.testing.assert_allclose(spread[is_inactive], alone[is_inactive], atol=1e-7)
    np.testing.assert_allclose(spread[:, is_inactive], alone[:, is_inactive], atol=1e-7)
    assert (spread.diagonal()[~is_inactive] < 0.99).all()
    on_other_links = layout.link_id[:, None] != layout.link_id
    assert (spread[on_other_links] == 0).all()
    assert (spread[layout.normal @ layout.normal.T <= 0] == 0).all()


def test_the_papers_blur_loses_force_at_edges_and_ours_does_not():
    """A zero-padded kernel keeps about half at an edge and a quarter at a corner, a blur of χ = 1 throughout."""
    comparison = filters.crosstalk_edges()
    assert comparison.paper[1] < 0.62 and comparison.paper[2] < 0.37


def test_no_crosstalk_is_the_identity():
    """A taxel of strength 0 gives nothing, but receives from its neighbours."""
    off, signal = {"crosstalk": {"strength": 0.0, "sigma": "1 mm"}}, np.array([[1.0], [2.0], [3.0]])
    assert Noise(off, 3).lowered.terms == ()
    more = Noise([off, BLUR, {}], 3).read(signal)[0, :, 0].numpy() - signal[:, 0]
    assert more[0] > 0 and more[2] > 0
    np.testing.assert_allclose(more[0], more[2], rtol=1e-12)
    np.testing.assert_allclose(more.sum(), 0, atol=1e-15)


def test_crosstalk_keeps_channels_apart():
    signal = np.zeros((6, 3))
    signal[2, 1] = 1
    reading = Noise(BLUR, line(6), CHANNELS).read(signal)[0].numpy()
    assert (reading[:, [0, 2]] == 0).all() and (reading[:, 1] > 0).all()
