"""Contact mechanics: an elastic layer bonded to a rigid base, against solutions by wave number and the contact of a ball."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.integrate import solve_bvp

from oracles.half_space import KINDS, G
from oracles.results import Comparison, Oracle, along, array, cases
from tgdsl.sensors.elastomer.bonded_layer import Layer, profiles, response, tabulated
from tgdsl.sensors.elastomer.half_space import half_space
from tgdsl.sensors.elastomer.kernels import Elastic, LinkTaxels

WAVES = np.array([0.02, 0.1, 0.5, 1.0, 2.0, 6.0, 40.0])
"""Wave numbers over the inverse of the thickness."""


def boundary_value(kt: float, nu: float, t: float = 2e-3) -> Comparison:
    """Return the layer's response at one wave number against a collocation solution of Navier's equations."""
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
            found = response(np.array([kt / t]), Layer(t, y * t, G, nu))
            v, w = ((found.v_tangential, found.w_tangential), (found.v_normal, found.w_normal))[j]
            ours += [v[0] * G / t, w[0] * G / t]
            exact += (solved.sol(y)[[0, 2]] if solved.success else np.full(2, np.nan)).tolist()
    return Comparison(
        f"Navier: a bonded layer's response, kt = {kt:g}, ν = {nu:g}",
        "Johnson 1985, 3.1; collocation of the boundary value problem",
        "V'' = k²V + (1+λ)k(kV + W'), (2+λ)W'' = k²W − (1+λ)kV'; V = W = 0 at the base",
        KINDS,
        "displacement over τt/G",
        "1",
        cases([f"{part}({load}), z = {y} t" for load in ("τ", "p") for y in ("0", "0.35") for part in "VW"]),
        array(exact),
        array(ours),
        rtol=1e-6,
        atol=1e-8,
    )


def surface_response(nu: float, t: float = 2e-3) -> Comparison:
    """Return how a layer's surface sinks under a pressure wave, in closed form, ν = 1/2 included."""
    x = WAVES
    normal = ((3 - 4 * nu) * np.sinh(2 * x) - 2 * x) / ((3 - 4 * nu) * np.cosh(2 * x) + 2 * x**2 + 5 - 12 * nu + 8 * nu**2)
    return Comparison(
        f"Burmister: a bonded layer under a pressure wave, ν = {nu:g}",
        "Burmister 1945; Johnson 1985, 5.8",
        "W = (1−ν)/Gk ((3−4ν) sinh 2x − 2x)/((3−4ν) cosh 2x + 2x² + 5 − 12ν + 8ν²), x = kt",
        KINDS,
        "displacement per pressure",
        "m/Pa",
        along("kt", "1", x, is_log=True),
        (1 - nu) * t / (G * x) * normal,
        response(x / t, Layer(t, 0.0, G, nu)).w_normal,
        rtol=1e-9,
    )


def shear_wave(nu: float, t: float = 2e-3) -> Comparison:
    """Return how a layer's surface follows a horizontally polarised shear wave."""
    return Comparison(
        f"A bonded layer under a transverse shear wave, ν = {nu:g}",
        "u'' = k²u, u = 0 at the base",
        "u = τ tanh(kt)/Gk",
        KINDS,
        "displacement per traction",
        "m/Pa",
        along("kt", "1", WAVES, is_log=True),
        t * np.tanh(WAVES) / (G * WAVES),
        response(WAVES / t, Layer(t, 0.0, G, nu)).transverse,
        rtol=1e-13,
    )


def reciprocity(nu: float, t: float = 2e-3) -> Comparison:
    """Return what pressure does along the surface against what shear does across it: Betti's theorem."""
    found = response(WAVES / t, Layer(t, 0.0, G, nu))
    return Comparison(
        f"Betti: pressure and shear of a layer do the same to each other, ν = {nu:g}",
        "Betti's reciprocal theorem",
        "V(p) = W(τ)",
        KINDS,
        "displacement per traction",
        "m/Pa",
        along("kt", "1", WAVES, is_log=True),
        found.w_tangential,
        found.v_normal,
        rtol=1e-8,
        atol=1e-12 * t / G,
    )


def thin_compressible(t: float = 1e-3, nu: float = 0.3, k: float = 1.0) -> Comparison:
    """Return a thin layer's stiffness: a Winkler foundation of the oedometric modulus."""
    modulus = 2 * G * (1 + nu)
    return Comparison(
        "Winkler: a thin compressible layer",
        "Johnson 1985, 5.8; oedometric modulus",
        "u = p t (1+ν)(1−2ν)/((1−ν)E)",
        KINDS,
        "displacement per pressure",
        "m/Pa",
        cases([f"kt = {k * t:g}"]),
        array(t * (1 + nu) * (1 - 2 * nu) / ((1 - nu) * modulus)),
        response(np.array([k]), Layer(t, 0.0, G, nu)).w_normal,
        rtol=1e-5,
    )


def thin_incompressible(t: float = 1e-3, k: float = 30.0) -> Comparison:
    """Return a thin incompressible layer's response by lubrication theory."""
    return Comparison(
        "Lubrication: a thin incompressible layer",
        "Reynolds' equation with a wall at rest and a free one; Chandler and Vella 2020",
        "u = p k² t³/3G",
        KINDS,
        "displacement per pressure",
        "m/Pa",
        cases([f"kt = {k * t:g}"]),
        array(k**2 * t**3 / (3 * G)),
        response(np.array([k]), Layer(t, 0.0, G, 0.5)).w_normal,
        rtol=2e-3,
    )


def _off_half_space(z: float, nu: float, t: float, a: float = 1e-3) -> float:
    """Return how far a layer's five profiles are from the half-space's, over the largest."""
    r = np.linspace(0.0, 0.02, 21)
    found, limit = profiles(r, Layer(t, z, G, nu), a), half_space(r, z, a, G, nu)
    scale = float(limit.normal.max())
    return max(float(np.abs(p - q).max()) for p, q in zip(found, limit, strict=True)) / scale


def thick(z: float, nu: float) -> Comparison:
    """Return how a layer of 0.5 m approaches the half-space, all five profiles."""
    return Comparison(
        f"A thick layer is the half-space, ν = {nu:g}, z = {1e3 * z:g} mm",
        "Johnson 1985, 3.18 and 3.75",
        "u of t = 0.5 m → u of t = ∞",
        KINDS,
        "largest difference of profiles over their scale",
        "1",
        cases(["t = 0.5 m"]),
        array(0.0),
        array(_off_half_space(z, nu, 0.5)),
        atol=0.005,
    )


def thick_order(z: float, nu: float) -> Comparison:
    """Return how the difference from the half-space falls with thickness: the base, t away, holds back what is O(1/t)."""
    return Comparison(
        f"A layer approaches the half-space as 1/t, ν = {nu:g}, z = {1e3 * z:g} mm",
        "displacement of a point load at the distance t",
        "|u_t − u_∞| ∝ 1/t",
        KINDS,
        "difference at t = 0.25 m over that at 0.5 m",
        "1",
        cases(["0.25/0.5 m"]),
        array(2.0),
        array(_off_half_space(z, nu, 0.25) / _off_half_space(z, nu, 0.5)),
        rtol=0.1,
    )


def table() -> Comparison:
    """Return tabulated profiles against their integrals, the largest error of each over its largest value."""
    r, layer = np.random.default_rng(0).uniform(0, 0.03, 300), Layer(2e-3, 0.3e-3, G, 0.49)
    pairs = zip(tabulated(r, layer, 1e-3), profiles(r, layer, 1e-3), strict=True)
    return Comparison(
        "The table of a layer's profiles is the integrals",
        "Hankel integrals by quadrature",
        "spline(r) = ∫ φ M J_n k dk",
        KINDS,
        "error over the largest value",
        "1",
        cases(["normal", "spread", "lift", "along", "bend"]),
        np.zeros(5),
        array([np.abs(found - exact).max() / np.abs(exact).max() for found, exact in pairs]),
        atol=3e-6,
    )


def bonded_base() -> Comparison:
    """Return the profiles at the base, over the largest at the surface: it does not move."""
    r = np.linspace(0.0, 0.03, 31)
    base, top = (profiles(r, Layer(2e-3, z, G, 0.5), 1e-3) for z in (2e-3, 0.0))
    return Comparison(
        "A bonded layer does not move at its base",
        "boundary condition",
        "u(z = t) = 0",
        KINDS,
        "displacement over the surface's",
        "1",
        cases(["normal", "spread", "lift", "along", "bend"]),
        np.zeros(5),
        array([np.abs(part).max() for part in base]) / float(top.normal.max()),
        atol=1e-10,
    )


def no_volume() -> Comparison:
    """Return the volume that an incompressible layer's surface displaces, over that of the moduli: what sinks in comes up."""
    r = np.linspace(0.0, 0.03, 3001)
    normal = profiles(r, Layer(2e-3, 0.0, G, 0.5), 1e-3).normal
    return Comparison(
        "An incompressible layer keeps its volume",
        "div u = 0",
        "∫ u_z 2πr dr = 0 for ν = 1/2",
        KINDS,
        "volume over ∫ |u_z| 2πr dr",
        "1",
        cases(["ν = 1/2"]),
        array(0.0),
        array(np.trapezoid(normal * r, r) / np.trapezoid(np.abs(normal) * r, r)),
        atol=1e-4,
    )


def _pressed_ball(depth: float, radius: float, layer: Layer, num: int) -> float:
    """Return the force [N] of a ball on a skin of taxels: pressures that move it to the ball's shape, none of which pulls."""
    reach = 1.45 * np.sqrt(radius * depth)
    pitch = 2 * reach / num
    line = (np.arange(num) + 0.5) * pitch - reach
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    sunk = depth - (x * x + y * y) / (2 * radius)
    held = np.flatnonzero(sunk > 0)
    part = LinkTaxels(
        np.stack([x, y, 0 * x], axis=1)[held],
        np.tile([0.0, 0, 1], (len(held), 1)),
        np.full(len(held), pitch**2),
        np.full((len(held), 2), -1),
        np.ones(len(held), dtype=bool),
    )
    matrix = Elastic(layer).displacement(part, np.arange(len(held)))[2, 2]
    inside, pressure = np.arange(len(held)), np.zeros(len(held))
    while True:
        pressure[:] = 0
        pressure[inside] = np.linalg.solve(matrix[np.ix_(inside, inside)], sunk[held][inside])
        if (pressure[inside] >= 0).all():
            return float(pressure.sum() * pitch**2)
        inside = inside[pressure[inside] > 0]


def hertz_force(num: int = 21, nu: float = 0.45, radius: float = 0.02) -> Comparison:
    """Return the force of a ball pressed into a half-space, by the pressures of taxels that fit its shape."""
    depths = np.array([0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3])
    modulus = 2 * G * (1 + nu)
    return Comparison(
        "Hertz: a ball on an elastic half-space",
        "Johnson 1985, 4.23",
        "F = 4/3 E/(1−ν²) √R δ^1.5",
        KINDS,
        "force",
        "N",
        along("depth", "m", depths, is_log=True),
        4 / 3 * modulus / (1 - nu**2) * np.sqrt(radius) * depths**1.5,
        array([_pressed_ball(d, radius, Layer(np.inf, 0.0, G, nu), num) for d in depths]),
        rtol=0.02,
    )


def thin_layer_force(num: int = 21, radius: float = 0.02, t: float = 4e-3) -> Comparison:
    """Return the force of a ball on an incompressible bonded layer against the series of Garcia and Garcia (2018).

    Its term of χ² follows by hand: a layer takes a constant c P/t off the displacement of a half-space near the load, so
    f = (1 + (2/3) 1.133 χ f)^1.5 of f = F/F_Hertz, which gives 1.498 χ². The earlier series of Dimitriadis and others (2002)
    has the square of the first coefficient there, 1.283, and is 8 % below at χ = 0.5.
    """
    depths = np.array([0.0125e-3, 0.025e-3, 0.05e-3, 0.1e-3, 0.2e-3])
    chi, modulus = np.sqrt(radius * depths) / t, 3 * G
    series = 1 + 1.133 * chi + 1.497 * chi**2 + 1.469 * chi**3 + 0.755 * chi**4
    return Comparison(
        "A ball on an incompressible bonded layer",
        "Garcia and Garcia 2018, Biophys. J. 114:2923; the term of χ² by hand",
        "F = 16/9 E √R δ^1.5 (1 + 1.133χ + 1.497χ² + 1.469χ³ + 0.755χ⁴), χ = √(Rδ)/t",
        KINDS,
        "force",
        "N",
        along("depth", "m", depths, is_log=True),
        16 / 9 * modulus * np.sqrt(radius) * depths**1.5 * series,
        array([_pressed_ball(d, radius, Layer(t, 0.0, G, 0.5), num) for d in depths]),
        rtol=0.03,
    )


ORACLES: tuple[Oracle, ...] = (
    partial(boundary_value, 1.0, 0.3),
    partial(boundary_value, 3.0, 0.45),
    *(partial(surface_response, nu) for nu in (0.0, 0.48, 0.5)),
    partial(shear_wave, 0.48),
    partial(reciprocity, 0.3),
    thin_compressible,
    thin_incompressible,
    partial(thick, 1e-3, 0.5),
    partial(thick_order, 1e-3, 0.5),
    table,
    bonded_base,
    no_volume,
    hertz_force,
    thin_layer_force,
)
