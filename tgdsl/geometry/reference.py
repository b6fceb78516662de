"""Signed distance of MuJoCo's primitives in float64, one point at a time: the oracle of `shapes`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tgdsl.geometry.planes import tie

Array = np.ndarray
TIE = tie()  # lengths [m] that differ by no more than this count as equal, and the first among equals wins


def signed_distance(shape: str, size: Float[Array, " 3"], point: Float[Array, " 3"]) -> tuple[float, Float[Array, " 3"]]:
    """Return the signed distance [m] of a point to a primitive, and the outward gradient, both in the geom's frame.

    Found by way of the nearest surface point, which the module's own `shapes` never form. Where that is not unique, the
    convention is: +x at a centre or on an axis; x before y before z among equally near faces, a wall before a cap; the
    positive side on a plane of symmetry; all of this within `TIE` of such a place.
    """
    if shape == "plane":
        return float(point[2]), np.array([0.0, 0.0, 1.0])
    if shape in ("sphere", "capsule"):
        half = size[1] if shape == "capsule" else 0.0
        core = np.array([0.0, 0.0, np.clip(point[2], -half, half)])
        length = float(np.linalg.norm(point - core))
        if length <= TIE:
            return length - size[0], np.array([1.0, 0.0, 0.0])
        return length - size[0], (point - core) / length
    nearest, is_inside, outward = {"box": _box, "cylinder": _cylinder, "ellipsoid": _ellipsoid}[shape](size, point)
    length = float(np.linalg.norm(point - nearest))
    if is_inside or length <= TIE:
        return -length if is_inside else length, outward
    return length, (point - nearest) / length


def _box(size: Array, point: Array) -> tuple[Array, bool, Array]:
    room = size - np.abs(point)
    inside = bool(np.all(room >= 0))
    nearest = np.clip(point, -size, size)
    if inside:
        deepest = int(np.argmin(room))
        nearest[deepest] = np.copysign(size[deepest], point[deepest])
    axis = 0 if room[0] <= room[1:].min() + TIE else 1 if room[1] <= room[2] + TIE else 2
    outward = np.zeros(3)
    outward[axis] = -1.0 if point[axis] < -TIE else 1.0
    return nearest, inside, outward


def _cylinder(size: Array, point: Array) -> tuple[Array, bool, Array]:
    radius, half = size[0], size[1]
    radial = float(np.hypot(point[0], point[1]))
    along = point[:2] / radial if radial > TIE else np.array([1.0, 0.0])
    sign = -1.0 if point[2] < -TIE else 1.0
    to_wall, to_cap = radius - radial, half - abs(point[2])
    outward = np.array([*along, 0.0]) if to_wall <= to_cap + TIE else np.array([0.0, 0.0, sign])
    if to_wall < 0 or to_cap < 0:
        nearest = np.array([*(along * min(radial, radius)), np.clip(point[2], -half, half)])
        return nearest, False, outward
    if to_wall <= to_cap:
        return np.array([*(along * radius), point[2]]), True, outward
    return np.array([point[0], point[1], np.copysign(half, point[2])]), True, outward


def _ellipsoid(size: Array, point: Array) -> tuple[Array, bool, Array]:
    """Nearest point by bracketing u = t + e², t the Lagrange multiplier: X_i = e_i² p_i / (u + e_i² − e²), ‖X/e‖ = 1."""
    square = size**2
    least = int(np.argmin(size))
    sign = np.where(point < -TIE, -1.0, 1.0)
    y = np.abs(point)
    gap = square - square[least]
    terms = [(part, rest) for part, rest in zip((size * y).tolist(), gap.tolist(), strict=True) if part > 0]

    def excess(u: float) -> float:
        return sum((part / (u + rest)) ** 2 for part, rest in terms) - 1.0

    # If no u above the pole 0 solves it, the nearest points are a mirrored pair: take the positive one.
    flat = square > square[least]
    at_pole = np.sum((size[flat] * y[flat] / gap[flat]) ** 2)
    if not np.any(y[square == square[least]] > 0) and at_pole <= 1.0:
        nearest = np.zeros(3)
        nearest[flat] = square[flat] * y[flat] / gap[flat]
        nearest[least] = size[least] * np.sqrt(1.0 - at_pole)
    else:
        from scipy.optimize import brentq

        low, high = max(1e-300, float(np.max(size * y - gap))), float(np.linalg.norm(size * y))
        u = brentq(excess, 0.5 * low, 2.0 * max(low, high), xtol=1e-300, rtol=np.float64(1e-15))
        nearest = square * y / (u + gap)
    inside = bool(np.sum((point / size) ** 2) < 1.0)
    outward = nearest / square
    return sign * nearest, inside, sign * outward / np.linalg.norm(outward)
