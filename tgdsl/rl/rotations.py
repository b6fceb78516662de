"""Rotations as tasks need them: quaternions w, x, y, z of unit length along the last axis.

Shapes: `*n` any leading axes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.linalg import vector_norm

from tgdsl.geometry.rotations import Quat, Vector, product, rotated

__all__ = ["Quat", "about", "between", "inverse", "product", "rotated", "six_numbers", "swing", "twist"]


def inverse(quat: Quat) -> Quat:
    """Return the inverse rotation."""
    return torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1)


def about(axis: Vector, angle: Float[Tensor, "*n"]) -> Quat:
    """Return rotations by an angle [rad] about an axis of unit length."""
    half = 0.5 * angle[..., None]
    return torch.cat([half.cos(), half.sin() * axis], dim=-1)


def between(one: Quat, other: Quat) -> Float[Tensor, "*n"]:
    """Return the angle θ of the rotation between two rotations, from 0 to π [rad].

    Unit quaternions are 2 |sin θ/4| and 2 |cos θ/4| apart, as q and −q are the same rotation.
    """
    apart, against = (vector_norm(difference, dim=-1) for difference in (one - other, one + other))
    return 4.0 * torch.atan2(torch.minimum(apart, against), torch.maximum(apart, against))


def twist(quat: Quat, axis: Vector) -> Float[Tensor, "*n"]:
    """Return a rotation's angle about an axis, from −π to π [rad]: the twist of its swing-twist decomposition."""
    along = (quat[..., 1:] * axis).sum(dim=-1)
    return 2.0 * torch.atan2(along * torch.where(quat[..., 0] < 0, -1.0, 1.0), quat[..., 0].abs())


def swing(quat: Quat, axis: Vector) -> Float[Tensor, "*n"]:
    """Return the angle by which a rotation tilts an axis, from 0 to π [rad]."""
    turn = quat[..., 1:]
    along = (turn * axis).sum(dim=-1, keepdim=True)
    return 2.0 * torch.atan2(vector_norm(turn - along * axis, dim=-1), torch.hypot(quat[..., 0], along[..., 0]))


def six_numbers(quat: Quat) -> Float[Tensor, "*n 6"]:
    """Return the first two columns of the rotation's matrix, a continuous representation for networks.

    Source: Zhou et al., On the Continuity of Rotation Representations in Neural Networks, CVPR 2019.
    """
    axes = torch.eye(3, dtype=quat.dtype, device=quat.device)[:2]
    shape = (*quat.shape[:-1], 2)
    return rotated(quat[..., None, :].expand(*shape, 4), axes.expand(*shape, 3)).flatten(-2)
