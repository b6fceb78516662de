"""What two modules' readings have in common: samples at the same times, channels of the same name."""

import numpy as np
import pytest
from oracles.setups.sounds import MODES, plate, pressed

from tgdsl.module.accuracy.states import common_of, readings_of

FORCES = (0.0, 2.0, 0.5, 0.0, 0.0)


def heard(touch):
    return readings_of(touch, [pressed(touch, [force] * 2) for force in FORCES], "s")


@pytest.mark.parametrize(
    ("one", "other", "places"), [(12, 8, [2, 5, 8, 11]), (8, 16, list(range(8))), (16, 8, list(range(1, 16, 2)))]
)
def test_samples_are_compared_at_common_times(tmp_path, one, other, places):
    """Sample k of K is at k/K of a step, so that of 12 and 8 every third and every second are at the same time."""
    own, more = (plate(tmp_path, samples=count, links=["plate", "other"]) for count in (one, other))
    common = common_of(own, more, "s")
    assert common.channels is None
    np.testing.assert_array_equal(common.here, [2 * place + row for place in places for row in range(2)])
    expected = common.of_one(heard(own))
    assert abs(expected).max() > 1e-3
    np.testing.assert_allclose(common.of_other(heard(more)), expected, rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:contact audio of plate")
def test_fewer_samples_lack_the_modes_that_they_do_not_hold(tmp_path):
    """That is all that they lack: 6000 Hz hold no mode at 2903 Hz."""
    own, few, short = (
        plate(tmp_path, **given) for given in ({"samples": 12}, {"samples": 6}, {"samples": 12, "modes": MODES[:2]})
    )
    common = common_of(own, few, "s")
    np.testing.assert_allclose(common.of_other(heard(few)), common.of_one(heard(short)), rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:contact audio of plate")
def test_a_channel_that_the_other_lacks_counts_as_zero(tmp_path):
    own, few = (plate(tmp_path, outputs="bands", samples=count) for count in (12, 6))
    common, lost = common_of(own, few, "s"), own.outputs[0].channels.index("band_3162")
    whole, found = heard(own), common.of_other(heard(few))
    assert whole[..., lost].max() > 0 and (found[..., lost] == 0).all()
    held = [i for i in range(whole.shape[-1]) if i < lost]
    np.testing.assert_allclose(found[..., held], whole[..., held], rtol=1e-12, atol=0)
