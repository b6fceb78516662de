"""Arithmetic by NumPy: the same bytes as torch's, where values may be looked at."""

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from tgdsl.geometry import planes
from tgdsl.quantities.pairs import relate
from tgdsl.tensors import on_host as on_host_file
from tgdsl.tensors.on_host import on_host


def rotated(quat, vector):
    return planes.rotate_back(planes.rotation(quat), planes.split(vector))


def both(work, *given):
    """Return what is made by NumPy, and by torch as where derivatives are wanted."""
    with torch.no_grad():
        found = work(*given)
    with torch.enable_grad():
        return found, work(*given)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_bytes_are_those_of_torch(dtype):
    generator = torch.Generator().manual_seed(0)
    quat, vector = (torch.randn((17, 11, n), generator=generator, dtype=dtype) for n in (4, 3))
    found, expected = both(lambda *given: on_host(rotated, *given), quat, vector)
    for own, other in zip(found, expected, strict=True):
        assert own.dtype == dtype
        assert own.numpy().tobytes() == other.numpy().tobytes()


@pytest.mark.parametrize("with_motion", [True, False])
def test_relative_poses_are_the_same_bytes_with_and_without_derivatives(with_motion):
    generator = torch.Generator().manual_seed(1)
    pos, linvel, angvel = torch.randn((3, 5, 6, 3), generator=generator, dtype=torch.float64)
    quat = torch.randn((5, 6, 4), generator=generator, dtype=torch.float64)
    link, target = torch.tensor([0, 1, 2, 3]), torch.tensor([5, 5, 4, 4])
    gate = torch.where(torch.rand((5, 4), generator=generator) < 0.5, 0.0, -torch.inf)
    motion = (linvel, angvel) if with_motion else (None, None)
    found, expected = both(lambda: relate(pos, quat, link, target, torch.float32, *motion, gate))
    assert (found.motion is not None) == with_motion
    parts = [
        [*own.rotation, *own.offset, *(part for field in own.motion or () for part in field), own.gate]
        for own in (found, expected)
    ]
    for own, other in zip(*parts, strict=True):
        assert own.numpy().tobytes() == other.numpy().tobytes()


def test_what_is_no_number_warns_of_nothing():
    given = torch.tensor([0.0, torch.inf, torch.nan, 1e300], dtype=torch.float64)
    found, expected = both(lambda own: on_host(lambda x: [1.0 / x, x * x, x - x], own), given)
    for own, other in zip(found, expected, strict=True):
        torch.testing.assert_close(own, other, rtol=0, atol=0, equal_nan=True)


class Own(torch.Tensor):
    """A class of tensors of somebody's own."""


def test_numpy_works_where_values_may_be_looked_at_and_are_few(monkeypatch):
    seen = []

    def noted(x):
        seen.append(type(x))
        return [x + x]

    few = torch.ones(8, requires_grad=True)
    both(lambda own: on_host(noted, own), few)
    assert seen == [np.ndarray, torch.Tensor]
    with torch.no_grad():
        on_host(noted, few.detach().as_subclass(Own))
    assert seen.pop() is Own
    monkeypatch.setattr(on_host_file, "MOST", 7)
    with torch.no_grad():
        on_host(noted, few)
    assert seen[-1] is torch.Tensor


EXPONENT = torch.tensor(1.5, dtype=torch.float64)


def seen_through(quat):
    """Return what is made of NumPy's rotation and of a look at depths."""
    x, y, z = on_host(rotated, quat, torch.ones_like(quat)[..., :3])
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
