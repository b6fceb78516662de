"""What decides whether a kernel finds moments, and where their radii are disturbed."""

import pytest
import torch
from moment_fields import made
from pressed_pads import compiled

from tgdsl.quantities.moment_sums import FELT_MOMENTS


@pytest.mark.parametrize("case", ["one field", "radius noise"])
def test_a_shift_of_the_radius_is_among_the_kernels_inputs_where_there_is_one(case):
    pairs, pos, source = made(case, torch.float32)
    found = list(FELT_MOMENTS.inputs(pairs, source.target.pairs, pos, source))
    assert all(part.dtype == torch.float32 for part in found)
    assert any(part is source.shift for part in found) == (case == "radius noise")


@pytest.mark.parametrize("radius_noise", [0.0, 1e-3])
def test_a_plan_of_moments_names_the_sensor_whose_noise_disturbs_their_radii(tmp_path, radius_noise):
    sensor = {"kind": "proximity", "feels": ["floor"], "reference_area": "1 cm2", "noise": {"radius_noise": radius_noise}}
    floor = '<body name="floor" pos="0 0 .012"><geom type="plane" size="1 1 .1"/></body>'
    touch = compiled(tmp_path, floor, {"floor": {"body": "floor"}}, {"near": sensor})
    (use,) = touch.plan.quantities["moments"].uses
    assert use.radius_noise == ("near" if radius_noise else "")
