"""Vectors and rotations as separate component planes.

A vector is a tuple `(x, y, z)` of equally shaped tensors, a rotation a tuple of nine, row by row. Written so, every
operation is pointwise and a compiler fuses a whole sensor into one loop; a trailing axis of 3 costs several times more.
What adds and multiplies alone takes NumPy's arrays too.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from tgdsl.tensors.env_ids import is_cheap_to_read

Plane = TypeVar("Plane", Tensor, np.ndarray)
VecOf = tuple[Plane, Plane, Plane]
RotOf = tuple[Plane, Plane, Plane, Plane, Plane, Plane, Plane, Plane, Plane]
Vec, Rot = VecOf[Tensor], RotOf[Tensor]

# Functions, not floats of the module: under dynamic shapes torch.compile makes those inputs of the graph.


def tie() -> float:
    """Return the tolerance [m] within which lengths count as equal; the first of equals wins.

    So the nearest surface and the outward direction do not alternate with the last digits of a pose at rest. Float32 resolves
    a few centimetres not much better.
    """
    return 1e-7


def tiny() -> float:
    """Return up to where squared lengths [m²] count as zero: the derivative of a reciprocal root is a float32 down to there."""
    return 1e-24


def log2_e() -> float:
    """Return log₂ e."""
    return 1.4426950408889634


def pi() -> float:
    """Return π; an attribute of `math` is a float of a module too."""
    return 3.141592653589793


def split(stacked: Plane) -> VecOf[Plane]:
    """Return the components of a `(..., 3)` tensor, as views."""
    return stacked[..., 0], stacked[..., 1], stacked[..., 2]


def add(a: VecOf[Plane], b: VecOf[Plane]) -> VecOf[Plane]:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def sub(a: VecOf[Plane], b: VecOf[Plane]) -> VecOf[Plane]:
    """Return a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(factor: Tensor, a: Vec) -> Vec:
    """Return factor · a."""
    return factor * a[0], factor * a[1], factor * a[2]


def dot(a: VecOf[Plane], b: VecOf[Plane]) -> Plane:
    """Return the inner product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: VecOf[Plane], b: VecOf[Plane]) -> VecOf[Plane]:
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def where(condition: Tensor, a: Vec, b: Vec) -> Vec:
    """Return a where the condition holds, else b."""
    return (
        torch.where(condition, a[0], b[0]),
        torch.where(condition, a[1], b[1]),
        torch.where(condition, a[2], b[2]),
    )


def vec(parts: Iterable[Tensor]) -> Vec:
    """Return three planes as a vector."""
    x, y, z = parts
    return x, y, z


def rot(parts: Iterable[Tensor]) -> Rot:
    """Return nine planes, row by row, as a rotation."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = parts
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


def rotate(r: RotOf[Plane], a: VecOf[Plane]) -> VecOf[Plane]:
    """Return R a."""
    return (
        r[0] * a[0] + r[1] * a[1] + r[2] * a[2],
        r[3] * a[0] + r[4] * a[1] + r[5] * a[2],
        r[6] * a[0] + r[7] * a[1] + r[8] * a[2],
    )


def rotate_back(r: RotOf[Plane], a: VecOf[Plane]) -> VecOf[Plane]:
    """Return Rᵀ a."""
    return (
        r[0] * a[0] + r[3] * a[1] + r[6] * a[2],
        r[1] * a[0] + r[4] * a[1] + r[7] * a[2],
        r[2] * a[0] + r[5] * a[1] + r[8] * a[2],
    )


def transpose_times(a: RotOf[Plane], b: RotOf[Plane]) -> RotOf[Plane]:
    """Return Aᵀ B."""
    columns = [rotate_back(a, (b[j], b[j + 3], b[j + 6])) for j in range(3)]
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = columns
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


def rotation(quat: Plane) -> RotOf[Plane]:
    """Return the rotation of a `(..., 4)` quaternion w, x, y, z, which need not have unit length."""
    w, x, y, z = (quat[..., i] for i in range(4))
    two = 2.0 / (w * w + x * x + y * y + z * z)
    tw, tx, ty = two * w, two * x, two * y
    xx, yy, zz = tx * x, ty * y, two * z * z
    xy, xz, yz = tx * y, tx * z, ty * z
    wx, wy, wz = tw * x, tw * y, tw * z
    return 1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy


def length_and_direction(a: Vec) -> tuple[Tensor, Vec]:
    """Return |a| and a/|a|; where |a| ≤ `tie` the direction is (1, 0, 0). Derivatives are finite everywhere."""
    length, is_null, inverse = length_and_inverse(dot(a, a))
    x, y, z = (torch.where(is_null, value, part * inverse) for part, value in zip(a, (1.0, 0.0, 0.0), strict=True))
    return length, (x, y, z)


def safe_sqrt(squared: Tensor) -> Tensor:
    """Return the square root of a squared length [m²], with derivative 0 rather than infinite where it vanishes."""
    return _safe_roots(squared)[0]


def length_and_inverse(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return a length [m], whether it is within `tie` of nothing, and one over it [1/m], which is finite where it is."""
    length, inverse = _safe_roots(squared)
    is_null = length <= tie()
    if not length.is_cuda:  # with a division Inductor makes fewer loops of a CPU's code: it runs twice as fast
        inverse = 1.0 / torch.where(is_null, 1.0, length)
    return length, is_null, inverse


def _safe_roots(squared: Tensor) -> tuple[Tensor, Tensor]:
    is_null = squared <= tiny()
    inverse = torch.rsqrt(torch.where(is_null, 1.0, squared))
    return torch.where(is_null, 0.0, squared * inverse), inverse


def power(depth: Tensor, exponent: Tensor | float) -> Tensor:
    """Return d^α of depths d ≥ 0, to α |log₂ d| roundings; where d = 0 its derivatives are 0, not infinite, even for α < 1."""
    is_none = depth <= 0
    if is_cheap_to_read(depth) and bool(is_none.all()):
        return torch.zeros_like(depth)
    logarithm = torch.log2(torch.where(is_none, 1.0, depth))  # a general power takes ten times as many instructions
    return torch.where(is_none, torch.zeros_like(depth), torch.exp2(exponent * logarithm))
