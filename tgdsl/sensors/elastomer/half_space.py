"""Displacement in an elastic half-space under a load on a small patch of its surface, in closed form.

Source: Johnson, *Contact Mechanics* (1985), equations 3.18 (Boussinesq, normal load) and 3.75 (Cerruti, tangential load), at
depth z. A point load is infinite at its own place, so each load P is spread over a patch that stands for the source's own
area A = π a². Its pressure is that whose Hankel transform is

    φ(k) = (1 + k b + c k² b²) exp(−k b),        b = (c + 1) a,        c = cos 20° − 1/2 = 0.4397

Only one member of this family has the total load, the second moment of a uniform disc of radius a (⟨s²⟩ = a²/2,
so the field away from the patch is the disc's to second order) and the disc's normal and tangential surface displacement at
its own centre (so that a sum over patches that tile a surface gives what a smooth load gives): (2 − 4c)(1 + c)² = 1/2.
Every integral over k is then elementary, finite at z = 0, r = 0, and the field obeys equilibrium exactly, since it is a
superposition of exact point loads. It is within 1 % of the point load's from 6 a on, at any depth up to 2 a.

Shapes: `*point` broadcasts. All lengths in [m].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Plane = Float[np.ndarray, "*#point"]
QUADRATIC = math.cos(math.radians(20.0)) - 0.5
"""c in φ."""


class Profiles(NamedTuple):
    """Displacement per unit force [m/N] at tangential distance r from a load on the surface, below the surface.

    For a load (τ along a unit tangent t, P into the surface) and the unit vector e from the source to the target, the
    displacement into the surface is `normal` P + `lift` τ (e · t), and the tangential one is
    `spread` P e + `along` τ t + `bend` τ (2 (e · t) e − t).
    """

    normal: np.ndarray
    spread: np.ndarray
    lift: np.ndarray
    along: np.ndarray
    bend: np.ndarray


def patch_radius(area: np.ndarray | float) -> np.ndarray:
    """Return the radius a of a disc of some area [m²], in [m]."""
    return np.asarray(np.sqrt(np.asarray(area, dtype=np.float64) / np.pi))


def patch_transform(k: np.ndarray, patch: np.ndarray | float) -> np.ndarray:
    """Return φ at wavenumber k [1/m] for a patch of radius a [m]."""
    x = k * (1.0 + QUADRATIC) * patch
    return (1.0 + x + QUADRATIC * x * x) * np.exp(-x)


def half_space(r: np.ndarray, depth: float, patch: np.ndarray | float, shear_modulus: float, poissons_ratio: float) -> Profiles:
    """Return the profiles of the half-space.

    Args:
        r: Tangential distance from the middle of the load [m].
        depth: Depth z of the target below the surface [m].
        patch: Radius a of the loaded patch [m]; 0 is the point load. Broadcasts with r.
        shear_modulus: G [Pa].
        poissons_ratio: ν [1], up to 1/2.
    """
    a0, a1, b0, b1, c0, c1 = _integrals(r, depth, patch)
    g, nu = 8.0 * np.pi * shear_modulus, poissons_ratio
    return Profiles(
        normal=2.0 * (2.0 * (1.0 - nu) * a0 + depth * a1) / g,
        spread=2.0 * (depth * b1 - (1.0 - 2.0 * nu) * b0) / g,
        lift=2.0 * (depth * b1 + (1.0 - 2.0 * nu) * b0) / g,
        along=((4.0 - 2.0 * nu) * a0 - depth * a1) / g,
        bend=(2.0 * nu * c0 + depth * c1) / g,
    )


def _integrals(r: np.ndarray, depth: float, patch: np.ndarray | float) -> tuple[np.ndarray, ...]:
    """Return ∫ φ(k) k^m exp(−kz) J_n(kr) dk for n = 0, 1, 2 and m = 0, 1 in that order."""
    b = (1.0 + QUADRATIC) * np.asarray(patch, dtype=np.float64)
    z = depth + b
    square = r * r + z * z
    length = np.sqrt(square)
    i3, i5, i7 = length**-3, length**-5, length**-7
    below = length + z
    plain = (
        (1.0 / length, z * i3, 3.0 * z * z * i5 - i3, (15.0 * z * z / square - 9.0) * z * i5),
        (r / (length * below), r * i3, 3.0 * r * z * i5, r * (15.0 * z * z * i7 - 3.0 * i5)),
        (r * r / (length * below**2), r * r * (2.0 * length + z) * i3 / below**2, 3.0 * r * r * i5, 15.0 * r * r * z * i7),
    )
    c = QUADRATIC * b * b
    return tuple(part[m] + b * part[m + 1] + c * part[m + 2] for part in plain for m in (0, 1))
