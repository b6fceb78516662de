"""Signed distance of MuJoCo's primitives and its gradient, and vectors, for Triton kernels: what `shapes` and `planes` define.

A vector is a tuple of three blocks, a rotation one of nine, row by row. A geom's size lies in memory, one after the other.
"""

from __future__ import annotations

import triton
import triton.language as tl

from tgdsl.geometry.planes import log2_e, tie
from tgdsl.geometry.shapes import KINDS

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false


CAPSULE, CYLINDER, BOX = (tl.constexpr(float(KINDS.index(shape))) for shape in ("capsule", "cylinder", "box"))
TIE = tl.constexpr(tie())


@triton.jit
def distance_to(shape, size, point):
    """Return the signed distance of points in a geom's frame to it [m]; all are of one shape, its size is in memory."""
    x, y, z = point
    distance = z
    first, second = tl.load(size), tl.load(size + 1)
    if shape == BOX:
        distance = _to_walls(tl.abs(x) - first, tl.abs(y) - second, tl.abs(z) - tl.load(size + 2))
    elif shape == CYLINDER:
        distance = _to_walls(tl.sqrt(x * x + y * y) - first, tl.abs(z) - second, float("-inf"))
    elif shape == CAPSULE:
        distance = length(x, y, z - tl.clamp(z, -second, second)) - first
    return distance


@triton.jit
def gradient_of(shape, size, point):
    """Return the gradient of the distance; each point has its own shape."""
    x, y, z = point
    first, second = tl.load(size), tl.load(size + 1)
    gradient = (tl.zeros_like(x), tl.zeros_like(x), tl.full(x.shape, 1.0, tl.float32))
    if is_any(shape == CAPSULE):
        gradient = select(shape == CAPSULE, direction(x, y, z - tl.clamp(z, -second, second)), gradient)
    if is_any(shape == CYLINDER):
        ux, uy, _ = direction(x, y, tl.zeros_like(x))
        wall, _, end = _from_walls(tl.sqrt(x * x + y * y) - first, float("-inf"), tl.abs(z) - second)
        gradient = select(shape == CYLINDER, (wall * ux, wall * uy, end * _sign(z)), gradient)
    if is_any(shape == BOX):
        wx, wy, wz = _from_walls(tl.abs(x) - first, tl.abs(y) - second, tl.abs(z) - tl.load(size + 2))
        gradient = select(shape == BOX, (wx * _sign(x), wy * _sign(y), wz * _sign(z)), gradient)
    return gradient


@triton.jit
def _to_walls(x, y, z):
    inside = tl.maximum(tl.maximum(x, y, propagate_nan=tl.PropagateNan.ALL), z, propagate_nan=tl.PropagateNan.ALL)
    return length(_positive(x), _positive(y), _positive(z)) + tl.minimum(inside, 0.0, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def _from_walls(x, y, z):
    """Return the direction away from two or three walls at right angles."""
    wx, wy, wz = _positive(x), _positive(y), _positive(z)
    outside = length(wx, wy, wz)
    is_x = x >= tl.maximum(y, z) - TIE
    is_y = (y >= z - TIE) & (x < tl.maximum(y, z) - TIE)
    inner = (tl.where(is_x, 1.0, 0.0), tl.where(is_y, 1.0, 0.0), tl.where(is_x | is_y, 0.0, 1.0))
    inverse = 1.0 / tl.where(outside > TIE, outside, 1.0)
    return select(outside > TIE, (wx * inverse, wy * inverse, wz * inverse), inner)


@triton.jit
def direction(x, y, z):
    """Return the unit vector along one, a fixed one if it is null."""
    norm = length(x, y, z)
    inverse = 1.0 / tl.where(norm <= TIE, 1.0, norm)
    return select(
        norm <= TIE,
        (tl.full(x.shape, 1.0, tl.float32), tl.zeros_like(x), tl.zeros_like(x)),
        (x * inverse, y * inverse, z * inverse),
    )


@triton.jit
def _positive(a):
    return tl.maximum(a, 0.0, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def _sign(a):
    return tl.where(a < -TIE, -1.0, 1.0)


@triton.jit
def is_any(mask):
    """Return whether any of a block is true, a scalar."""
    return tl.max(mask.to(tl.int32), axis=0) != 0


@triton.jit
def length(x, y, z):
    """Return the length of a vector."""
    return tl.sqrt(x * x + y * y + z * z)


@triton.jit
def select(condition, a, b):
    """Return a where the condition holds, else b."""
    return tl.where(condition, a[0], b[0]), tl.where(condition, a[1], b[1]), tl.where(condition, a[2], b[2])


@triton.jit
def dot(a, b):
    """Return the inner product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def rotate(r, a):
    """Return R a."""
    return dot((r[0], r[1], r[2]), a), dot((r[3], r[4], r[5]), a), dot((r[6], r[7], r[8]), a)


@triton.jit
def rotate_back(r, a):
    """Return Rᵀ a."""
    return dot((r[0], r[3], r[6]), a), dot((r[1], r[4], r[7]), a), dot((r[2], r[5], r[8]), a)


@triton.jit
def loaded(at):
    """Return the rotation that is in memory there."""
    x, y, z = (tl.load(at), tl.load(at + 1), tl.load(at + 2)), at + 3, at + 6
    return x[0], x[1], x[2], tl.load(y), tl.load(y + 1), tl.load(y + 2), tl.load(z), tl.load(z + 1), tl.load(z + 2)


# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false


LOG2_E = tl.constexpr(log2_e())


@triton.jit
def cross(a, b):
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def add3(a, b):
    """Return a + b of vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@triton.jit
def add6(a, b):
    """Return A + B of symmetric matrices."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@triton.jit
def scale3(factor, a):
    """Return factor · a of a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


@triton.jit
def scale6(factor, a):
    """Return factor · A of a symmetric matrix."""
    return factor * a[0], factor * a[1], factor * a[2], factor * a[3], factor * a[4], factor * a[5]


@triton.jit
def times(matrix, right):
    """Return A b of a symmetric A, its upper triangle row by row."""
    xx, xy, xz, yy, yz, zz = matrix
    return dot((xx, xy, xz), right), dot((xy, yy, yz), right), dot((xz, yz, zz), right)


@triton.jit
def solve(matrix, least, right):
    """Return (A + ε)⁻¹ b as `footprint` does."""
    xx, xy, xz, yy, yz, zz = matrix
    first = xx + least
    by_x, bz_x = xy / first, xz / first
    second = tl.maximum(yy + least - by_x * xy, least / 2)
    below = yz - by_x * xz
    bz_y = below / second
    third = tl.maximum(zz + least - bz_x * xz - bz_y * below, least / 2)
    y = right[1] - by_x * right[0]
    z = (right[2] - bz_x * right[0] - bz_y * y) / third
    y = y / second - bz_y * z
    return right[0] / first - by_x * y - bz_x * z, y, z
