"""Rotations of vectors along the last axis, by quaternions w, x, y, z of unit length.

Kernels of sensors have component planes instead: see `planes`.

Shapes: `*n` any leading axes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

Quat = Float[Tensor, "*n 4"]
Vector = Float[Tensor, "*n 3"]


def product(left: Quat, right: Quat) -> Quat:
    """Return the rotation that first turns by `right`, then by `left`."""
    w, v, other, u = left[..., :1], left[..., 1:], right[..., :1], right[..., 1:]
    scalar = w * other - (v * u).sum(dim=-1, keepdim=True)
    return torch.cat([scalar, w * u + other * v + torch.linalg.cross(v, u)], dim=-1)


def rotated(quat: Quat, vector: Vector) -> Vector:
    """Return vectors turned by rotations."""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)
