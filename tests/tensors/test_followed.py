"""Who follows operations without gradients sees all of them: nothing is left out by a look at values."""

import pytest
import torch
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from tgdsl.geometry import planes

EXPONENT = torch.tensor(1.5, dtype=torch.float64)


def seen_through(quat):
    """Return what is made of a rotation and of a look at depths."""
    x, y, z = planes.rotate_back(planes.rotation(quat), planes.split(torch.ones_like(quat)[..., :3]))
    return planes.power(x.clamp(min=0.0), EXPONENT) + y * z


def forwards(quat, along):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(seen_through(forward_ad.make_dual(quat, along))).tangent


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("is_deep", [False, True])  # or no depth at all, where power leaves the rest out
def test_who_follows_operations_without_gradients_sees_all_of_them(is_deep):
    generator = torch.Generator().manual_seed(2)
    quat, other, along = torch.randn((3, 5, 4), generator=generator, dtype=torch.float64)
    if not is_deep:  # (1, 1, 1) has x = −1.24 there
        quat = torch.tensor([0.6, 0.0, 0.0, -0.8], dtype=torch.float64).repeat(5, 1)
    _, expected = torch.func.jvp(seen_through, (quat,), (along,))
    with torch.no_grad():
        plain = seen_through(other)
        torch.testing.assert_close(forwards(quat, along), expected)
        torch.testing.assert_close(torch.func.jvp(seen_through, (quat,), (along,))[1], expected)
        torch.testing.assert_close(torch.func.vmap(seen_through)(torch.stack([other, quat]))[0], plain)
        torch.testing.assert_close(torch.jit.trace(seen_through, (quat,), check_trace=False)(other), plain)
        torch.testing.assert_close(make_fx(seen_through)(quat)(other), plain)
