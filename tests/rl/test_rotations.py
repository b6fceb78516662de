"""Angles of and between rotations, against float64 matrices and closed forms, also near 0 and π."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from tgdsl.rl import rotations

ANGLES = [0.0, 1e-9, 1e-4, 0.3, 1.7, 3.0, math.pi - 1e-7, math.pi]


def unit_vectors(*shape: int) -> torch.Tensor:
    vectors = torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape)), dtype=torch.float64)
    return vectors / vectors.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("angle", ANGLES)
def test_between_is_the_angle_of_the_relative_rotation(angle, sign):
    """For both signs of the quaternion, to float64 rounding also near 0 and π."""
    quat, axis = unit_vectors(100, 4), unit_vectors(100, 3)
    turned = rotations.product(rotations.about(axis, torch.full((100,), angle, dtype=torch.float64)), quat)
    torch.testing.assert_close(
        rotations.between(sign * turned, quat), torch.full((100,), angle, dtype=torch.float64), rtol=0, atol=1e-14
    )


def test_swing_is_the_angle_between_an_axis_and_its_rotated_image():
    quat, axis = unit_vectors(1000, 4), unit_vectors(1000, 3)
    turned = Rotation.from_quat(quat.numpy()[:, [1, 2, 3, 0]]).apply(axis.numpy())
    expected = torch.from_numpy((turned * axis.numpy()).sum(axis=1)).acos()
    torch.testing.assert_close(rotations.swing(quat, axis), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("tilt", ANGLES)
def test_swing_does_not_depend_on_the_twist(tilt):
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(7, 3)
    across = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64).expand(7, 3)
    twisted = rotations.about(axis, torch.linspace(-3, 3, 7, dtype=torch.float64))
    quat = rotations.product(rotations.about(across, torch.full((7,), tilt, dtype=torch.float64)), twisted)
    torch.testing.assert_close(rotations.swing(quat, axis), torch.full((7,), tilt, dtype=torch.float64), rtol=0, atol=1e-14)
