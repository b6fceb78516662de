"""`benchmarks/marginal.py`: hand-placed boxes whose contacts depend on rounding, or do not."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from marginal import ROUNDED, apart, contacts_at, is_marginal, rounded_copies

LIMITS = np.array([1e-6, 0.01])


def boxes(first: float, second: float) -> mujoco.MjModel:
    """Return two boxes of 0.1 m on separate slides at these x [m]."""
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco><option gravity="0 0 0"/><worldbody>
          <body pos="{first} 0 0"><joint type="slide" axis="1 0 0"/><geom type="box" size="0.05 0.05 0.05"/></body>
          <body pos="{second} 0.02 0.01"><joint type="slide" axis="1 0 0"/><geom type="box" size="0.05 0.05 0.05"/></body>
        </worldbody></mujoco>""")


def verdict(one: mujoco.MjModel, two: mujoco.MjModel) -> tuple[bool, bool]:
    """Return whether the contacts differ beyond the limits, and whether rounding explains it."""
    contacts = contacts_at(one, one.qpos0)

    def measured(model: mujoco.MjModel) -> np.ndarray:
        return apart(contacts, contacts_at(model, model.qpos0)).max(axis=0, initial=0.0)

    off = measured(two)
    return bool((off > LIMITS).any()), is_marginal(one, off, LIMITS, measured)


def test_a_contact_that_appears_where_faces_touch_is_marginal():
    apart_by_rounding, touching = boxes(0.1, 0.2 + 1e-9), boxes(0.1, 0.2 - 1e-9)
    assert not contacts_at(apart_by_rounding, apart_by_rounding.qpos0)
    assert contacts_at(touching, touching.qpos0)
    assert verdict(apart_by_rounding, touching) == (True, True)


@pytest.mark.parametrize("gap", [-2e-4, 2e-4])
def test_a_contact_changed_by_a_wrong_position_is_not_marginal(gap: float):
    assert verdict(boxes(0.1, 0.2 - gap), boxes(0.1, 0.2 + gap)) == (True, False)


def test_a_depth_changed_by_a_wrong_position_is_not_marginal():
    one, two = boxes(0.1, 0.199), boxes(0.1, 0.19901)
    (key,) = contacts_at(one, one.qpos0)
    assert contacts_at(one, one.qpos0)[key][0] - contacts_at(two, two.qpos0)[key][0] == pytest.approx(1e-5, abs=1e-9)
    assert verdict(one, two) == (True, False)


def test_rounded_copies_stay_within_float32_spacing_and_keep_the_model():
    one = boxes(0.1, 0.2)
    original = {name: getattr(one, name).copy() for name in ROUNDED}
    for rounded in rounded_copies(one):
        for name in ROUNDED:
            np.testing.assert_allclose(getattr(rounded, name), original[name], rtol=float(np.finfo(np.float32).eps), atol=0)
        assert (rounded.body_pos[1:, 0] != original["body_pos"][1:, 0]).all()
    for name in ROUNDED:
        np.testing.assert_array_equal(getattr(one, name), original[name])
