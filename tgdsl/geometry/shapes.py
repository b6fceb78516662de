"""Signed distance of MuJoCo's primitives, negative inside, and its unit gradient.

Every function takes a point in the geom's frame [m] and the geom's size as MuJoCo defines it [m] (tensors that broadcast
with the point), and returns the distance [m] and the outward gradient. Both are exact everywhere. At centres, axes, edges and
corners the nearest surface point is not unique: the functions always return the same candidate, also within `planes.tie()`.
Derivatives of the distance are the gradient; all are finite.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from tgdsl.geometry.planes import Vec, length_and_direction, length_and_inverse, tie

Shape = Callable[[Vec, Vec], tuple[Tensor, Vec]]

ELLIPSOID_STEPS = 18
"""Newton steps of the ellipsoid: enough for 1e-14 of its size in float64 at aspect ratios up to 100, everywhere."""


def plane(point: Vec, size: Vec) -> tuple[Tensor, Vec]:
    """Half-space z ≤ 0. MuJoCo collides planes as infinite, whatever their size."""
    z = point[2]
    zero = torch.zeros_like(z)
    return z, (zero, zero, torch.ones_like(z))


def sphere(point: Vec, size: Vec) -> tuple[Tensor, Vec]:
    """Ball of radius `size[0]`."""
    distance, gradient = length_and_direction(point)
    return distance - size[0], gradient


def capsule(point: Vec, size: Vec) -> tuple[Tensor, Vec]:
    """All points within `size[0]` of the segment |z| ≤ `size[1]`."""
    x, y, z = point
    distance, gradient = length_and_direction((x, y, z - torch.minimum(torch.maximum(z, -size[1]), size[1])))
    return distance - size[0], gradient


def box(point: Vec, size: Vec) -> tuple[Tensor, Vec]:
    """Box of half-extents `size`."""
    qx, qy, qz = (part.abs() - half for part, half in zip(point, size, strict=True))
    sx, sy, sz = (torch.where(part < -tie(), -1.0, 1.0).to(part.dtype) for part in point)
    wx, wy, wz = qx.clamp(min=0), qy.clamp(min=0), qz.clamp(min=0)
    outside, is_inside, inverse = length_and_inverse(wx * wx + wy * wy + wz * wz)
    inside = torch.maximum(torch.maximum(qx, qy), qz)
    is_x = qx >= torch.maximum(qy, qz) - tie()
    is_y = ~is_x & (qy >= qz - tie())
    gradient = (
        sx * torch.where(is_inside, is_x.to(sx.dtype), wx * inverse),
        sy * torch.where(is_inside, is_y.to(sy.dtype), wy * inverse),
        sz * torch.where(is_inside, (~is_x & ~is_y).to(sz.dtype), wz * inverse),
    )
    return outside + inside.clamp(max=0), gradient


def cylinder(point: Vec, size: Vec) -> tuple[Tensor, Vec]:
    """Cylinder of radius `size[0]` and half-height `size[1]` along z."""
    x, y, z = point
    radial, (ux, uy, _) = length_and_direction((x, y, torch.zeros_like(x)))
    qr, qz = radial - size[0], z.abs() - size[1]
    sz = torch.where(z < -tie(), -1.0, 1.0).to(z.dtype)
    wr, wz = qr.clamp(min=0), qz.clamp(min=0)
    outside, is_inside, inverse = length_and_inverse(wr * wr + wz * wz)
    is_wall = qr >= qz - tie()
    along_radius = torch.where(is_inside, is_wall.to(wr.dtype), wr * inverse)
    along_axis = torch.where(is_inside, (~is_wall).to(wz.dtype), wz * inverse)
    distance = outside + torch.maximum(qr, qz).clamp(max=0)
    return distance, (along_radius * ux, along_radius * uy, along_axis * sz)


def ellipsoid(point: Vec, size: Vec) -> tuple[Tensor, Vec]:
    """Ellipsoid of semi-axes `size`: the true distance.

    The nearest point X of the surface satisfies p = X + t N, N the outward normal there. In units of the least semi-axis e,
    with E_i = e_i/e, Y_i = |p_i|/e and u = t/e² + 1, the normal is w_i = Y_i/(u + E_i² − 1) up to length, the distance
    e (u − 1)|w|, and u > 0 the root of ‖q(u)‖ = 1, q_i = E_i w_i. The reciprocal norm is concave and nearly linear in u, so
    Newton's method from below converges monotonically (the secular equation of trust-region methods:
    Conn, Gould and Toint, *Trust-Region Methods*, section 7.3). Measuring from the pole, u keeps its relative precision
    near the planes of symmetry, where the nearest point is not unique.
    """
    least = torch.minimum(torch.minimum(size[0], size[1]), size[2])
    ratio = [half / least for half in size]
    offset = [(part - 1.0) * (part + 1.0) for part in ratio]
    scaled = [(part / least).abs().clamp(min=1e-18) for part in point]
    with torch.no_grad():
        bounds = [e * y - f for e, y, f in zip(ratio, scaled, offset, strict=True)]
        u = torch.maximum(torch.maximum(bounds[0], bounds[1]), bounds[2])
        for _ in range(ELLIPSOID_STEPS - 1):
            u = _newton(u, scaled, ratio, offset)
    u = _newton(u, scaled, ratio, offset)  # with derivatives: by the implicit function theorem one step holds them all
    normal = [y / (u + f) for y, f in zip(scaled, offset, strict=True)]
    length = torch.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    x, y, z = (torch.where(part < -tie(), -n, n) / length for part, n in zip(point, normal, strict=True))
    return least * (u - 1.0) * length, (x, y, z)


def _newton(u: Tensor, scaled: list[Tensor], ratio: list[Tensor], offset: list[Tensor]) -> Tensor:
    inverse = [1.0 / (u + f) for f in offset]
    terms = [(e * y * i) ** 2 for e, y, i in zip(ratio, scaled, inverse, strict=True)]
    squared = terms[0] + terms[1] + terms[2]
    slope = terms[0] * inverse[0] + terms[1] * inverse[1] + terms[2] * inverse[2]
    return u + (torch.sqrt(squared) - 1.0) * squared / slope


SHAPES: Mapping[str, Shape] = MappingProxyType(
    {
        "plane": plane,
        "sphere": sphere,
        "capsule": capsule,
        "ellipsoid": ellipsoid,
        "cylinder": cylinder,
        "box": box,
    }
)
"""Signed distance by MuJoCo's name of the geom type."""
KINDS = ("", "plane", "capsule", "cylinder", "box")
"""Numbers by which kernels know the shapes; a sphere is a capsule without a length."""
COLUMNS = POS, ROTATION, BOUND, KIND, ROW = 3, 6, 15, 16, 17
"""Columns of a kernel's table of geoms, which begins with the size: place, rotation, bound and kind; and their number."""
