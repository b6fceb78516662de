"""Contact mechanics: loads on an elastic half-space, against Johnson, *Contact Mechanics* (1985).

z points into the solid; a load is (Qx, Qy, P), P into it. All have the shear modulus `G`.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.integrate import quad
from scipy.special import jv

from oracles.comparison import Values, field
from tgdsl.sensors.elastomer.elastic import Layer, half_space, patch_radius, patch_transform
from tgdsl.sensors.elastomer.operators import Elastic, LinkTaxels

G = 7e4
"""Shear modulus [Pa]."""
NORMAL, TANGENTIAL, OBLIQUE = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.4, 0.8)
"""Loads [N]."""
NUS = (0.0, 0.3, 0.48, 0.5)
"""Poisson's ratios."""
oracle = field("contact mechanics: half-space", "elastomer")
Place = tuple[float, float, float]
Load = tuple[float, float, float]
AXES = ("x", "y", "z")


def displacement(point: np.ndarray | Place, patch: float, nu: float, load: Load) -> np.ndarray:
    """Return tgdsl's displacement (3,) [m] at a point below a load at the origin, spread over a patch's radius [m]."""
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


class PointLoad(NamedTuple):
    name: str
    equation: str
    source: str
    load: Load
    exact: Callable[[Place, float], np.ndarray]


BOUSSINESQ = PointLoad("Boussinesq", "u_z = P/4πG (z²/ρ³ + 2(1−ν)/ρ)", "Johnson 1985, 3.18", NORMAL, boussinesq)
CERRUTI = PointLoad("Cerruti", "u_x = Q/4πG (1/ρ + x²/ρ³ + (1−2ν)(…))", "Johnson 1985, 3.75", TANGENTIAL, cerruti)


@oracle(
    "{law.name}: a point load on a half-space, ν = {nu:g}, z = {z:mm}", "{law.equation}", "{law.source}", "displacement [m]",
    at=AXES, rtol=1e-12,
    each=[(z, nu, law) for law in (BOUSSINESQ, CERRUTI) for z, nu in ((0.0, 0.5), (0.7e-3, 0.3), (3e-3, 0.48))],
    also=product((0.0, 0.7e-3, 3e-3), NUS, (BOUSSINESQ, CERRUTI)),
)  # fmt: skip
def point_load(z: float, nu: float, law: PointLoad):
    point = (1.3e-3, -0.8e-3, z)
    tiny = 1e-12 / (4 * np.pi * G * float(np.linalg.norm(point)))
    return Values(law.exact(point, nu), displacement(point, 0.0, nu, law.load), atol=tiny)


@oracle(
    "Cerruti: shear on the surface falls off as 1/r", "u_x(x, 0, 0) = Q/2πG 1/x", "Johnson 1985, 3.75", "displacement [m]",
    "distance [m]", is_log=True, rtol=1e-12,
)  # fmt: skip
def far_field(nu: float = 0.48):
    x = np.geomspace(1e-3, 60e-3, 40)
    exact = np.array([cerruti((r, 0.0, 0.0), nu)[0] for r in x])
    ours = np.array([displacement((r, 0.0, 0.0), 0.0, nu, TANGENTIAL)[0] for r in x])
    return Values(exact, ours, exact[0] * np.exp(-2000.0 * (x**2 - x[0] ** 2)), at=x)


@oracle(
    "Navier: equilibrium below a patch of {patch:mm}, load {load}", "∇²u + ∇(∇·u)/(1−2ν) = 0",
    "Johnson 1985, 3.1; central differences of steps h", "error at h/2 over the error at h [1]", at=["h = 0.1 mm"], atol=0.03,
    each=[(0.0, OBLIQUE), (1e-3, OBLIQUE)], also=product((0.0, 1e-3), (NORMAL, TANGENTIAL)),
)  # fmt: skip
def equilibrium(patch: float, load: Load, nu: float = 0.3):
    u = partial(displacement, patch=patch, nu=nu, load=load)

    def left_over(h: float) -> float:
        here, steps = np.array([1.9e-3, -1.1e-3, 1.6e-3]), h * np.eye(3)
        laplace = np.sum([u(here + d) - 2 * u(here) + u(here - d) for d in steps], axis=0) / h**2
        gradient = np.array([_divergence(u, here + d, steps) - _divergence(u, here - d, steps) for d in steps]) / (4 * h**2)
        return float(np.abs(laplace + gradient / (1 - 2 * nu)).max() / np.abs(laplace).max())

    fine, coarse = left_over(5e-5), left_over(1e-4)
    return 0.25, fine / coarse if fine < 0.01 else np.nan


def _divergence(u: Callable[[np.ndarray], np.ndarray], x: np.ndarray, steps: np.ndarray) -> float:
    return float(sum((u(x + d) - u(x - d))[i] for i, d in enumerate(steps)))


def _stress(u: Callable[[np.ndarray], np.ndarray], point: np.ndarray, nu: float, step: float) -> np.ndarray:
    """Return the stress [Pa] by central differences."""
    gradient = np.stack([(u(point + step * d) - u(point - step * d)) / (2 * step) for d in np.eye(3)], axis=1)
    strain = 0.5 * (gradient + gradient.T)
    return 2 * G * (strain + nu / (1 - 2 * nu) * np.trace(strain) * np.eye(3))


@oracle(
    "Equilibrium: the stress below carries the load, patch of {patch:mm}", "∫ σ_zz dA = −P, ∫ σ_xz dA = −Q",
    "balance of forces", "force [N]", at=["normal", "tangential"], atol=0.01, each=[1e-3], also=[0.0],
)  # fmt: skip
def carried_load(patch: float, nu: float = 0.3, z: float = 2e-3):
    radii, forces = np.geomspace(1e-5, 0.4, 160), []
    for load, row in ((NORMAL, 2), (TANGENTIAL, 0)):
        mean = []
        for r in radii:
            ring = [np.array([r * np.cos(a), r * np.sin(a), z]) for a in np.pi * np.array([0.1, 0.35, 0.6, 0.85])]
            of = partial(displacement, patch=patch, nu=nu, load=load)
            mean.append(np.mean([_stress(of, p, nu, 1e-3 * float(np.hypot(r, z)))[row, 2] for p in ring]))
        forces.append(np.trapezoid(np.array(mean) * 2 * np.pi * radii**2, np.log(radii)))
    return [-1.0, -1.0], forces


@oracle(
    "Saint-Venant: a patch is a point load from six radii on, ν = {nu:g}, z = {z:mm}", "u → u of a point load",
    "Johnson 1985, 3.18 and 3.75", "displacement over its largest component [1]", atol=0.01, each=[(0.5e-3, 0.48)],
    also=product((0.0, 0.5e-3, 2e-3), NUS),
)  # fmt: skip
def patch_far_off(z: float, nu: float, patch: float = 1e-3):
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
    return Values(exact, ours, at=labels)


@oracle(
    "A loaded disc at its own centre", "u_z = (1−ν)P/πGa, u_x = (2−ν)Q/2πGa", "Johnson 1985, 3.29a and 3.4",
    "displacement of 1 N [m]", at=["normal", "along", "spread", "lift", "bend"], rtol=1e-12,
)  # fmt: skip
def loaded_disc(a: float = 1.3e-3, nu: float = 0.4):
    u = half_space(np.zeros(1), 0.0, a, G, nu)
    exact = [(1 - nu) / (np.pi * G * a), (2 - nu) / (2 * np.pi * G * a), 0.0, 0.0, 0.0]
    return exact, [part[0] for part in (u.normal, u.along, u.spread, u.lift, u.bend)]


@oracle(
    "A patch has a disc's load and second moment", "1 − φ(k) = k²a²/8", "⟨s²⟩ = a²/2 of a uniform disc", "1 − φ [1]",
    "wave number [1/m]", rtol=1e-2, atol=1e-16,
)  # fmt: skip
def patch_moment(a: float = 1.3e-3):
    k = np.array([0.0, 1.0, 2.0])
    return Values(k * k * a * a / 8.0, 1.0 - patch_transform(k, a), at=k)


@oracle(
    "A patch's closed form is its Hankel integral, z = {z:mm}", "u(r) = 1/2π ∫ φ(k) M(k, z) J_n(kr) k dk",
    "Johnson 1985, 3.1, in wave numbers", "displacement of 1 N [m]", at=["normal", "spread", "lift", "along", "bend"],
    rtol=1e-8, each=[0.0, 0.4e-3],
)  # fmt: skip
def hankel(z: float, a: float = 1e-3, nu: float = 0.35, r: float = 2.3e-3):
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
    return exact, [part[0] for part in half_space(np.array([r]), z, a, G, nu)]


def flat_skin(x: np.ndarray, y: np.ndarray, pitch: float) -> LinkTaxels:
    """Return taxels at x, y (taxel,) of a plane, normals +z, each with the area of a pitch squared [m]."""
    count = len(x)
    pos, normal = np.stack([x, y, 0 * x], axis=1), np.tile([0.0, 0, 1], (count, 1))
    return LinkTaxels(pos, normal, np.full(count, pitch**2), np.full((count, 2), -1), np.ones(count, dtype=bool))


@oracle(
    "Hertz: the surface under Hertz's pressure is the ball's", "u_z = δ − r²/2R, δ = a²/R, of p = p₀√(1−r²/a²), p₀ = 2E*a/πR",
    "Johnson 1985, 3.41a and 4.22", "displacement into the skin [m]", "x [m]", rtol=0.02,
)  # fmt: skip
def hertz_surface(num: int = 41, nu: float = 0.45, radius: float = 0.02, a: float = 2e-3):
    # p = p₀ √(1 − r²/a²) with p₀ = 2 E* a/(πR) moves the surface by δ − r²/2R, δ = a²/R.
    line = (np.arange(num) + 0.5) / num * 2.4 * a - 1.2 * a
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    pitch, part = 2.4 * a / num, flat_skin(x, y, 2.4 * a / num)
    stiffness = 2 * G / (1 - nu)  # E/(1 − ν²)
    share = np.maximum(0.0, 1 - (x * x + y * y) / a**2)
    pressure = 2 * stiffness * a / (np.pi * radius) * np.sqrt(share)
    middle = np.flatnonzero((np.abs(y) < 0.5 * pitch) & (np.abs(x) < 0.8 * a))
    sunk, skin = np.zeros(len(middle)), Elastic(Layer(np.inf, 0.0, G, nu))
    for some in np.array_split(np.flatnonzero(pressure > 0), 16):
        sunk += skin.displacement(part, some)[2, 2, middle] @ pressure[some]
    return Values(a**2 / radius - x[middle] ** 2 / (2 * radius), sunk, at=x[middle])


@oracle(
    "Frames of curved skin: the target's own normal and tangents", "u = A (−g_n n + g_s e) of a pressure of 1 Pa",
    "half-space at the distance in the target's tangent plane", "displacement of 1 Pa [m]",
    at=[f"{way} u_{a}" for way in ("pressed", "across", "along") for a in AXES], rtol=1e-12, atol=1e-22, defects=(8,),
)  # fmt: skip
def curved_frames(tilt: float = np.deg2rad(15), area: float = 4e-6, nu: float = 0.3):
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
    return exact, np.concatenate([u @ [0, 0, -1], u @ [0, 1, 0], u @ [1, 0, 0]])
