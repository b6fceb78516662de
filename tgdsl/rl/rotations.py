"""Rotations as tasks need them: quaternions w, x, y, z of unit length along the last axis.

Shapes: `*n` any leading axes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry.rotations import Quat, Vector, product, rotated

__all__ = ["about", "angle", "inverse", "product", "rotated", "six_numbers", "swing", "twist"]


def inverse(quat: Quat) -> Quat:
    """Return the inverse rotation."""
    return torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1)


def about(axis: Vector, angle: Float[Tensor, "*n"]) -> Quat:
    """Return rotations by an angle [rad] about an axis of unit length."""
    half = 0.5 * angle[..., None]
    return torch.cat([half.cos(), half.sin() * axis], dim=-1)


def angle(quat: Quat) -> Float[Tensor, "*n"]:
    """Return by how much a rotation turns, from 0 to π [rad]."""
    return 2.0 * torch.atan2(quat[..., 1:].norm(dim=-1), quat[..., 0].abs())


def twist(quat: Quat, axis: Vector) -> Float[Tensor, "*n"]:
    """Return by how much a rotation turns about an axis, from −π to π [rad]: the twist of its swing-twist decomposition."""
    along = (quat[..., 1:] * axis).sum(dim=-1)
    return 2.0 * torch.atan2(along * torch.where(quat[..., 0] < 0, -1.0, 1.0), quat[..., 0].abs())


def swing(quat: Quat, axis: Vector) -> Float[Tensor, "*n"]:
    """Return the angle by which a rotation tilts an axis, from 0 to π [rad]."""
    turned = rotated(quat, axis)
    return torch.atan2(torch.linalg.cross(axis, turned).norm(dim=-1), (axis * turned).sum(dim=-1))


def six_numbers(quat: Quat) -> Float[Tensor, "*n 6"]:
    """Return the first two columns of the rotation's matrix: orientation without a jump, as networks want it.

    Source: Zhou et al., On the Continuity of Rotation Representations in Neural Networks, CVPR 2019.
    """
    x, y = torch.eye(3, dtype=quat.dtype, device=quat.device)[:2]
    shape = quat[..., 1:].shape
    return torch.cat([rotated(quat, x.expand(shape)), rotated(quat, y.expand(shape))], dim=-1)
