"""Contact mechanics: an elastic layer bonded to a rigid base, against solutions by wave number and the contact of a ball."""

from itertools import product

import numpy as np
from scipy.integrate import solve_bvp

from oracles.comparison import Values, field
from oracles.half_space import NUS, G, flat_skin
from tgdsl.sensors.elastomer.elastic import Layer, half_space, profiles, response, tabulated
from tgdsl.sensors.elastomer.operators import Elastic

oracle = field("contact mechanics: bonded layer", "elastomer")
WAVES = np.array([0.02, 0.1, 0.5, 1.0, 2.0, 6.0, 40.0])
"""Wave numbers over the inverse of the thickness."""


@oracle(
    "Navier: a bonded layer's response, kt = {kt:g}, ν = {nu:g}",
    "V'' = k²V + (1+λ)k(kV + W'), (2+λ)W'' = k²W − (1+λ)kV'; V = W = 0 at the base",
    "Johnson 1985, 3.1; collocation of the boundary value problem", "displacement over τt/G [1]",
    at=[f"{part}({load}), z = {y} t" for load in ("τ", "p") for y in ("0", "0.35") for part in "VW"], rtol=1e-6, atol=1e-8,
    each=[(1.0, 0.3), (3.0, 0.45)], also=product((0.3, 1.0, 3.0), (0.0, 0.3, 0.45)),
)  # fmt: skip
def boundary_value(kt: float, nu: float, t: float = 2e-3):
    lam, exact, ours = 2 * nu / (1 - 2 * nu), [], []

    def navier(_: np.ndarray, y: np.ndarray) -> np.ndarray:
        v, dv, w, dw = y
        ddv = kt**2 * v + (1 + lam) * kt * (kt * v + dw)
        ddw = (kt**2 * w - (1 + lam) * kt * dv) / (2 + lam)
        return np.stack([dv, ddv, dw, ddw])

    for j, (tau, p) in enumerate([(1.0, 0.0), (0.0, 1.0)]):

        def conditions(top: np.ndarray, base: np.ndarray, tau: float = tau, p: float = p) -> np.ndarray:
            surface = (top[1] - kt * top[2] + tau, lam * (kt * top[0] + top[3]) + 2 * top[3] + p)
            return np.array([*surface, base[0], base[2]])

        solved = solve_bvp(navier, conditions, np.linspace(0, 1, 30), np.zeros((4, 30)), tol=1e-9, max_nodes=20000)
        for y in (0.0, 0.35):
            u = response(np.array([kt / t]), Layer(t, y * t, G, nu))
            v, w = ((u.v_tangential, u.w_tangential), (u.v_normal, u.w_normal))[j]
            ours += [v[0] * G / t, w[0] * G / t]
            exact += (solved.sol(y)[[0, 2]] if solved.success else np.full(2, np.nan)).tolist()
    return exact, ours


@oracle(
    "Burmister: a bonded layer under a pressure wave, ν = {nu:g}",
    "W = (1−ν)/Gk ((3−4ν) sinh 2x − 2x)/((3−4ν) cosh 2x + 2x² + 5 − 12ν + 8ν²), x = kt", "Burmister 1945; Johnson 1985, 5.8",
    "displacement per pressure [m/Pa]", "kt [1]", at=WAVES, is_log=True, rtol=1e-9, each=[0.0, 0.48, 0.5], also=[0.3],
)  # fmt: skip
def surface_response(nu: float, t: float = 2e-3):
    x = WAVES
    normal = ((3 - 4 * nu) * np.sinh(2 * x) - 2 * x) / ((3 - 4 * nu) * np.cosh(2 * x) + 2 * x**2 + 5 - 12 * nu + 8 * nu**2)
    return (1 - nu) * t / (G * x) * normal, response(x / t, Layer(t, 0.0, G, nu)).w_normal


@oracle(
    "A bonded layer under a transverse shear wave, ν = {nu:g}", "u = τ tanh(kt)/Gk", "u'' = k²u, u = 0 at the base",
    "displacement per traction [m/Pa]", "kt [1]", at=WAVES, is_log=True, rtol=1e-13, each=[0.48], also=NUS,
)  # fmt: skip
def shear_wave(nu: float, t: float = 2e-3):
    return t * np.tanh(WAVES) / (G * WAVES), response(WAVES / t, Layer(t, 0.0, G, nu)).transverse


@oracle(
    "Betti: pressure and shear of a layer do the same to each other, ν = {nu:g}", "V(p) = W(τ)", "Betti's reciprocal theorem",
    "displacement per traction [m/Pa]", "kt [1]", at=WAVES, is_log=True, rtol=1e-8, each=[0.3], also=NUS,
)  # fmt: skip
def reciprocity(nu: float, t: float = 2e-3):
    u = response(WAVES / t, Layer(t, 0.0, G, nu))
    return Values(u.w_tangential, u.v_normal, atol=1e-12 * t / G)


@oracle(
    "Winkler: a thin compressible layer", "u = p t (1+ν)(1−2ν)/((1−ν)E)", "Johnson 1985, 5.8; oedometric modulus",
    "displacement per pressure [m/Pa]", at=["kt = 0.001"], rtol=1e-5,
)  # fmt: skip
def thin_compressible(t: float = 1e-3, nu: float = 0.3, k: float = 1.0):
    modulus = 2 * G * (1 + nu)
    return t * (1 + nu) * (1 - 2 * nu) / ((1 - nu) * modulus), response(np.array([k]), Layer(t, 0.0, G, nu)).w_normal


@oracle(
    "Lubrication: a thin incompressible layer", "u = p k² t³/3G",
    "Reynolds' equation with a wall at rest and a free one; Chandler and Vella 2020", "displacement per pressure [m/Pa]",
    at=["kt = 0.03"], rtol=2e-3,
)  # fmt: skip
def thin_incompressible(t: float = 1e-3, k: float = 30.0):
    return k**2 * t**3 / (3 * G), response(np.array([k]), Layer(t, 0.0, G, 0.5)).w_normal


def _off_half_space(z: float, nu: float, t: float, a: float = 1e-3) -> float:
    """Return the deviation of a layer's five profiles from the half-space's, over the largest value."""
    r = np.linspace(0.0, 0.02, 21)
    layer, limit = profiles(r, Layer(t, z, G, nu), a), half_space(r, z, a, G, nu)
    return max(float(np.abs(p - q).max()) for p, q in zip(layer, limit, strict=True)) / float(limit.normal.max())


@oracle(
    "A thick layer is the half-space, ν = {nu:g}, z = {z:mm}", "u of t = 0.5 m → u of t = ∞", "Johnson 1985, 3.18 and 3.75",
    "largest difference of profiles over their scale [1]", at=["t = 0.5 m"], atol=0.005, each=[(1e-3, 0.5)],
    also=product((0.0, 1e-3), (0.3, 0.5)),
)  # fmt: skip
def thick(z: float, nu: float):
    return 0.0, _off_half_space(z, nu, 0.5)


@oracle(
    "A layer approaches the half-space as 1/t, ν = {nu:g}, z = {z:mm}", "|u_t − u_∞| ∝ 1/t",
    "displacement of a point load at the distance t", "difference at t = 0.25 m over that at 0.5 m [1]", at=["0.25/0.5 m"],
    rtol=0.1, each=[(1e-3, 0.5)], also=product((0.0, 1e-3), (0.3, 0.5)),
)  # fmt: skip
def thick_order(z: float, nu: float):
    return 2.0, _off_half_space(z, nu, 0.25) / _off_half_space(z, nu, 0.5)


@oracle(
    "The table of a layer's profiles is the integrals", "spline(r) = ∫ φ M J_n k dk", "Hankel integrals by quadrature",
    "error over the largest value [1]", at=["normal", "spread", "lift", "along", "bend"], atol=3e-6,
)  # fmt: skip
def table():
    r, layer = np.random.default_rng(0).uniform(0, 0.03, 300), Layer(2e-3, 0.3e-3, G, 0.49)
    pairs = zip(tabulated(r, layer, 1e-3), profiles(r, layer, 1e-3), strict=True)
    return 0.0, [np.abs(ours - exact).max() / np.abs(exact).max() for ours, exact in pairs]


@oracle(
    "A bonded layer does not move at its base", "u(z = t) = 0", "boundary condition", "displacement over the surface's [1]",
    at=["normal", "spread", "lift", "along", "bend"], atol=1e-10,
)  # fmt: skip
def bonded_base():
    r = np.linspace(0.0, 0.03, 31)
    base, top = (profiles(r, Layer(2e-3, z, G, 0.5), 1e-3) for z in (2e-3, 0.0))
    return 0.0, np.array([np.abs(part).max() for part in base]) / float(top.normal.max())


@oracle(
    "An incompressible layer keeps its volume", "∫ u_z 2πr dr = 0 for ν = 1/2", "div u = 0", "volume over ∫ |u_z| 2πr dr [1]",
    at=["ν = 1/2"], atol=1e-4,
)  # fmt: skip
def no_volume():
    r = np.linspace(0.0, 0.03, 3001)
    normal = profiles(r, Layer(2e-3, 0.0, G, 0.5), 1e-3).normal
    return 0.0, np.trapezoid(normal * r, r) / np.trapezoid(np.abs(normal) * r, r)


def _pressed_ball(depth: float, radius: float, layer: Layer, num: int) -> float:
    """Return the force [N] of a ball on a skin of taxels: nonnegative pressures that move it to the ball's shape."""
    reach = 1.45 * np.sqrt(radius * depth)
    pitch = 2 * reach / num
    line = (np.arange(num) + 0.5) * pitch - reach
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    sunk = depth - (x * x + y * y) / (2 * radius)
    x, y, sunk = (part[sunk > 0] for part in (x, y, sunk))
    inside, pressure = np.arange(len(x)), np.zeros(len(x))
    matrix = Elastic(layer).displacement(flat_skin(x, y, pitch), inside)[2, 2]
    while True:
        pressure[:] = 0
        pressure[inside] = np.linalg.solve(matrix[np.ix_(inside, inside)], sunk[inside])
        if (pressure[inside] >= 0).all():
            return float(pressure.sum() * pitch**2)
        inside = inside[pressure[inside] > 0]


@oracle(
    "Hertz: a ball on an elastic half-space", "F = 4/3 E/(1−ν²) √R δ^1.5", "Johnson 1985, 4.23", "force [N]", "depth [m]",
    is_log=True, rtol=0.02,
)  # fmt: skip
def hertz_force(num: int = 21, nu: float = 0.45, radius: float = 0.02):
    depths = np.array([0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3])
    modulus = 2 * G * (1 + nu)
    exact = 4 / 3 * modulus / (1 - nu**2) * np.sqrt(radius) * depths**1.5
    return Values(exact, [_pressed_ball(d, radius, Layer(np.inf, 0.0, G, nu), num) for d in depths], at=depths)


@oracle(
    "A ball on an incompressible bonded layer", "F = 16/9 E √R δ^1.5 (1 + 1.133χ + 1.497χ² + 1.469χ³ + 0.755χ⁴), χ = √(Rδ)/t",
    "Garcia and Garcia 2018, Biophys. J. 114:2923; the term of χ² by hand", "force [N]", "depth [m]", is_log=True, rtol=0.03,
)  # fmt: skip
def thin_layer_force(num: int = 21, radius: float = 0.02, t: float = 4e-3):
    # Its term of χ² follows by hand: a layer takes a constant c P/t off the displacement of a half-space near the load, so
    # f = (1 + (2/3) 1.133 χ f)^1.5 of f = F/F_Hertz, which gives 1.498 χ². The earlier series of Dimitriadis and others (2002)
    # has the square of the first coefficient there, 1.283, and is 8 % below at χ = 0.5.
    depths = np.array([0.0125e-3, 0.025e-3, 0.05e-3, 0.1e-3, 0.2e-3])
    chi, modulus = np.sqrt(radius * depths) / t, 3 * G
    series = 1 + 1.133 * chi + 1.497 * chi**2 + 1.469 * chi**3 + 0.755 * chi**4
    exact = 16 / 9 * modulus * np.sqrt(radius) * depths**1.5 * series
    return Values(exact, [_pressed_ball(d, radius, Layer(t, 0.0, G, 0.5), num) for d in depths], at=depths)
