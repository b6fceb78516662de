"""The example of docs/how-to/kind.md against closed forms of the parallel-plate capacitor."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.testing import KindConformance

sys.path.append(str(Path(__file__).parents[2] / "examples" / "plugins"))  # as in its package

from capacitance import CAPACITANCE

EPSILON = 8.8541878128e-12
THICKNESS, LEAST, PERMITTIVITY, RANGE = 2e-3, 5e-4, 4.0, 0.01
HALF = 0.01
"""Half the edge of the object and height of the pad's surface above its origin [m]."""
SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
  <body name="plate" pos="0 0 .1"><freejoint/><geom type="box" size=".05 .05 .01"/></body>
  <body name="other" pos="0 0 .2"><freejoint/><geom type="box" size=".05 .05 .01"/></body>
</worldbody></mujoco>"""


class TestCapacitance(KindConformance):
    kind = CAPACITANCE
    parameters = {"thickness": 0.002, "permittivity": 3.0, "range": 0.03}
    gates = ()


@pytest.fixture
def build(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def compiled(**parameters):
        grid = {"method": "grid", "rows": 3, "columns": 4, "direction": [0, 0, -1], "radius": 0.004}
        document = {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": grid}}}},
            "objects": {"plate": {"body": "plate"}, "other": {"body": "other"}},
            "sensors": {"skin": {"kind": "capacitance", "links": "pad", "feels": ["plate", "other"], **parameters}},
        }
        return tgdsl.compile(document, kinds=[CAPACITANCE], dtype="float64")

    return compiled


def read(touch, *gaps, other=1.0):
    """Return the readings with the plate's lower side at these distances from the taxels, (gap, taxel)."""
    state = touch.example_state(len(gaps))
    plate, second = (touch.inputs.bodies.index(name) for name in ("plate", "other"))
    state.body_quat[:] = torch.tensor([1.0, 0, 0, 0])
    state.body_pos[:] = 0.0
    state.body_pos[:, plate, 2] = torch.tensor(gaps, dtype=torch.float64) + 2 * HALF
    state.body_pos[:, second, 2] = other + 2 * HALF
    return touch(state)["skin"][..., 0].numpy()


AREA = 0.06 * 0.06 / 12


def capacitance_in_series(air, cover, permittivity=PERMITTIVITY):
    """Return the capacitance of two plates with two dielectrics: 1/C = d/(ε₀ A) + t/(ε₀ ε_r A)."""
    return 1 / (air / (EPSILON * AREA) + cover / (EPSILON * permittivity * AREA))


REST = capacitance_in_series(RANGE, THICKNESS)


def test_two_plates_are_two_capacitors_in_series(build):
    touch = build(thickness=THICKNESS, least_thickness=LEAST, permittivity=PERMITTIVITY, range=RANGE)
    expected = [capacitance_in_series(air, THICKNESS) - REST for air in (1e-4, 1e-3, 5e-3)]
    np.testing.assert_allclose(read(touch, 1e-4, 1e-3, 5e-3), np.repeat(expected, 12).reshape(3, 12), rtol=1e-9)


def test_a_pressed_cover_is_thinner_down_to_its_least_thickness(build):
    touch = build(thickness=THICKNESS, least_thickness=LEAST, permittivity=PERMITTIVITY, range=RANGE)
    expected = [capacitance_in_series(0.0, cover) - REST for cover in (THICKNESS, 1.5e-3, LEAST, LEAST)]
    np.testing.assert_allclose(read(touch, 0.0, -5e-4, -1.5e-3, -3e-3)[:, 5], expected, rtol=1e-9)


def test_readings_beyond_the_range_are_zero(build):
    far = read(build(thickness=THICKNESS, permittivity=PERMITTIVITY, range=RANGE), RANGE + 1e-6, 0.02, 0.3)
    np.testing.assert_array_equal(far, np.zeros_like(far))


def test_the_nearest_of_two_objects_counts(build):
    touch = build(range=RANGE)
    np.testing.assert_array_equal(read(touch, 5e-3, other=1e-3), read(touch, 1e-3))


def test_the_sensitivity_matches_the_closed_form(build):
    """−dC/dg = C²/(ε₀ A), by a central difference of the readings."""
    touch = build(thickness=THICKNESS, permittivity=PERMITTIVITY, range=RANGE)
    step = 1e-7
    near, at, far = read(touch, 2e-3 - step, 2e-3, 2e-3 + step)
    np.testing.assert_allclose((near - far) / (2 * step), (at + REST) ** 2 / (EPSILON * AREA), rtol=1e-7)


def test_a_least_thickness_above_the_thickness_is_refused(build):
    with pytest.raises(SpecError, match=r"least_thickness 0\.003 m is above thickness 0\.002 m"):
        build(thickness=0.002, least_thickness=0.003)


def test_a_wrong_rest_value_is_named():
    rest = torch.tensor([1.25])
    TestCapacitance()._assert_rests(rest.expand(3, 2, 1), rest, "rows")
    with pytest.raises(AssertionError, match=r"^inactive taxels read \[1.5\], expected `rest`, which is \[1.25\] in float32"):
        TestCapacitance()._assert_rests(torch.full((3, 2, 1), 1.5), rest, "inactive taxels")
