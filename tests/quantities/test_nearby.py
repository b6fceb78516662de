"""Inputs of the kernel of moments, and noise of their radii."""

import pytest
import torch
from moment_fields import made
from pressed_pads import compiled

from tgdsl.quantities.moment_sums import FELT_MOMENTS


@pytest.mark.parametrize("case", ["one field", "radius noise"])
def test_a_shift_of_the_radius_is_an_input_of_the_kernel(case):
    pairs, pos, source = made(case, torch.float32)
    inputs = list(FELT_MOMENTS.inputs(pairs, source.target.pairs, pos, source))
    assert all(part.dtype == torch.float32 for part in inputs)
    assert any(part is source.shift for part in inputs) == (case == "radius noise")


@pytest.mark.parametrize("radius_noise", [0.0, 1e-3])
def test_a_plan_of_moments_names_the_sensor_with_radius_noise(tmp_path, radius_noise):
    sensor = {"kind": "proximity", "feels": ["floor"], "reference_area": "1 cm2", "noise": {"radius_noise": radius_noise}}
    floor = '<body name="floor" pos="0 0 .012"><geom type="plane" size="1 1 .1"/></body>'
    touch = compiled(tmp_path, floor, {"floor": {"body": "floor"}}, {"near": sensor})
    (use,) = touch.plan.quantities["moments"].uses
    assert use.radius_noise == ("near" if radius_noise else "")
