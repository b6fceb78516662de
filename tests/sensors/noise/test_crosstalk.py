"""Crosstalk: any layout, and the sum is kept."""

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
    apart = layout.link_id[:, None] != layout.link_id
    assert (spread[apart] == 0).all()
    assert (spread[layout.normal @ layout.normal.T <= 0] == 0).all()


def test_the_papers_blur_loses_force_at_edges_and_ours_none():
    """A kernel that is padded with zeros keeps about half at an edge and a quarter at a corner, a blur of χ = 1 throughout."""
    found = filters.crosstalk_edges()
    assert found.paper[1] < 0.62 and found.paper[2] < 0.37


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
