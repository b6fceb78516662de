"""Tracing without gradients records every operation: no shortcut that inspects values is taken."""

import pytest
import torch
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from tgdsl.geometry import planes

EXPONENT = torch.tensor(1.5, dtype=torch.float64)


def rotated_power(quat):
    """Combine a rotation with `power`, which inspects depths."""
    x, y, z = planes.rotate_back(planes.rotation(quat), planes.split(torch.ones_like(quat)[..., :3]))
    return planes.power(x.clamp(min=0.0), EXPONENT) + y * z


def forward_derivative(quat, direction):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(rotated_power(forward_ad.make_dual(quat, direction))).tangent


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("is_deep", [False, True])  # or no depth at all, where `power` skips the rest
def test_tracing_without_gradients_records_every_operation(is_deep):
    generator = torch.Generator().manual_seed(2)
    quat, other, direction = torch.randn((3, 5, 4), generator=generator, dtype=torch.float64)
    if not is_deep:  # (1, 1, 1) has x = −1.24 there
        quat = torch.tensor([0.6, 0.0, 0.0, -0.8], dtype=torch.float64).repeat(5, 1)
    _, expected = torch.func.jvp(rotated_power, (quat,), (direction,))
    with torch.no_grad():
        plain = rotated_power(other)
        torch.testing.assert_close(forward_derivative(quat, direction), expected)
        torch.testing.assert_close(torch.func.jvp(rotated_power, (quat,), (direction,))[1], expected)
        torch.testing.assert_close(torch.func.vmap(rotated_power)(torch.stack([other, quat]))[0], plain)
        torch.testing.assert_close(torch.jit.trace(rotated_power, (quat,), check_trace=False)(other), plain)
        torch.testing.assert_close(make_fx(rotated_power)(quat)(other), plain)


def test_a_forward_derivative_of_no_depth_is_zero():
    """By a shortcut it would be missing."""
    with torch.no_grad(), forward_ad.dual_level():
        depth = forward_ad.make_dual(torch.tensor([-1.0, 0.0]), torch.ones(2))
        assert forward_ad.unpack_dual(planes.power(depth, 1.5)).tangent.tolist() == [0.0, 0.0]
