"""Contact mechanics: loads on an elastic half-space, against Johnson, *Contact Mechanics* (1985).

z points into the solid; a load is (Qx, Qy, P), P into it. The shear modulus of all is `G`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.integrate import quad
from scipy.special import jv

from oracles.results import Comparison, Oracle, along, array, cases
from tgdsl.sensors.elastomer.bonded_layer import Layer
from tgdsl.sensors.elastomer.half_space import half_space, patch_radius, patch_transform
from tgdsl.sensors.elastomer.kernels import Elastic, LinkTaxels

G = 7e4
"""Shear modulus [Pa]."""
NORMAL, TANGENTIAL, OBLIQUE = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.4, 0.8)
"""Loads [N]."""
KINDS = ("elastomer",)
Place = tuple[float, float, float]
Load = tuple[float, float, float]
AXES = ("x", "y", "z")


def displacement(point: np.ndarray | Place, patch: float, nu: float, load: Load) -> np.ndarray:
    """Return this package's displacement (3,) [m] at a place below a load at the origin, spread over a patch's radius [m]."""
    x, y, z = (float(part) for part in point)
    r = np.hypot(x, y)
    e = np.array([x, y]) / r
    normal, spread, lift, along_load, bend = (float(part[0]) for part in half_space(np.array([r]), z, patch, G, nu))
    q, pressed = np.array(load[:2]), load[2]
    tangential = spread * pressed * e + along_load * q + bend * (2 * (q @ e) * e - q)
    return np.array([*tangential, normal * pressed + lift * (q @ e)])


def boussinesq(point: Place, nu: float) -> np.ndarray:
    """Return the displacement (3,) [m] of a normal load of 1 N (Johnson 3.18)."""
    x, y, z = point
    r, rho, c = np.hypot(x, y), np.sqrt(x * x + y * y + z * z), 1 / (4 * np.pi * G)
    u_r = c * (r * z / rho**3 - (1 - 2 * nu) * (rho - z) / (rho * r))
    return np.array([u_r * x / r, u_r * y / r, c * (z * z / rho**3 + 2 * (1 - nu) / rho)])


def cerruti(point: Place, nu: float) -> np.ndarray:
    """Return the displacement (3,) [m] of a load of 1 N along x (Johnson 3.75)."""
    x, y, z = point
    rho, c, k = np.sqrt(x * x + y * y + z * z), 1 / (4 * np.pi * G), 1 - 2 * nu
    return np.array(
        [
            c * (1 / rho + x * x / rho**3 + k * (1 / (rho + z) - x * x / (rho * (rho + z) ** 2))),
            c * (x * y / rho**3 - k * x * y / (rho * (rho + z) ** 2)),
            c * (x * z / rho**3 + k * x / (rho * (rho + z))),
        ]
    )


def gaussian_of_the_paper(distance: np.ndarray, at: float, falloff: float = 2000.0) -> np.ndarray:
    """Return the paper's exp(−λ r²) of shear over distance, scaled to 1 at some distance [m]."""
    return np.exp(-falloff * (distance**2 - at**2))


def point_load(z: float, nu: float, load: Load = NORMAL, at: tuple[float, float] = (1.3e-3, -0.8e-3)) -> Comparison:
    """Return a point load of 1 N, normal or along x, at a depth: all three components."""
    name, source, exact = {
        NORMAL: ("Boussinesq", "Johnson 1985, 3.18", boussinesq),
        TANGENTIAL: ("Cerruti", "Johnson 1985, 3.75", cerruti),
    }[load]
    point = (*at, z)
    tiny = 1e-12 / (4 * np.pi * G * float(np.linalg.norm(point)))
    return Comparison(
        f"{name}: a point load on a half-space, ν = {nu:g}, z = {1e3 * z:g} mm",
        source,
        "u_z = P/4πG (z²/ρ³ + 2(1−ν)/ρ)" if load == NORMAL else "u_x = Q/4πG (1/ρ + x²/ρ³ + (1−2ν)(…))",
        KINDS,
        "displacement",
        "m",
        cases(AXES),
        exact(point, nu),
        displacement(point, 0.0, nu, load),
        rtol=1e-12,
        atol=tiny,
    )


def far_field(nu: float = 0.48) -> Comparison:
    """Return how shear spreads over the surface: 1/r, where the paper takes a Gaussian for all distances."""
    x = np.geomspace(1e-3, 60e-3, 40)
    exact = np.array([cerruti((r, 0.0, 0.0), nu)[0] for r in x])
    ours = np.array([displacement((r, 0.0, 0.0), 0.0, nu, TANGENTIAL)[0] for r in x])
    return Comparison(
        "Cerruti: shear on the surface falls off as 1/r",
        "Johnson 1985, 3.75",
        "u_x(x, 0, 0) = Q/2πG 1/x",
        KINDS,
        "displacement",
        "m",
        along("distance", "m", x, is_log=True),
        exact,
        ours,
        rtol=1e-12,
        paper=exact[0] * gaussian_of_the_paper(x, x[0]),
    )


def equilibrium(patch: float, load: Load, at: Place = (1.9e-3, -1.1e-3, 1.6e-3), nu: float = 0.3) -> Comparison:
    """Return what is left of ∇²u + ∇(∇·u)/(1 − 2ν) by central differences, over a term of it."""

    def u(x: np.ndarray) -> np.ndarray:
        return displacement(x, patch, nu, load)

    def left_over(h: float) -> float:
        here, steps = np.array(at), h * np.eye(3)
        laplace = np.sum([u(here + d) - 2 * u(here) + u(here - d) for d in steps], axis=0) / h**2
        gradient = np.array([_divergence(u, here + d, steps) - _divergence(u, here - d, steps) for d in steps]) / (4 * h**2)
        return float(np.abs(laplace + gradient / (1 - 2 * nu)).max() / np.abs(laplace).max())

    fine, coarse = left_over(5e-5), left_over(1e-4)
    return Comparison(
        f"Navier: equilibrium below a patch of {1e3 * patch:g} mm, load {load}",
        "Johnson 1985, 3.1; central differences of steps h",
        "∇²u + ∇(∇·u)/(1−2ν) = 0",
        KINDS,
        "what is left at h/2 over that at h",
        "1",
        cases(["h = 0.1 mm"]),
        array(0.25),
        array(fine / coarse if fine < 0.01 else np.nan),
        atol=0.03,
    )


def _divergence(u: Callable[[np.ndarray], np.ndarray], x: np.ndarray, steps: np.ndarray) -> float:
    return float(sum((u(x + d) - u(x - d))[i] for i, d in enumerate(steps)))


def _stress(u: Callable[[np.ndarray], np.ndarray], point: np.ndarray, nu: float, step: float) -> np.ndarray:
    """Return the stress [Pa] by central differences."""
    gradient = np.stack([(u(point + step * d) - u(point - step * d)) / (2 * step) for d in np.eye(3)], axis=1)
    strain = 0.5 * (gradient + gradient.T)
    return 2 * G * (strain + nu / (1 - 2 * nu) * np.trace(strain) * np.eye(3))


def carried_load(patch: float, nu: float = 0.3, z: float = 2e-3) -> Comparison:
    """Return the tractions on a plane below a load of 1 N, summed over rings out to 0.4 m."""
    radii = np.geomspace(1e-5, 0.4, 160)
    found = []
    for load, row in ((NORMAL, 2), (TANGENTIAL, 0)):
        mean = []
        for r in radii:
            ring = [np.array([r * np.cos(a), r * np.sin(a), z]) for a in np.pi * np.array([0.1, 0.35, 0.6, 0.85])]
            of = partial(displacement, patch=patch, nu=nu, load=load)
            mean.append(np.mean([_stress(of, p, nu, 1e-3 * float(np.hypot(r, z)))[row, 2] for p in ring]))
        found.append(np.trapezoid(np.array(mean) * 2 * np.pi * radii**2, np.log(radii)))
    return Comparison(
        f"Equilibrium: the stress below carries the load, patch of {1e3 * patch:g} mm",
        "balance of forces",
        "∫ σ_zz dA = −P, ∫ σ_xz dA = −Q",
        KINDS,
        "force",
        "N",
        cases(["normal", "tangential"]),
        array([-1.0, -1.0]),
        array(found),
        atol=0.01,
    )


def patch_far_off(z: float, nu: float, patch: float = 1e-3) -> Comparison:
    """Return a patch's displacement from six of its radii on, against that of a point load, over the largest there."""
    exact, ours = [], []
    radii = (6e-3, 8e-3, 20e-3)
    for r in radii:
        at = (0.8 * r, 0.6 * r, z)
        for load, known in ((NORMAL, boussinesq), (TANGENTIAL, cerruti)):
            point = known(at, nu)
            scale = np.abs(point).max()
            exact += (point / scale).tolist()
            ours += (displacement(at, patch, nu, load) / scale).tolist()
    labels = [f"{1e3 * r:g} mm, {way} u_{a}" for r in radii for way in ("P", "Q") for a in AXES]
    return Comparison(
        f"Saint-Venant: a patch is a point load from six radii on, ν = {nu:g}, z = {1e3 * z:g} mm",
        "Johnson 1985, 3.18 and 3.75",
        "u → u of a point load",
        KINDS,
        "displacement over its largest component",
        "1",
        cases(labels),
        array(exact),
        array(ours),
        atol=0.01,
    )


def loaded_disc(a: float = 1.3e-3, nu: float = 0.4) -> Comparison:
    """Return a patch's displacements at its own centre, over those of a uniformly loaded disc."""
    own = half_space(np.zeros(1), 0.0, a, G, nu)
    found = [float(part[0]) for part in (own.normal, own.along, own.spread, own.lift, own.bend)]
    exact = [(1 - nu) / (np.pi * G * a), (2 - nu) / (2 * np.pi * G * a), 0.0, 0.0, 0.0]
    return Comparison(
        "A loaded disc at its own centre",
        "Johnson 1985, 3.29a and 3.4",
        "u_z = (1−ν)P/πGa, u_x = (2−ν)Q/2πGa",
        KINDS,
        "displacement of 1 N",
        "m",
        cases(["normal", "along", "spread", "lift", "bend"]),
        array(exact),
        array(found),
        rtol=1e-12,
    )


def patch_moment(a: float = 1.3e-3) -> Comparison:
    """Return what a patch's Fourier transform loses at small wave numbers: the disc's second moment."""
    k = np.array([0.0, 1.0, 2.0])
    return Comparison(
        "A patch has a disc's load and second moment",
        "⟨s²⟩ = a²/2 of a uniform disc",
        "1 − φ(k) = k²a²/8",
        KINDS,
        "1 − φ",
        "1",
        along("wave number", "1/m", k),
        k * k * a * a / 8.0,
        1.0 - patch_transform(k, a),
        rtol=1e-2,
        atol=1e-16,
    )


def hankel(z: float, a: float = 1e-3, nu: float = 0.35, r: float = 2.3e-3) -> Comparison:
    """Return all five profiles of a patch against their Hankel integrals, the half-space's response by hand."""
    scale = 1 / (2 * np.pi)

    def integral(order: int, part: Callable[[float], float]) -> float:
        def value(k: float) -> float:
            return part(k) * float(patch_transform(np.array([k]), a)[0]) * np.exp(-k * z) * jv(order, k * r)

        pieces = np.linspace(0.0, 4e4, 41)
        return sum(quad(value, p, q, epsabs=1e-13, epsrel=1e-11)[0] for p, q in pairwise(pieces))

    # k M(k, z) e^{kz}: V, W for p; V, W for τ; transverse
    exact = [
        scale * integral(0, lambda k: (k * z + 2 * (1 - nu)) / (2 * G)),
        scale * integral(1, lambda k: (k * z - (1 - 2 * nu)) / (2 * G)),
        scale * integral(1, lambda k: (k * z + (1 - 2 * nu)) / (2 * G)),
        0.5 * scale * integral(0, lambda k: (2 * (1 - nu) - k * z) / (2 * G) + 1 / G),
        -0.5 * scale * integral(2, lambda k: (2 * (1 - nu) - k * z) / (2 * G) - 1 / G),
    ]
    return Comparison(
        f"A patch's closed form is its Hankel integral, z = {1e3 * z:g} mm",
        "Johnson 1985, 3.1, in wave numbers",
        "u(r) = 1/2π ∫ φ(k) M(k, z) J_n(kr) k dk",
        KINDS,
        "displacement of 1 N",
        "m",
        cases(["normal", "spread", "lift", "along", "bend"]),
        array(exact),
        array([float(part[0]) for part in half_space(np.array([r]), z, a, G, nu)]),
        rtol=1e-8,
    )


def hertz_surface(num: int = 41, nu: float = 0.45, radius: float = 0.02, a: float = 2e-3) -> Comparison:
    """Return the surface under Hertz's pressure on a grid of taxels: the ball's, δ − r²/2R, where they touch.

    p = p₀ √(1 − r²/a²) with p₀ = 2 E* a/(πR) moves the surface by δ − r²/2R, δ = a²/R.
    """
    line = (np.arange(num) + 0.5) / num * 2.4 * a - 1.2 * a
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    pos, count, pitch = np.stack([x, y, 0 * x], axis=1), num * num, 2.4 * a / num
    part = LinkTaxels(
        pos, np.tile([0.0, 0, 1], (count, 1)), np.full(count, pitch**2), np.full((count, 2), -1), np.ones(count, dtype=bool)
    )
    stiffness = 2 * G / (1 - nu)  # E/(1 − ν²)
    share = np.maximum(0.0, 1 - (x * x + y * y) / a**2)
    pressure = 2 * stiffness * a / (np.pi * radius) * np.sqrt(share)
    middle = np.flatnonzero((np.abs(y) < 0.5 * pitch) & (np.abs(x) < 0.8 * a))
    sunk, skin = np.zeros(len(middle)), Elastic(Layer(np.inf, 0.0, G, nu))
    for some in np.array_split(np.flatnonzero(pressure > 0), 16):
        sunk += skin.displacement(part, some)[2, 2, middle] @ pressure[some]
    return Comparison(
        "Hertz: the surface under Hertz's pressure is the ball's",
        "Johnson 1985, 3.41a and 4.22",
        "u_z = δ − r²/2R, δ = a²/R, of p = p₀√(1−r²/a²), p₀ = 2E*a/πR",
        KINDS,
        "displacement into the skin",
        "m",
        along("x", "m", x[middle]),
        a**2 / radius - x[middle] ** 2 / (2 * radius),
        sunk,
        rtol=0.02,
    )


def curved_frames(tilt: float = np.deg2rad(15), area: float = 4e-6, nu: float = 0.3) -> Comparison:
    """Return a loaded taxel seen from another whose normal is tilted: along that one's own normal and tangents."""
    normal = np.array([[0, 0, 1.0], [np.sin(tilt), 0, np.cos(tilt)]])
    between = np.array([4e-3, 0, -5e-4])
    part = LinkTaxels(np.array([[0, 0, 0], between]), normal, np.full(2, area), np.full((2, 2), -1), np.ones(2, dtype=bool))
    u = Elastic(Layer(np.inf, 0.0, G, nu)).displacement(part, np.array([0]))[:, :, 1, 0]
    r = between - (between @ normal[1]) * normal[1]
    tangent = r / np.linalg.norm(r)
    g = half_space(np.array([np.linalg.norm(r)]), 0.0, patch_radius(area), G, nu)
    pulled = tangent[0] * (g.along[0] + g.bend[0]) * tangent - tangent[0] * g.lift[0] * normal[1]
    exact = np.concatenate(
        [
            area * (-g.normal[0] * normal[1] + g.spread[0] * tangent),
            area * (g.along[0] - g.bend[0]) * np.array([0, 1.0, 0]),
            area * pulled,
        ]
    )
    return Comparison(
        "Frames of curved skin: the target's own normal and tangents",
        "half-space at the distance in the target's tangent plane",
        "u = A (−g_n n + g_s e) of a pressure of 1 Pa",
        KINDS,
        "displacement of 1 Pa",
        "m",
        cases([f"{way} u_{a}" for way in ("pressed", "across", "along") for a in AXES]),
        exact,
        np.concatenate([u @ [0, 0, -1], u @ [0, 1, 0], u @ [1, 0, 0]]),
        rtol=1e-12,
        atol=1e-22,
        defects=(8,),
    )


ORACLES: tuple[Oracle, ...] = (
    *(partial(point_load, z, nu, load) for load in (NORMAL, TANGENTIAL) for z, nu in ((0.0, 0.5), (0.7e-3, 0.3), (3e-3, 0.48))),
    far_field,
    *(partial(equilibrium, patch, OBLIQUE) for patch in (0.0, 1e-3)),
    partial(carried_load, 1e-3),
    partial(patch_far_off, 0.5e-3, 0.48),
    loaded_disc,
    patch_moment,
    *(partial(hankel, z) for z in (0.0, 0.4e-3)),
    hertz_surface,
    curved_frames,
)
