"""The sum over active points, compacted on a CPU, against the printed sum over all points in NumPy."""

import numpy as np
import pytest
import torch

from tgdsl.geometry.planes import vec
from tgdsl.quantities.points import point_tiles
from tgdsl.sensors.elastomer import point_anchors
from tgdsl.sensors.elastomer.point_anchors import Markers, ShearLoad, active_points, are_compacted, block_size

FALLOFF, NUM_MARKERS, TAXELS = 2000.0, 11, ((6, 10), (0, 6), (10, 10))
"""Markers of three links, one without any; the last marker belongs to no link."""
CASES = {
    # environments, points, share of active points in each environment in turn
    "few": (40, 500, (0.05, 0.2, 0.0)),
    "one environment has most": (40, 500, (0.0, 0.01, 0.02, 0.0, 0.0, 0.9)),
    "all": (5, 60, (1.0,)),
    "none": (5, 60, (0.0,)),
    "a prime number of points": (7, 101, (0.1, 0.3)),
    "one point": (4, 1, (1.0, 0.0)),
    "two environments": (2, 48, (0.2,)),
    "no environment": (0, 48, (0.2,)),
}


def inputs(name: str, dtype: torch.dtype = torch.float64) -> tuple[ShearLoad, Markers]:
    """Return active points in runs, and markers with normals in all directions."""
    num_envs, num_points, shares = CASES[name]
    rng = np.random.default_rng(num_points)
    pos = 0.02 * rng.normal(size=(3, num_envs, 3, num_points))
    strength = 1e-7 * rng.normal(size=pos.shape)
    share = np.resize(shares, num_envs)[:, None, None]
    start = rng.integers(num_points, size=(num_envs, 3, 1))
    strength *= (np.arange(num_points) - start) % num_points < np.round(share * num_points)
    marker, normal = 0.02 * rng.normal(size=(3, NUM_MARKERS)), rng.normal(size=(3, NUM_MARKERS))
    normal[:, 0] = 0, 0, -1
    normal /= np.linalg.norm(normal, axis=0)

    def planes(stacked):
        return vec(torch.from_numpy(part).to(dtype) for part in stacked)

    load = ShearLoad(TAXELS, torch.tensor(point_tiles(TAXELS, NUM_MARKERS)), torch.ones(1, 1), planes(pos), planes(strength))
    return load, Markers(planes(marker), planes(normal), torch.tensor(FALLOFF, dtype=dtype), None)


def printed_sum(load: ShearLoad, markers: Markers) -> np.ndarray:
    """Return Σ_p s_p exp(−λ |Π_nj(x_j − z_p)|²), (3, env, marker), marker by marker."""
    z, s = (np.stack([part.double().numpy() for part in vector]) for vector in (load.pos, load.strength))
    x, n = (np.stack([part.double().numpy() for part in vector]) for vector in (markers.pos, markers.normal))
    sums = np.zeros((3, z.shape[1], NUM_MARKERS))
    for link, (first, last) in enumerate(load.taxels):
        for j in range(first, last):
            r = x[:, j, None, None] - z[:, :, link]
            r = r - np.einsum("k,kep->ep", n[:, j], r) * n[:, j, None, None]
            sums[:, :, j] = (s[:, :, link] * np.exp(-FALLOFF * (r**2).sum(axis=0))).sum(axis=2)
    return sums


def summed(load: ShearLoad, markers: Markers) -> torch.Tensor:
    return torch.stack(point_anchors.point_sum(load, markers))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 1e-6)])
@pytest.mark.parametrize("name", CASES)
def test_the_sum_matches_the_printed_one(name, dtype, tolerance):
    load, markers = inputs(name, dtype)
    expected = printed_sum(load, markers)
    assert are_compacted(load.pos, load.strength)
    assert (np.abs(expected).max(initial=0) > 0) == (name not in ("none", "no environment"))
    np.testing.assert_allclose(summed(load, markers), expected, rtol=0, atol=tolerance * np.abs(expected).max(initial=0))


@pytest.mark.parametrize("name", CASES)
def test_every_active_point_is_in_one_slot_of_its_environment(name):
    load, _ = inputs(name)
    for link, (points, env) in enumerate(active_points(load.pos, load.strength)):
        assert points.shape[1] == len(env) >= min(2, len(load.pos[0]))
        slot_envs = env[:, None].expand(points.shape[1:]).reshape(-1)
        slots = torch.cat([slot_envs[None].double(), points.flatten(1)])[:, (points[3:] != 0).any(dim=0).flatten()].T.tolist()
        all_points = torch.stack([part[:, link] for part in (*load.pos, *load.strength)], dim=-1)
        expected = [[float(e), *all_points[e, p].tolist()] for e, p in all_points[..., 3:].any(dim=-1).nonzero().tolist()]
        assert sorted(slots) == sorted(expected)


def test_few_points_take_few_slots():
    """In blocks of 10, runs of 5 % and 20 % of 500 points touch at most 4 and 11 of the 50 blocks."""
    load, _ = inputs("few")
    assert block_size(500) == 10 and block_size(101) == 1
    for points, _ in active_points(load.pos, load.strength):
        assert points[0].numel() < 0.3 * load.pos[0][:, 0].numel()


def test_nan_stays_in_its_environment():
    """A NaN in a pose, though no point is active, and one in a strength, in its component."""
    load, markers = inputs("few")
    assert not load.strength[0][2, 1].any()
    load.pos[1][2, 1] = torch.nan
    load.strength[2][4, 0, 13] = torch.nan
    is_nan = summed(load, markers).isnan()
    assert is_nan[:, 2, :6].all() and is_nan[2, 4, 6:10].all()
    is_nan[:, 2, :6] = is_nan[2, 4, 6:10] = False
    assert not is_nan.any()


@pytest.mark.slow
def test_one_graph_serves_all_numbers_of_active_points():
    """It compiles without a break, and does not recompile when other points are active; its loops run on two threads."""
    torch.compiler.reset()
    compiled = torch.compile(summed, fullgraph=True, dynamic=True, options={"cpp.simdlen": 1})
    load, markers = inputs("few", torch.float32)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        compiled(load, markers)
        with torch._dynamo.config.patch(error_on_recompile=True):
            for seed in range(4):
                share = torch.rand(40, 3, 1, generator=torch.Generator().manual_seed(seed)) ** 4 * (seed > 0)
                random_load = load._replace(
                    strength=vec(torch.where(torch.arange(500) < 500 * share, 1e-7, 0.0) for _ in range(3))
                )
                expected = printed_sum(random_load, markers)
                np.testing.assert_allclose(compiled(random_load, markers), expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    finally:
        torch.set_num_threads(threads)


def test_derivatives_equal_those_of_the_sum_over_all_points():
    """With gradients every point counts, even one that is not active yet."""
    load, markers = inputs("two environments")
    leaves = [part.clone().requires_grad_() for part in (*load.pos, *load.strength)]

    def read(*parts):
        return 1e7 * summed(load._replace(pos=vec(parts[:3]), strength=vec(parts[3:])), markers)

    assert not are_compacted(vec(leaves[:3]), vec(leaves[3:]))
    with torch.no_grad():
        assert are_compacted(vec(leaves[:3]), vec(leaves[3:]))
    gradient = torch.autograd.grad(read(*leaves)[0].sum(), leaves)
    assert (gradient[3][:, :2] > 0).all()
    step, direction = (
        1e-6,
        [torch.randn(part.shape, generator=torch.Generator().manual_seed(0)).double() for part in leaves[:3]],
    )
    with torch.no_grad():
        ahead, behind = (
            read(*(part + sign * step * w for part, w in zip(leaves, direction, strict=False)), *leaves[3:])[0].sum()
            for sign in (1, -1)
        )
    slope = sum(float((g * w).sum()) for g, w in zip(gradient, direction, strict=False))
    assert float(ahead - behind) / (2 * step) == pytest.approx(slope, rel=1e-6)
