"""Arithmetic by NumPy: the same bytes as torch's, where values may be looked at."""

import numpy as np
import pytest
import torch

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


def test_numpy_works_where_values_may_be_looked_at_and_are_few(monkeypatch):
    seen = []

    def noted(x):
        seen.append(type(x))
        return [x + x]

    few = torch.ones(8, requires_grad=True)
    both(lambda own: on_host(noted, own), few)
    assert seen == [np.ndarray, torch.Tensor]
    monkeypatch.setattr(on_host_file, "MOST", 7)
    with torch.no_grad():
        on_host(noted, few)
    assert seen[-1] is torch.Tensor
