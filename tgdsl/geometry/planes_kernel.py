"""Vectors and symmetric matrices of 3 as component planes, in Triton: see `planes`.

A matrix is its upper triangle, row by row: xx, xy, xz, yy, yz, zz.
"""

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false

from __future__ import annotations

import triton
import triton.language as tl

from tgdsl.geometry.planes import log2_e
from tgdsl.geometry.shapes_kernel import dot

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
