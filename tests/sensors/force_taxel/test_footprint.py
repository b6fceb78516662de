"""The shares of contacts, without a scene: against loops in NumPy, SciPy's minimiser, and their guarantees."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from tgdsl.sensors.force_taxel.footprint import LEVENBERG, footprint, reference

RADIUS = 0.01
TOLERANCE = 1e-12
"""Both are float64 and take the same steps; with the moment out of reach a step's system has a condition of 1e4."""


def pad(spacing=0.005, num=8):
    line = (np.arange(num) - (num - 1) / 2) * spacing
    x, y = np.meshgrid(line, line, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(num * num)])


def contacts(rng, num, half=0.012, height=0.0, shear=0.4):
    """Return contacts on the pad that push it down."""
    point = np.column_stack([rng.uniform(-half, half, (num, 2)), np.full(num, height)])
    force = rng.uniform(0.2, 1.0, (num, 1)) * np.column_stack([shear * rng.uniform(-1, 1, (num, 2)), -np.ones(num)])
    return point, force, np.zeros((num, 3))


def up(pos):
    """Return the normals of taxels on a flat pad."""
    return np.tile([0.0, 0.0, 1.0], (len(pos), 1))


def shares_of(
    pos,
    point,
    force,
    torque,
    depth=None,
    steps=4,
    is_active=None,
    dtype=torch.float64,
    radius=RADIUS,
    outward=None,
    normal=None,
):
    """Return the shares (contact, taxel) and the residual of one environment; by default contacts are from above."""
    outward, normal = up(pos) if outward is None else outward, -up(point) if normal is None else normal
    depth = np.full(len(pos), 0.5) if depth is None else depth
    is_active = np.ones(len(pos), dtype=bool) if is_active is None else is_active
    vectors = [tuple(torch.tensor(v.T[:, None], dtype=dtype)) for v in (point, force, torque, normal)]
    result = footprint(
        tuple(torch.tensor(pos.T, dtype=dtype)),
        torch.tensor(is_active),
        torch.tensor(depth[None], dtype=dtype),
        tuple(torch.tensor(-2.0 * outward.T, dtype=dtype)),
        *vectors,
        torch.tensor(radius, dtype=dtype),
        torch.full((steps,), LEVENBERG, dtype=dtype),
    )
    return result.share[0].numpy(), np.array([float(part[0]) for part in result.residual])


def residual_moment(pos, point, force, torque, share):
    """Return Σ_c Σ_j share_cj ((x_c − x_j) × f_c + τ_c), the residual by definition."""
    arms = point[:, None] - pos[None]
    couple = np.cross(arms, force[:, None]) + torque[:, None]
    return (share[..., None] * couple).sum(axis=(0, 1))


@pytest.mark.parametrize("steps", [0, 1, 4, 12])
@pytest.mark.parametrize("half", [0.012, 0.03])
def test_shares_match_the_loops(steps, half):
    """In reach and out of it, with inactive taxels, with torques, and with contacts of zero force."""
    rng = np.random.default_rng(steps)
    pos, is_active, worst = pad(), rng.random(64) > 0.1, 0.0
    for _ in range(5):
        point, force, torque = contacts(rng, 3, half)
        torque = 1e-4 * rng.normal(size=(3, 3))
        force[2] = 0
        depth = rng.uniform(0, 1, 64)
        sides = rng.normal([0, 0, 1], 0.5, (64, 3)), rng.normal([0, 0, -1], 0.5, (3, 3))
        outward, normal = (side / np.linalg.norm(side, axis=1)[:, None] for side in sides)
        share, residual = shares_of(pos, point, force, torque, depth, steps, is_active, outward=outward, normal=normal)
        contact = point, force, torque, normal
        expected, expected_residual = reference(pos, is_active, depth, outward, *contact, RADIUS, (LEVENBERG,) * steps)
        np.testing.assert_allclose(share, expected, atol=TOLERANCE)
        np.testing.assert_allclose(residual, expected_residual, atol=TOLERANCE * RADIUS)
        np.testing.assert_allclose(residual, residual_moment(pos, point, force, torque, share), atol=1e-15)
        assert not share[:, ~is_active].any()
        worst = max(worst, np.abs(share).max())
    assert worst > 0.05


def test_shares_have_the_least_relative_entropy():
    """SciPy minimises Σ_c |f_c| Σ_j λ_cj ln(λ_cj/λ⁰_cj) over all shares with the contacts' moment, without a dual."""
    rng = np.random.default_rng(5)
    pos = pad(0.006, 5)
    point, force, torque = contacts(rng, 2, 0.006, shear=0.3)
    point[1] = point[0] + [0.003, -0.002, 0]
    depth = rng.uniform(0.2, 1, 25)
    prior, _ = shares_of(pos, point, force, torque, depth, steps=0)
    shares, residual = shares_of(pos, point, force, torque, depth, steps=20)
    assert np.abs(residual).max() < 1e-15
    at = np.argwhere(prior > 0)
    weight, first = np.linalg.norm(force, axis=1)[at[:, 0]], prior[at[:, 0], at[:, 1]]
    moment = np.cross(pos[at[:, 1]] - point[at[:, 0]], force[at[:, 0]]).T / RADIUS
    member = np.array([at[:, 0] == c for c in range(2)], dtype=float)
    rows = np.concatenate([member, moment])

    def entropy(share):
        return float(np.sum(weight * share * np.log(share / first)))

    result = minimize(
        entropy,
        first,
        jac=lambda share: weight * (np.log(share / first) + 1),
        method="SLSQP",
        bounds=[(1e-9, 1)] * len(first),
        constraints={"type": "eq", "fun": lambda s: rows @ s - [1, 1, 0, 0, 0], "jac": lambda s: rows},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    ours = shares[at[:, 0], at[:, 1]]
    assert np.abs(ours - first).max() > 0.01  # the moment requires a correction
    np.testing.assert_allclose(rows @ ours, [1, 1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(ours, result.x, atol=2e-5)
    assert entropy(ours) <= result.fun + 1e-9


def test_a_small_correction_has_the_least_norm():
    """To first order in the moment: λ = λ⁰ (1 + β · (g − ḡ)), β from the covariance of g under λ⁰."""
    pos = pad()
    point, force, torque = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, -1.0]]), np.zeros((1, 3))
    prior, _ = shares_of(pos, point, force, torque, steps=0)
    g = np.cross(pos - point, force) / RADIUS
    covariance = (prior[0, :, None, None] * g[:, :, None] * g[:, None]).sum(axis=0)[:2, :2]
    for size in (1e-3, 1e-4):  # the error is of second order
        torque = np.array([[size, -0.5 * size, 0]]) * RADIUS
        beta = np.linalg.solve(covariance, [size, -0.5 * size])
        share, _ = shares_of(pos, point, force, torque, steps=8)
        linear = prior[0] * (1 + g[:, :2] @ beta)
        np.testing.assert_allclose(share[0], linear, atol=10 * size**2)


def test_four_steps_suffice_if_the_moment_is_in_reach():
    """Contacts in the middle of the pad: four steps leave little of force times footprint, and twelve leave less.

    If contacts' forces differ in direction, one direction of β has hardly any effect and converges last.
    """
    rng = np.random.default_rng(7)
    residuals = []
    for _ in range(40):
        point, force, torque = contacts(rng, 1 + rng.integers(4), 0.008)
        depth, scale = rng.uniform(0.1, 1, 64), np.linalg.norm(force, axis=1).sum() * RADIUS
        residuals.append(
            [np.linalg.norm(shares_of(pad(), point, force, torque, depth, steps)[1]) / scale for steps in (0, 4, 12)]
        )
    zero, four, twelve = np.array(residuals).T
    assert np.median(zero) > 0.02
    assert np.median(four) < 1e-4
    assert four.max() < 5e-3
    assert np.median(twelve) < 1e-8
    assert (twelve <= 1.01 * four + 1e-15).all()


def test_more_steps_never_increase_the_residual():
    """With the moment out of reach, too, and depths over three decades: no step increases the residual for good."""
    rng = np.random.default_rng(8)
    for _ in range(15):
        point, force, torque = contacts(rng, 2, 0.025, height=rng.uniform(-0.003, 0.003), shear=1.0)
        depth, scale = 10 ** rng.uniform(-3, 0, 64) * (rng.random(64) > 0.5), np.linalg.norm(force, axis=1).sum() * RADIUS
        residuals = [
            np.linalg.norm(shares_of(pad(), point, force, torque, depth, steps)[1]) / scale for steps in (0, 4, 16, 48)
        ]
        assert np.all(np.isfinite(residuals))
        assert residuals[1] <= residuals[0] + 1e-3
        assert residuals[2] <= residuals[1] + 1e-3
        assert residuals[3] <= residuals[2] + 1e-9


def test_a_single_row_has_no_moment_about_itself():
    """A force next to a row of taxels: along the row its place is met; across it, the couple remains as the residual."""
    pos = pad()[3::8]  # a row along x, at y of −2.5 mm
    assert np.ptp(pos[:, 1]) == 0
    point, force = np.array([[0.0012, pos[0, 1] + 0.002, 0.0]]), np.array([[0.0, 0.0, -2.0]])
    share, residual = shares_of(pos, point, force, np.zeros((1, 3)), steps=12)
    assert share.sum() == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(share[0] @ pos[:, 0], 0.0012, atol=1e-12)
    np.testing.assert_allclose(residual, [-2.0 * 0.002, 0, 0], atol=1e-12)


def test_a_split_contact_counts_as_one():
    """One place and direction in unequal parts, next to another contact: the taxels' forces do not change."""
    rng = np.random.default_rng(9)
    point, force, torque = contacts(rng, 2, 0.02)
    torque = 1e-3 * rng.normal(size=(2, 3))
    depth = rng.uniform(0, 1, 64)
    share, residual = shares_of(pad(), point, force, torque, depth)
    split = [np.concatenate([v[:1] * part, v[:1] * (1 - part), v[1:]]) for v, part in ((force, 0.3), (torque, 0.3))]
    parts, split_residual = shares_of(pad(), point[[0, 0, 1]], *split, depth)
    np.testing.assert_allclose(parts.T @ split[0], share.T @ force, atol=TOLERANCE)
    np.testing.assert_allclose(split_residual, residual, atol=TOLERANCE * RADIUS)


def test_capture_fades_with_distance():
    """A contact is captured up to half a footprint from the outermost taxel and missed from a whole one; the step is smooth."""
    pos, force = np.zeros((1, 3)), np.array([[0.1, 0.0, -1.0]])
    for distance, expected in ((0.0, 1), (0.5, 1), (0.5 + 1e-9, 1), (np.sqrt(0.625), 0.5), (1.0, 0), (1.5, 0), (100.0, 0)):
        point = np.array([[distance * RADIUS, 0, 0]])
        share, _ = shares_of(pos, point, force, np.zeros((1, 3)))
        assert share.sum() == pytest.approx(expected, abs=1e-12), distance


def tilted_normal(cosine):
    """Return a contact's normal whose angle to straight down has this cosine."""
    return np.array([[np.sqrt(1 - cosine**2), 0.0, -cosine]])


@pytest.mark.parametrize(
    ("cosine", "expected"), [(1, 1), (0.5, 1), (0.375, 1), (0.1875, 0.5), (0.09375, 0.15625), (0, 0), (-0.2, 0), (-1, 0)]
)
def test_a_contact_is_captured_by_taxels_on_its_side(cosine, expected):
    """At a taxel, κ is twice the cosine up to 1, and t is 4/3 of that: γ = t²(3 − 2t), whatever the force's direction."""
    for force in ([[0.0, 0.0, -1.0]], [[0.3, 0.2, 1.0]]):
        share, _ = shares_of(
            np.zeros((1, 3)), np.zeros((1, 3)), np.array(force), np.zeros((1, 3)), normal=tilted_normal(cosine)
        )
        assert share.sum() == pytest.approx(expected, abs=1e-12)


def test_taxels_that_face_a_contact_carry_more():
    """Two equally near and deep taxels at right angles: κ of 1 and 1/2 by a contact at 60° and near 30°."""
    pos, outward = np.array([[0.003, 0, 0], [-0.003, 0, 0]]), np.array([[0.0, 0, 1], [1.0, 0, 0]])
    for cosine, expected in ((np.sqrt(15) / 4, [0.8, 0.2]), (1.0, [1, 0]), (0.0, [0, 1])):
        normal = -tilted_normal(cosine) * [[1, 1, -1]]
        share, _ = shares_of(
            pos, np.zeros((1, 3)), np.array([[0, 0, -1.0]]), np.zeros((1, 3)), steps=0, outward=outward, normal=normal
        )
        np.testing.assert_allclose(share[0], expected, atol=1e-12)


def test_forces_are_continuous_as_a_contact_rounds_a_finger():
    """A ball rolls around a finger of 8 mm with taxels in front: at the back all force is missed, without a jump.

    The back is 16 mm from the front, within the footprint's reach.
    """
    angle = np.radians(np.linspace(-80, 80, 9))
    outward = np.array([[np.sin(a), 0, np.cos(a)] for a in angle for _ in range(3)])
    pos = 0.008 * outward + [[0, y, 0] for _ in angle for y in (-0.004, 0, 0.004)]
    depth = np.random.default_rng(4).uniform(0, 1, len(pos))

    def roll(num):
        path = []
        for a in np.linspace(0, np.pi, num):
            out = np.array([[np.sin(a), 0, np.cos(a)]])
            force = -out + [[0, 0.3, 0]]
            share, residual = shares_of(
                pos, 0.008 * out, force, np.zeros((1, 3)), depth, outward=outward, normal=-out, radius=0.02
            )
            path.append(np.concatenate([(share.T @ force).ravel(), residual / 0.02, [share.sum()]]))
        return np.array(path)

    coarse, fine = roll(101), roll(201)
    np.testing.assert_array_equal(coarse[-1], 0)
    assert coarse[0, -1] == pytest.approx(1, abs=1e-12)
    change = np.abs(np.diff(coarse, axis=0)).max()
    assert change < 12 * np.pi / 100  # some times the force per radian
    assert np.abs(np.diff(fine, axis=0)).max() == pytest.approx(change / 2, rel=0.2)


def test_forces_are_continuous_as_a_contact_slides_off():
    """Over the pad's edge and beyond no force jumps, and halving the step halves the change."""
    pos, force = pad(), np.array([[0.3, -0.2, -1.0], [0, 0, -0.5]])
    depth = np.random.default_rng(3).uniform(0, 1, 64)

    def slide(num):
        point = np.tile([[0.0, 0.013, 0.001], [0.01, 0, 0]], (num, 1, 1))
        point[:, 0, 0] = np.linspace(0.016, 0.0285, num)
        tiled = (np.tile(each, (num, 1, 1)) for each in (force, np.zeros((2, 3)), -up(force)))
        vectors = [torch.tensor(v) for v in (point, *tiled)]
        result = footprint(
            tuple(torch.tensor(pos.T)),
            torch.ones(64, dtype=torch.bool),
            torch.tensor(np.tile(depth, (num, 1))),
            tuple(torch.tensor(-2.0 * up(pos).T)),
            *(v.unbind(-1) for v in vectors),
            torch.tensor(RADIUS, dtype=torch.float64),
            torch.full((4,), LEVENBERG, dtype=torch.float64),
        )
        forces = torch.einsum("ecj,ck->ejk", result.share, torch.tensor(force)).flatten(1)
        path = torch.cat([forces, torch.stack(result.residual, dim=1) / RADIUS], dim=1).numpy()
        return path, np.abs(np.diff(path, axis=0)).max()

    path, coarse = slide(401)
    _, fine = slide(801)
    reach = 0.0125
    assert np.abs(path[0] - path[-1]).max() > 0.1
    assert coarse < 10 * reach / 400 / RADIUS  # at most ten times the force per footprint
    assert fine == pytest.approx(coarse / 2, rel=0.2)


def test_a_new_contact_starts_from_zero():
    """A second contact of force ε, in reach and at its edge, changes each taxel's force by at most a few ε."""
    rng = np.random.default_rng(12)
    for x in (0.004, 0.024, 0.0268):
        point, force, _ = contacts(rng, 2)
        point[1] = [x, 0.002, 0.0]
        depth = rng.uniform(0, 1, 64)
        alone, residual = shares_of(pad(), point[:1], force[:1], np.zeros((1, 3)), depth)
        for size in (1e-3, 1e-6, 1e-9):
            both, total_residual = shares_of(pad(), point, force * [[1], [size]], np.zeros((2, 3)), depth)
            np.testing.assert_allclose(both.T @ (force * [[1], [size]]), alone.T @ force[:1], atol=20 * size)
            np.testing.assert_allclose(total_residual, residual, atol=20 * size * RADIUS)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_derivatives_are_finite_without_a_force(dtype):
    """Unused slots at the origin, a contact at a taxel, zero forces, contacts out of reach: no infinity, no NaN."""
    pos = torch.tensor(pad().T, dtype=dtype)
    point = torch.tensor([[0, 0, 0], [0.0025, 0.0025, 0], [1.0, 1.0, 0], [0.0275, 0.0175, 0]], dtype=dtype).T[:, None]
    for force in (torch.zeros(3, 1, 4, dtype=dtype), torch.tensor([0.0, 0, -1], dtype=dtype)[:, None, None].repeat(1, 1, 4)):
        down = torch.tensor([0.0, 0, -1], dtype=dtype)[:, None, None] * (force != 0).any(dim=0)
        inputs = [point.clone(), force.clone(), torch.zeros_like(force), down, torch.zeros(1, 64, dtype=dtype)]
        point_, force_, torque_, normal_, depth = (value.requires_grad_() for value in inputs)
        result = footprint(
            (pos[0], pos[1], pos[2]),
            torch.ones(64, dtype=torch.bool),
            depth,
            tuple(torch.tensor(-2.0 * up(pad()).T, dtype=dtype)),
            (point_[0], point_[1], point_[2]),
            (force_[0], force_[1], force_[2]),
            (torque_[0], torque_[1], torque_[2]),
            (normal_[0], normal_[1], normal_[2]),
            torch.tensor(RADIUS, dtype=dtype),
            torch.full((4,), LEVENBERG, dtype=dtype),
        )
        total = sum(result.residual, (result.share[..., None] * force_[:, 0].T[None, :, None]).square().sum()).sum()
        for gradient in torch.autograd.grad(total, [point_, force_, torque_, normal_, depth]):
            assert torch.isfinite(gradient).all()


def test_shares_are_differentiable():
    rng = np.random.default_rng(11)
    point, force, torque = contacts(rng, 3, 0.02)
    pos = tuple(torch.tensor(pad(0.006, 4).T))
    normal = np.array([[0.0, 0.0, -1.0], [0.6, 0.6, -0.4], [-0.8, 0.5, -0.3]])
    inputs = [torch.tensor(v.T[:, None], requires_grad=True) for v in (point, force, torque + 1e-4, normal)]
    inward = tuple(torch.tensor(-2.0 * up(pad(0.006, 4)).T))
    depth = torch.tensor(rng.uniform(0.1, 1, (1, 16)), requires_grad=True)

    def forces(point, force, torque, normal, depth):
        planes = [(v[0], v[1], v[2]) for v in (point, force, torque, normal)]
        radius, steps = torch.tensor(RADIUS, dtype=torch.float64), torch.full((3,), LEVENBERG, dtype=torch.float64)
        result = footprint(pos, torch.ones(16, dtype=torch.bool), depth, inward, *planes, radius, steps)
        return torch.cat(
            [*((result.share * part[..., None]).sum(dim=1) for part in planes[1]), torch.stack(result.residual, 1)], 1
        )

    assert torch.autograd.gradcheck(forces, [*inputs, depth], eps=1e-7, atol=1e-5, rtol=1e-4)
