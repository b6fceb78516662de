"""Samples at the same times and channels of the same name, which two modules' readings share."""

import numpy as np
import pytest
from oracles.setups.sounds import MODES, plate, pressed

from tgdsl.module.accuracy.states import common_of, readings_of

FORCES = (0.0, 2.0, 0.5, 0.0, 0.0)


def sounds(touch):
    return readings_of(touch, [pressed(touch, [force] * 2) for force in FORCES], "s")


@pytest.mark.parametrize(
    ("one", "other", "places"), [(12, 8, [2, 5, 8, 11]), (8, 16, list(range(8))), (16, 8, list(range(1, 16, 2)))]
)
def test_samples_are_compared_at_common_times(tmp_path, one, other, places):
    """Sample k of K is at k/K of a step: every third of 12 and every second of 8 coincide."""
    module, other_module = (plate(tmp_path, samples=count, links=["plate", "other"]) for count in (one, other))
    common = common_of(module, other_module, "s")
    assert common.channels is None
    np.testing.assert_array_equal(common.here, [2 * place + row for place in places for row in range(2)])
    expected = common.of_one(sounds(module))
    assert abs(expected).max() > 1e-3
    np.testing.assert_allclose(common.of_other(sounds(other_module)), expected, rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:contact audio of plate")
def test_fewer_samples_lack_only_the_modes_above_their_rate(tmp_path):
    """6000 Hz cannot represent a mode at 2903 Hz."""
    many, few, short = (
        plate(tmp_path, **options) for options in ({"samples": 12}, {"samples": 6}, {"samples": 12, "modes": MODES[:2]})
    )
    common = common_of(many, few, "s")
    np.testing.assert_allclose(common.of_other(sounds(few)), common.of_one(sounds(short)), rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:contact audio of plate")
def test_a_channel_that_the_other_module_lacks_counts_as_zero(tmp_path):
    many, few = (plate(tmp_path, outputs="bands", samples=count) for count in (12, 6))
    common, missing = common_of(many, few, "s"), many.outputs[0].channels.index("band_3162")
    all_sounds, common_sounds = sounds(many), common.of_other(sounds(few))
    assert all_sounds[..., missing].max() > 0 and (common_sounds[..., missing] == 0).all()
    shared = [i for i in range(all_sounds.shape[-1]) if i < missing]
    np.testing.assert_allclose(common_sounds[..., shared], all_sounds[..., shared], rtol=1e-12, atol=0)
