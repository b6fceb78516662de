"""Solids as triangles, and closed forms of their modes of vibration, in units of their size, with E = 1 and ρ = 1."""

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from scipy.optimize import brentq
from scipy.special import spherical_jn

from tgdsl.surfaces.surface import Surface


def surface_of(*meshes: trimesh.Trimesh) -> Surface:
    """Return the triangles of meshes: geom `g0` of mesh `mesh0` and so on."""
    parts = [
        Surface(np.array(mesh.vertices), np.array(mesh.faces), np.zeros(len(mesh.faces), int), ((f"g{i}", f"mesh{i}"),))
        for i, mesh in enumerate(meshes)
    ]
    return Surface.joined(parts)


def box(size: Sequence[float], at: Sequence[float] = (0, 0, 0), cuts: int = 0) -> trimesh.Trimesh:
    """Return a box by its full sides [m], its faces subdivided."""
    mesh = trimesh.creation.box(size)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    return mesh.apply_translation(at)


def ball(radius: float, at: Sequence[float] = (0, 0, 0), subdivisions: int = 4) -> trimesh.Trimesh:
    """Return a ball."""
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).apply_translation(at)


def lamb(degree: int, poissons_ratio: float, below: float) -> list[float]:
    """Return ω a/c_s of a ball's spheroidal modes of a degree, n ≥ 1, as roots of Lamb's equation (1882).

    With the potentials j_n(x) and j_n(y), x = ω a/c_p, y = ω a/c_s, the radial and the shear traction on the surface vanish.
    """
    ratio = np.sqrt((1 - 2 * poissons_ratio) / (2 - 2 * poissons_ratio))
    n = degree

    def traction(y):
        x = ratio * y
        p, p_next = spherical_jn(n, x), spherical_jn(n + 1, x)
        s, s_next = spherical_jn(n, y), spherical_jn(n + 1, y)
        radial = (n * n - n - y * y / 2) * p + 2 * x * p_next, n * (n + 1) * ((n - 1) * s - y * s_next)
        shear = (n - 1) * p - x * p_next, (n * n - 1 - y * y / 2) * s + y * s_next
        return radial[0] * shear[1] - radial[1] * shear[0]

    return roots(traction, 0.5, below)


def breathing(poissons_ratio: float, below: float) -> list[float]:
    """Return ω a/c_p of a ball's radial modes: roots of x cot x = 1 − x²/4 κ², κ = c_s/c_p."""
    ratio = (1 - 2 * poissons_ratio) / (2 - 2 * poissons_ratio)
    return roots(lambda x: np.sin(x) * (1 - x * x / (4 * ratio)) - x * np.cos(x), 0.5, below)


def torsion(degree: int, below: float) -> list[float]:
    """Return ω a/c_s of a ball's torsional modes of a degree: roots of (n − 1) j_n(y) = y j_{n+1}(y)."""
    return roots(lambda y: (degree - 1) * spherical_jn(degree, y) - y * spherical_jn(degree + 1, y), 0.5, below)


def roots(function: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> list[float]:
    """Return the zeros of a smooth function of arrays."""
    at = np.linspace(low, high, 500)
    value = function(at)
    return [float(np.asarray(brentq(function, at[i], at[i + 1]))) for i in range(499) if value[i] * value[i + 1] < 0]


def bending(x: np.ndarray | float, number: int) -> np.ndarray:
    """Return the displacement of a free beam of unit length in a mode, from 0, at −0.5 to 0.5 (Bernoulli and Euler); ±2 at ends."""
    beta = roots(lambda b: np.cos(b) - 1 / np.cosh(b), 3.5, 12.0)[number]
    one, other = (np.cos, np.cosh) if number % 2 == 0 else (np.sin, np.sinh)
    at = beta * np.asarray(x)
    return np.asarray(one(at) / one(beta / 2) + other(at) / other(beta / 2))


def timoshenko(length: float, height: float, width: float, poissons_ratio: float, below: float) -> list[float]:
    """Return ω of a free–free beam's bending across its height by Timoshenko's theory, with E = 1 and ρ = 1.

    Both parts of the deflection, cosh or cos of αs and cos of βs for even and sinh, sin for odd modes about the middle, keep
    the ends free of moment and shear. Shear coefficient κ = 10(1 + ν)/(12 + 11ν) (Cowper 1966).
    """
    area, inertia = width * height, width * height**3 / 12
    shear = 10 * (1 + poissons_ratio) / (12 + 11 * poissons_ratio) * area / (2 * (1 + poissons_ratio))

    def ends(omega: float, is_even: bool) -> float:
        # w = e^(ks): EI k⁴ + ρω²(I + EI A/κGA) k² + ρω²(ρω² I/κGA − 1) A = 0 and θ = (k + ρAω²/(κGA k)) w
        first, last = omega**2 * (inertia + inertia * area / shear), omega**2 * (omega**2 * inertia / shear - 1) * area
        squares = np.sort(np.roots([inertia, first, last]).real)[::-1].astype(complex)
        k = np.sqrt(squares)
        slope = k + omega**2 * area / (shear * k)
        half = length / 2
        even, odd = (np.cosh, np.sinh) if is_even else (np.sinh, np.cosh)
        moment, force = slope * k * even(k * half), (slope - k) * odd(k * half)
        determinant = moment[0] * force[1] - moment[1] * force[0]
        return float(determinant.real if is_even else determinant.imag)

    even, odd = (np.vectorize(lambda omega, is_even=is_even: ends(omega, is_even)) for is_even in (True, False))
    return sorted(roots(even, 1e-4, below) + roots(odd, 1e-4, below))


def plate_frequencies(poissons_ratio: float, terms: int = 11) -> np.ndarray:
    """Return ωa²√(ρh/D) of a free square plate by Ritz's method with Legendre polynomials (Kirchhoff's theory), side a = 2."""
    polynomials = [np.polynomial.Legendre.basis(n) for n in range(terms)]
    points, weights = np.polynomial.legendre.leggauss(2 * terms)
    value, first, second = (np.array([p.deriv(k)(points) if k else p(points) for p in polynomials]) for k in (0, 1, 2))

    def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return (one * weights) @ other.T

    mass, slope, curve, cross = product(value, value), product(first, first), product(second, second), product(second, value)
    stiffness = (
        np.kron(curve, mass) + np.kron(mass, curve) + poissons_ratio * (np.kron(cross, cross.T) + np.kron(cross.T, cross))
    )
    stiffness += 2 * (1 - poissons_ratio) * np.kron(slope, slope)
    scale = 1 / np.sqrt(np.diag(np.kron(mass, mass)))
    squares = np.linalg.eigvalsh(stiffness * scale[:, None] * scale)
    return 4 * np.sqrt(squares[3:])
