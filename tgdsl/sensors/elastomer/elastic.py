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

Displacement in an elastic layer that is bonded to a rigid base, under a load on a small patch of its free surface.

By wavenumber k the equations of the layer 0 ≤ z ≤ t (z into it) separate. With u_x = V(z) sin kx, u_z = W(z) cos kx under
the tractions τ sin kx and p cos kx on the free surface, Navier's equations have the four solutions (κ = 3 − 4ν)

    V = (A + B z) e^(−kz),    W = (A + B z + κ B/k) e^(−kz),    and their mirror images in z → t − z, W → −W,

in which ν = 1/2 is no exception, because λ div u = −4 G ν B e^(−kz) stays finite. Two conditions at the surface
(σ_xz = −τ, σ_zz = −p) and two at the base (V = W = 0) give A and B: a 4 × 4 system per wavenumber. The horizontally polarised
part is τ sinh(k(t − z)) / (G k cosh kt). Hankel integrals of order 0, 1 and 2 take both to the plane, the load spread over
the same patch as in `half_space`, whose transform cuts the integrals off; they are tabulated once and interpolated.

Source: Burmister's method for layered elastic systems (1945); see also Johnson, *Contact Mechanics*, section 5.8.

Shapes: `k` wavenumbers, `r` distances.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Plane = Float[np.ndarray, "*#point"]
QUADRATIC = math.cos(math.radians(20.0)) - 0.5  # c in φ


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


NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
CUTOFF = 45.0  # wavenumbers go up to CUTOFF/b, b of the patch: φ there is 1e-16
STEPS_PER_PATCH = 32
"""Distances in the table per b, next to the patch: cubic splines then err by some 1e-6 of the largest value."""
GRADED = 4.0  # distance over b from which steps in the table grow with the distance
DEEP = 40.0
"""kt from which the base is not felt: its part is exp(−2kt), and the response is smooth over wavenumbers far beyond 1/t."""
BATCH = 4_000_000  # Bessel functions that are formed at once


class Layer(NamedTuple):
    """A layer: thickness t [m], depth z of the targets below its surface [m], shear modulus G [Pa], Poisson's ratio ν."""

    thickness: float
    depth: float
    shear_modulus: float
    poissons_ratio: float


class Response(NamedTuple):
    """Displacement per unit traction [m/Pa] at wavenumber k: u_x = V sin kx, u_z = W cos kx, and the transverse one."""

    v_tangential: np.ndarray
    w_tangential: np.ndarray
    v_normal: np.ndarray
    w_normal: np.ndarray
    transverse: np.ndarray


def response(k: np.ndarray, layer: Layer) -> Response:
    """Return the layer's response at depth z to unit tractions at wavenumbers k > 0 [1/m]."""
    t, z, nu = layer.thickness, layer.depth, layer.poissons_ratio
    x, y = k * t, z / t
    kappa, fall = 3.0 - 4.0 * nu, np.exp(-x)
    one, none = np.ones_like(x), np.zeros_like(x)
    # Lengths in units of t, stresses of G. Columns: A, B of the solution that falls from the surface, and of its mirror image.
    system = np.stack(
        [
            np.stack([-2 * x, (1 - kappa) * one, 2 * x * fall, (2 * x - 1 + kappa) * fall], axis=-1),
            np.stack([-2 * x, -4 * (1 - nu) * one, -2 * x * fall, -(2 * x + 4 - 4 * nu) * fall], axis=-1),
            np.stack([fall, fall, one, none], axis=-1),
            np.stack([fall, (1 + kappa / x) * fall, -one, -kappa / x], axis=-1),
        ],
        axis=-2,
    )
    loads = np.zeros((*x.shape, 4, 2))
    loads[..., 0, 0] = loads[..., 1, 1] = -1.0
    a, b, c, d = np.moveaxis(np.linalg.solve(system, loads), -2, 0)
    down, up = np.exp(-x * y)[..., None], np.exp(-x * (1 - y))[..., None]
    over = (kappa / x)[..., None]
    v = (a + b * y) * down + (c + d * (1 - y)) * up
    w = (a + b * (y + over)) * down - (c + d * (1 - y + over)) * up
    unit = t / layer.shear_modulus
    shear = np.exp(-x * y) * -np.expm1(-2 * x * (1 - y)) / (x * (1 + fall * fall))
    return Response(unit * v[..., 0], unit * w[..., 0], unit * v[..., 1], unit * w[..., 1], unit * shear)


def profiles(r: np.ndarray, layer: Layer, patch: float) -> Profiles:
    """Return the layer's profiles at distances r [m] from a patch of radius a [m], by Hankel quadrature."""
    k, weight = _quadrature(float(np.max(r, initial=0.0)), layer, patch)
    layer_response = response(k, layer)
    weight = weight * k * patch_transform(k, patch) / (4.0 * np.pi)
    factors = np.stack(
        [
            2.0 * layer_response.w_normal * weight,
            (layer_response.v_tangential + layer_response.transverse) * weight,
            2.0 * layer_response.v_normal * weight,
            -2.0 * layer_response.w_tangential * weight,
            (layer_response.transverse - layer_response.v_tangential) * weight,
        ],
        axis=1,
    )
    flat = np.reshape(r, -1)
    parts = [_hankel(piece, k, factors) for piece in np.array_split(flat, max(1, -(-flat.size * k.size // BATCH)))]
    normal, along, spread, lift, bend = np.concatenate(parts).T.reshape(5, *np.shape(r))
    return Profiles(normal, spread, lift, along, bend)


def tabulated(r: np.ndarray, layer: Layer, patch: float) -> Profiles:
    """Return `profiles` by cubic splines through a table up to the largest r."""
    from scipy.interpolate import CubicSpline

    b = (1.0 + QUADRATIC) * patch
    last, graded = float(np.max(r, initial=0.0)) + b, GRADED * b
    knots = np.linspace(0.0, min(last, graded), max(8, int(np.ceil(STEPS_PER_PATCH * min(last, graded) / b))) + 1)
    if last > graded:
        num = int(np.ceil(STEPS_PER_PATCH * GRADED * np.log(last / graded)))
        knots = np.concatenate([knots, graded * (last / graded) ** (np.arange(1, num + 1) / num)])
    octaves = np.split(knots, np.searchsorted(knots, graded * 2.0 ** np.arange(max(1, int(np.ceil(np.log2(last / graded)))))))
    table = np.concatenate([np.stack(profiles(octave, layer, patch), axis=1) for octave in octaves])
    return Profiles(*np.moveaxis(CubicSpline(knots, table)(r), -1, 0))


def _quadrature(largest_distance: float, layer: Layer, patch: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes k [1/m] and weights of Gauss' rule on panels that follow both J(kr) and the response."""
    b = (1.0 + QUADRATIC) * patch
    last, reach = CUTOFF / b, max(largest_distance, 4.0 * b)
    deep = min(last, DEEP / layer.thickness)
    low = np.linspace(0.0, deep, int(np.ceil(deep * max(reach, 2.0 * layer.thickness) / np.pi)) + 1)
    edges = np.concatenate([low, np.linspace(deep, last, int(np.ceil((last - deep) * reach / np.pi)) + 1)[1:]])
    half = 0.5 * np.diff(edges)[:, None]
    return (edges[:-1, None] + half * (1.0 + NODES)).reshape(-1), (half * WEIGHTS).reshape(-1)


def _hankel(r: np.ndarray, k: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return the integrals with J0 (two), J1 (two) and J2 (one) at each r."""
    from scipy.special import j0, j1

    x = r[:, None] * k
    zero, one = j0(x), j1(x)
    is_small = x < 1e-3
    two = np.where(is_small, x * x / 8.0, 2.0 * one / np.where(is_small, 1.0, x) - zero)
    return np.concatenate([zero @ factors[:, :2], one @ factors[:, 2:4], two @ factors[:, 4:]], axis=1)
