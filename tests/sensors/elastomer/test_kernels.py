"""Closed forms, equilibrium and independent solutions of the elastomer's kernels."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_bvp
from scipy.special import jv

from tgdsl.sensors.elastomer import ElastomerSpec
from tgdsl.sensors.elastomer.blocks import responses
from tgdsl.sensors.elastomer.bonded_layer import Layer, profiles, response, tabulated
from tgdsl.sensors.elastomer.half_space import half_space, patch_radius, patch_transform
from tgdsl.sensors.elastomer.kernels import Elastic, Gaussian, LinkTaxels, offset

G = 7e4
NUS = [0.0, 0.3, 0.48, 0.5]


def field(point, patch, nu, load, find=None):
    """Displacement, z into the solid, at (x, y, z) below a load (Qx, Qy, P) at the origin."""
    x, y, z = point
    r = np.hypot(x, y)
    e = np.array([x, y]) / r
    g = half_space(np.array([r]), z, patch, G, nu) if find is None else find(np.array([r]), z)
    q, pressed = np.array(load[:2]), load[2]
    normal, spread, lift, along, bend = (float(part[0]) for part in g)
    tangential = spread * pressed * e + along * q + bend * (2 * (q @ e) * e - q)
    return np.array([*tangential, normal * pressed + lift * (q @ e)])


def stress(u, point, nu, step=1e-5):
    """Stress [Pa] by central differences."""
    gradient = np.stack([(u(point + step * d) - u(point - step * d)) / (2 * step) for d in np.eye(3)], axis=1)
    strain = 0.5 * (gradient + gradient.T)
    return 2 * G * (strain + nu / (1 - 2 * nu) * np.trace(strain) * np.eye(3))


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("z", [0.0, 0.7e-3, 3e-3])
def test_a_point_load_is_johnsons(z, nu):
    """Boussinesq (3.18) and Cerruti (3.75) as they are printed, in x, y, z."""
    x, y = 1.3e-3, -0.8e-3
    r, rho, c = np.hypot(x, y), np.sqrt(x * x + y * y + z * z), 1 / (4 * np.pi * G)
    u_r = c * (r * z / rho**3 - (1 - 2 * nu) * (rho - z) / (rho * r))
    pressed = [u_r * x / r, u_r * y / r, c * (z * z / rho**3 + 2 * (1 - nu) / rho)]
    k = 1 - 2 * nu
    pulled = [
        c * (1 / rho + x * x / rho**3 + k * (1 / (rho + z) - x * x / (rho * (rho + z) ** 2))),
        c * (x * y / rho**3 - k * x * y / (rho * (rho + z) ** 2)),
        c * (x * z / rho**3 + k * x / (rho * (rho + z))),
    ]
    np.testing.assert_allclose(field((x, y, z), 0.0, nu, (0, 0, 1)), pressed, rtol=1e-12, atol=1e-12 * c / rho)
    np.testing.assert_allclose(field((x, y, z), 0.0, nu, (1, 0, 0)), pulled, rtol=1e-12, atol=1e-12 * c / rho)


@pytest.mark.parametrize("load", [(0, 0, 1), (1, 0, 0), (0.3, -0.4, 0.8)])
@pytest.mark.parametrize("patch", [0.0, 1e-3])
def test_the_half_space_is_in_equilibrium(patch, load):
    """∇²u + ∇(∇·u)/(1 − 2ν) = 0: what central differences leave is below 1 % of a term, and a quarter at half the step."""
    nu, at = 0.3, np.array([1.9e-3, -1.1e-3, 1.6e-3])

    def u(x):
        return field(x, patch, nu, load)

    def divergence(x, steps):
        return sum((u(x + d) - u(x - d))[i] for i, d in enumerate(steps))

    def left_over(h):
        steps = h * np.eye(3)
        laplace = sum(u(at + d) - 2 * u(at) + u(at - d) for d in steps) / h**2
        gradient = np.array([divergence(at + d, steps) - divergence(at - d, steps) for d in steps]) / (4 * h**2)
        return np.abs(laplace + gradient / (1 - 2 * nu)).max() / np.abs(laplace).max()

    assert left_over(5e-5) < 0.01
    assert left_over(5e-5) / left_over(1e-4) == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize("patch", [0.0, 1e-3])
def test_the_stress_below_carries_the_load(patch):
    """Tractions on a plane below, summed over rings out to 0.4 m, are the load: σ_zz = −P, σ_xz = −Q."""
    nu, z = 0.3, 2e-3
    radii = np.geomspace(1e-5, 0.4, 160)
    normal, tangential = [], []
    for r in radii:
        ring = [np.array([r * np.cos(a), r * np.sin(a), z]) for a in np.pi * np.array([0.1, 0.35, 0.6, 0.85])]
        step = 1e-3 * np.hypot(r, z)
        normal.append(np.mean([stress(lambda x: field(x, patch, nu, (0, 0, 1)), p, nu, step)[2, 2] for p in ring]))
        tangential.append(np.mean([stress(lambda x: field(x, patch, nu, (1, 0, 0)), p, nu, step)[0, 2] for p in ring]))
    for found in (normal, tangential):
        total = np.trapezoid(np.array(found) * 2 * np.pi * radii**2, np.log(radii))
        assert total == pytest.approx(-1.0, abs=0.01)


@pytest.mark.parametrize("nu", NUS)
@pytest.mark.parametrize("z", [0.0, 0.5e-3, 2e-3])
def test_a_patch_is_a_point_load_from_six_radii_on(z, nu):
    """To 1 % of the largest displacement there."""
    for r in (6e-3, 8e-3, 20e-3):
        at = (0.8 * r, 0.6 * r, z)
        for load in ((0, 0, 1), (1, 0, 0)):
            point, patch = field(at, 0.0, nu, load), field(at, 1e-3, nu, load)
            assert np.abs(patch - point).max() < 0.01 * np.abs(point).max()


def test_a_patch_has_the_discs_load_second_moment_and_own_displacement():
    """φ = 1 − ⟨s²⟩ k²/4 with ⟨s²⟩ = a²/2; at the centre of a uniformly loaded disc u_z = (1 − ν) P/(π G a) [J 3.29a]."""
    a = 1.3e-3
    k = np.array([0.0, 1.0, 2.0])
    lost = 1.0 - patch_transform(k, a)  # an odd term, k³ a³/3, is the patch's tail
    np.testing.assert_allclose(lost, k * k * a * a / 8.0, rtol=1e-2, atol=1e-16)
    own = half_space(np.zeros(1), 0.0, a, G, 0.4)
    assert own.normal[0] == pytest.approx((1 - 0.4) / (np.pi * G * a), rel=1e-12)
    assert own.along[0] == pytest.approx((2 - 0.4) / (2 * np.pi * G * a), rel=1e-12)
    assert own.spread[0] == own.lift[0] == own.bend[0] == 0.0


@pytest.mark.parametrize("z", [0.0, 0.4e-3])
def test_the_patchs_closed_form_is_its_hankel_integral(z):
    """∫ φ(k) M(k, z) J_n(kr) k dk, M by hand for the half-space, against `half_space`: all five profiles."""
    a, nu, r = 1e-3, 0.35, 2.3e-3
    scale = 1 / (2 * np.pi)

    def integral(order, part):
        def value(k):
            return part(k) * float(patch_transform(np.array([k]), a)[0]) * np.exp(-k * z) * jv(order, k * r)

        pieces = np.linspace(0.0, 4e4, 41)
        return sum(quad(value, p, q, epsabs=1e-13, epsrel=1e-11)[0] for p, q in pairwise(pieces))

    # k M(k, z) e^{kz}: V, W for p; V, W for τ; transverse
    found = half_space(np.array([r]), z, a, G, nu)
    expected = [
        scale * integral(0, lambda k: (k * z + 2 * (1 - nu)) / (2 * G)),
        scale * integral(1, lambda k: (k * z - (1 - 2 * nu)) / (2 * G)),
        scale * integral(1, lambda k: (k * z + (1 - 2 * nu)) / (2 * G)),
        0.5 * scale * integral(0, lambda k: (2 * (1 - nu) - k * z) / (2 * G) + 1 / G),
        -0.5 * scale * integral(2, lambda k: (2 * (1 - nu) - k * z) / (2 * G) - 1 / G),
    ]
    np.testing.assert_allclose([float(part[0]) for part in found], expected, rtol=1e-8)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("kt", [0.3, 1.0, 3.0])
def test_the_layers_response_solves_naviers_equations(nu, kt):
    """Against a collocation solution of the boundary value problem, at the surface and inside."""
    t = 2e-3
    lam, unit = 2 * nu / (1 - 2 * nu), t / G

    def navier(_, y):
        v, dv, w, dw = y
        ddv = kt**2 * v + (1 + lam) * kt * (kt * v + dw)
        ddw = (kt**2 * w - (1 + lam) * kt * dv) / (2 + lam)
        return np.stack([dv, ddv, dw, ddw])

    for j, (tau, p) in enumerate([(1.0, 0.0), (0.0, 1.0)]):

        def conditions(top, base, tau=tau, p=p):
            surface = (top[1] - kt * top[2] + tau, lam * (kt * top[0] + top[3]) + 2 * top[3] + p)
            return np.array([*surface, base[0], base[2]])

        solved = solve_bvp(navier, conditions, np.linspace(0, 1, 30), np.zeros((4, 30)), tol=1e-9, max_nodes=20000)
        assert solved.success
        for y in (0.0, 0.35):
            found = response(np.array([kt / t]), Layer(t, y * t, G, nu))
            v, w = ((found.v_tangential, found.w_tangential), (found.v_normal, found.w_normal))[j]
            np.testing.assert_allclose([v[0], w[0]], unit * solved.sol(y)[[0, 2]], rtol=1e-6, atol=1e-8 * unit)


@pytest.mark.parametrize("nu", NUS)
def test_the_layers_surface_response_in_closed_form(nu):
    """W(p) of a bonded layer, and tanh(kt)/(Gk) across; also for ν = 1/2. Reciprocity: V(p) = W(τ)."""
    t, x = 2e-3, np.array([0.02, 0.1, 0.5, 1.0, 2.0, 6.0, 40.0])
    found = response(x / t, Layer(t, 0.0, G, nu))
    normal = ((3 - 4 * nu) * np.sinh(2 * x) - 2 * x) / ((3 - 4 * nu) * np.cosh(2 * x) + 2 * x**2 + 5 - 12 * nu + 8 * nu**2)
    np.testing.assert_allclose(found.w_normal, (1 - nu) * t / (G * x) * normal, rtol=1e-9)
    np.testing.assert_allclose(found.transverse, t * np.tanh(x) / (G * x), rtol=1e-13)
    np.testing.assert_allclose(found.v_normal, found.w_tangential, rtol=1e-8, atol=1e-12 * t / G)


def test_a_thin_layer_is_a_winkler_foundation():
    """Compressible: u = p t (1 + ν)(1 − 2ν)/((1 − ν) E); incompressible, by lubrication theory: u = p k² t³/(3 G)."""
    t, nu, k = 1e-3, 0.3, np.array([1.0])
    modulus = 2 * G * (1 + nu)
    found = response(k, Layer(t, 0.0, G, nu)).w_normal
    np.testing.assert_allclose(found, t * (1 + nu) * (1 - 2 * nu) / ((1 - nu) * modulus), rtol=1e-5)
    k = np.array([30.0])
    np.testing.assert_allclose(response(k, Layer(t, 0.0, G, 0.5)).w_normal, k**2 * t**3 / (3 * G), rtol=2e-3)


@pytest.mark.parametrize("nu", [0.3, 0.5])
@pytest.mark.parametrize("z", [0.0, 1e-3])
def test_a_thick_layer_is_the_half_space(nu, z):
    """All five profiles, and as 1/thickness: the base, t away, holds back what is of order 1/t."""
    r, a = np.linspace(0.0, 0.02, 21), 1e-3
    errors = []
    for t in (0.25, 0.5):
        found, limit = profiles(r, Layer(t, z, G, nu), a), half_space(r, z, a, G, nu)
        scale = float(limit.normal.max())
        errors.append(max(float(np.abs(p - q).max()) for p, q in zip(found, limit, strict=True)) / scale)
    assert errors[1] < 0.005
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_the_table_is_the_integral():
    r, layer = np.random.default_rng(0).uniform(0, 0.03, 300), Layer(2e-3, 0.3e-3, G, 0.49)
    for found, exact in zip(tabulated(r, layer, 1e-3), profiles(r, layer, 1e-3), strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=3e-6 * np.abs(exact).max())


def test_a_layer_moves_nothing_at_its_base_and_no_volume_if_incompressible():
    """At the base all profiles vanish. ν = 1/2: ∫ u_z 2πr dr = 0, for what sinks in comes up around."""
    r = np.linspace(0.0, 0.03, 3001)
    base = profiles(r[::100], Layer(2e-3, 2e-3, G, 0.5), 1e-3)
    top = profiles(r, Layer(2e-3, 0.0, G, 0.5), 1e-3)
    assert max(np.abs(part).max() for part in base) < 1e-10 * top.normal.max()
    volume = np.trapezoid(top.normal * r, r)
    assert abs(volume) < 1e-4 * np.trapezoid(np.abs(top.normal) * r, r)
    assert top.normal.min() < 0


def sheet(n, side, curve=None):
    """A flat n × n pad of some side [m], normals +z; or bent around the y axis to a radius."""
    line = (np.arange(n) + 0.5) / n * side - side / 2
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    cell = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2)
    pos, normal = np.stack([x, y, 0 * x], axis=1), np.tile([0.0, 0.0, 1.0], (n * n, 1))
    if curve:
        pos = np.stack([curve * np.sin(x / curve), y, curve * np.cos(x / curve)], axis=1)
        normal = np.stack([np.sin(x / curve), 0 * x, np.cos(x / curve)], axis=1)
    return LinkTaxels(pos, normal, np.full(n * n, (side / n) ** 2), cell, np.ones(n * n, dtype=bool))


ELASTIC = {"youngs_modulus": 2e5, "poissons_ratio": 0.45, "normal_stiffness": 1e8}


def spec(**fields):
    return ElastomerSpec.model_validate({"kind": "elastomer", "links": "pad", "feels": ["item"], **fields})


@pytest.mark.parametrize(
    "fields", [{}, {"kernel": "half_space", **ELASTIC}, {"kernel": "bonded_layer", "thickness": 4e-3, **ELASTIC}]
)
def test_twice_the_taxels_change_the_mean_little(fields):
    """A ball pressed into a pad of 12² and of 17² taxels (half the area each): mean |u| over the pad within 2 %, for each part."""
    means = []
    for n in (12, 17, 24):
        part = sheet(n, 0.02)
        h = np.maximum(0.0, 1e-3 - (part.pos[:, 0] ** 2 + part.pos[:, 1] ** 2) / (2 * 0.012))
        found = responses(spec(**fields), part, None)
        every = np.arange(n * n)
        if fields:
            load = 1e8 * np.stack([0.3 * h, 0.0 * h, -h])
            u = np.einsum("klji,li->kj", found["traction"](every), load)
            parts = [np.abs(u[2]), np.hypot(u[0], u[1])]
        else:
            u = np.einsum("kji,i->kj", found["spread"](every)[:, 0], h)
            parts = [np.hypot(u[0], u[1]), found["bulge"](every)[0, 0] @ h**1.2, found["drag"](every)[0, 0] @ h]
        means.append([float(np.mean(p)) for p in parts])
    print(fields.get("kernel", "gaussian"), np.array(means[1]) / means[0] - 1, np.array(means[2]) / means[0] - 1)
    np.testing.assert_allclose(means[1], means[0], rtol=0.02)
    np.testing.assert_allclose(means[2], means[0], rtol=0.02)


def test_the_papers_model_grows_with_the_number_of_taxels():
    n, h = 10, np.full(100, 1e-3)
    few, many = (responses(spec(model="paper"), sheet(k, 0.02), None)["bulge"](np.arange(k * k))[0, 0] for k in (n, 2 * n))
    ratio = float(np.mean(many @ np.repeat(h, 4)) / np.mean(few @ h))
    assert ratio == pytest.approx(4.0, rel=0.02)


def test_offsets_on_a_curved_fingertip_are_exact_where_one_plane_is_not():
    """Neighbours on a cylinder of 8 mm, up to 70° off the middle, as the marker's own tangent plane sees them: R sin(Δ)."""
    part = sheet(8, 2 * np.deg2rad(80) * 8e-3, curve=8e-3)
    r = np.linalg.norm(offset(part.pos, part.normal, part.pos), axis=0)
    step = 2 * 80 / 8
    np.testing.assert_allclose(np.diagonal(r[:, 8:])[: 7 * 8], 8e-3 * np.sin(np.deg2rad(step)), rtol=1e-12)
    plane = np.linalg.norm(part.pos[8:, :2] - part.pos[:-8, :2], axis=1)  # all on the pad's mean plane
    wrong = plane / (8e-3 * np.sin(np.deg2rad(step)))
    print("planar over exact spacing", wrong.min(), wrong.max())
    assert wrong.min() < 0.55
    u = Gaussian(8000.0, 2000.0, 1.0, 1e-3, False).spread(part.pos, part.normal, part.pos)
    assert np.abs(np.einsum("kaji,jk->ji", u, part.normal)).max() < 1e-18


def test_elastic_displacements_between_curved_frames():
    """A pressed taxel seen from another whose normal is tilted: along the target's own normal and tangent; hand-made."""
    tilt = np.deg2rad(15)
    normal = np.array([[0, 0, 1.0], [np.sin(tilt), 0, np.cos(tilt)]])
    part = LinkTaxels(
        np.array([[0, 0, 0], [4e-3, 0, -5e-4]]), normal, np.full(2, 4e-6), np.full((2, 2), -1), np.ones(2, dtype=bool)
    )
    u = Elastic(Layer(np.inf, 0.0, G, 0.3)).displacement(part, np.array([0]))[:, :, 1, 0]
    between = np.array([4e-3, 0, -5e-4])
    r = between - (between @ normal[1]) * normal[1]
    length = np.linalg.norm(r)
    g = half_space(np.array([length]), 0.0, patch_radius(4e-6), G, 0.3)
    pressed = 4e-6 * (-g.normal[0] * normal[1] + g.spread[0] * r / length)
    np.testing.assert_allclose(u @ [0, 0, -1], pressed, rtol=1e-12, atol=1e-22)
    across = 4e-6 * (g.along[0] - g.bend[0]) * np.array([0, 1.0, 0])
    np.testing.assert_allclose(u @ [0, 1, 0], across, rtol=1e-12, atol=1e-22)
    tangent = r / length
    pulled = tangent[0] * (g.along[0] + g.bend[0]) * tangent - tangent[0] * g.lift[0] * normal[1]
    np.testing.assert_allclose(u @ [1, 0, 0], 4e-6 * pulled, rtol=1e-12, atol=1e-22)


def test_volume_and_blend_of_the_gaussian():
    """C = 0: ḡ/ρ̄ ρ, whose in-plane displacement is ḡ at r = ε if normalized peaks are left out, and falls off as 1/r."""
    eps, lam = 1e-3, 8000.0
    here = np.array([[0.0, 0, 0]])
    for r, expected in ((eps, eps * np.exp(-0.5) / np.sqrt(2 * lam) / eps), (1.0, np.exp(-0.5) / np.sqrt(2 * lam) * 2 * eps)):
        u = Gaussian(lam, 2000.0, 0.0, eps, False).spread(np.array([[r, 0, 0]]), np.array([[0, 0, 1.0]]), here)
        np.testing.assert_allclose(u[:, 0, 0, 0], [expected, 0, 0], rtol=1e-5)
    peak = 1 / np.sqrt(2 * lam)
    printed = Gaussian(lam, 2000.0, 1.0, eps, True).spread(np.array([[peak, 0, 0]]), np.array([[0, 0, 1.0]]), here)
    assert printed[0, 0, 0, 0] == pytest.approx(1.0, rel=1e-12)  # r g/ḡ peaks at 1, at r = 1/√(2λ)
    plain = Gaussian(lam, 2000.0, 1.0, eps, False).spread(np.array([[peak, 0, 0]]), np.array([[0, 0, 1.0]]), here)
    assert printed[0, 0, 0, 0] / plain[0, 0, 0, 0] == pytest.approx(208.55, rel=1e-4)
