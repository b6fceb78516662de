"""`benchmarks/marginal.py`: boxes whose contacts rounding decides, or does not, as laid out by hand."""

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
    """Two boxes of 0.1 m, the second on a slide of its own, at these places [m] of x."""
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco><option gravity="0 0 0"/><worldbody>
          <body pos="{first} 0 0"><joint type="slide" axis="1 0 0"/><geom type="box" size="0.05 0.05 0.05"/></body>
          <body pos="{second} 0.02 0.01"><joint type="slide" axis="1 0 0"/><geom type="box" size="0.05 0.05 0.05"/></body>
        </worldbody></mujoco>""")


def verdict(one: mujoco.MjModel, two: mujoco.MjModel) -> tuple[bool, bool]:
    """Return whether the contacts are beyond the limits, and whether rounding explains that."""
    own = contacts_at(one, one.qpos0)

    def measured(model: mujoco.MjModel) -> np.ndarray:
        return apart(own, contacts_at(model, model.qpos0)).max(axis=0, initial=0.0)

    off = measured(two)
    return bool((off > LIMITS).any()), is_marginal(one, off, LIMITS, measured)


def test_a_contact_that_appears_where_faces_touch_is_marginal():
    apart_by_rounding, touching = boxes(0.1, 0.2 + 1e-9), boxes(0.1, 0.2 - 1e-9)
    assert not contacts_at(apart_by_rounding, apart_by_rounding.qpos0)
    assert contacts_at(touching, touching.qpos0)
    assert verdict(apart_by_rounding, touching) == (True, True)


@pytest.mark.parametrize("gap", [-2e-4, 2e-4])
def test_a_contact_that_a_wrong_place_makes_or_takes_is_not(gap: float):
    assert verdict(boxes(0.1, 0.2 - gap), boxes(0.1, 0.2 + gap)) == (True, False)


def test_a_depth_that_a_wrong_place_changes_is_not():
    one, two = boxes(0.1, 0.199), boxes(0.1, 0.19901)
    (key,) = contacts_at(one, one.qpos0)
    assert contacts_at(one, one.qpos0)[key][0] - contacts_at(two, two.qpos0)[key][0] == pytest.approx(1e-5, abs=1e-9)
    assert verdict(one, two) == (True, False)


def test_copies_are_within_the_spacing_of_float32_and_leave_the_model_alone():
    one = boxes(0.1, 0.2)
    kept = {name: getattr(one, name).copy() for name in ROUNDED}
    for rounded in rounded_copies(one):
        for name in ROUNDED:
            np.testing.assert_allclose(getattr(rounded, name), kept[name], rtol=float(np.finfo(np.float32).eps), atol=0)
        assert (rounded.body_pos[1:, 0] != kept["body_pos"][1:, 0]).all()
    for name in ROUNDED:
        np.testing.assert_array_equal(getattr(one, name), kept[name])
