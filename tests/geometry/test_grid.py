import itertools

import numpy as np
import pytest
import torch

from tgdsl.geometry.grid import Grid, one_grid, tricubic, trilinear

METHODS = {"trilinear": trilinear, "tricubic": tricubic}
ORDER = {"trilinear": 2, "tricubic": 3}
SHAPE = (6, 7, 8)
CELL = 0.003
ORIGIN = np.array([-0.01, 0.002, 0.005])


def grid_of(function, shape=SHAPE, cell=CELL, origin=ORIGIN, dtype=torch.float64) -> Grid:
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * cell + origin
    values = torch.tensor(function(nodes), dtype=dtype)
    return one_grid(values, torch.tensor(origin, dtype=dtype), torch.tensor(cell, dtype=dtype))


def in_dtype(grid: Grid, dtype: torch.dtype) -> Grid:
    return grid._replace(values=grid.values.to(dtype), origin=tuple(o.to(dtype) for o in grid.origin), cell=grid.cell.to(dtype))


def ask(method: str, grid: Grid, points: np.ndarray, dtype=torch.float64):
    distance, gradient = METHODS[method](tuple(torch.tensor(points, dtype=dtype).unbind(-1)), grid)
    return distance.numpy(), torch.stack(gradient, dim=-1).numpy()


def points_in(count: int, rim: float = 0.0, seed: int = 0) -> np.ndarray:
    """Points in the grid's box, `rim` cells or more from its border."""
    low, high = ORIGIN + rim * CELL, ORIGIN + (np.array(SHAPE) - 1 - rim) * CELL
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


@pytest.fixture
def rough() -> Grid:
    rng = np.random.default_rng(3)
    return grid_of(lambda nodes: rng.normal(size=SHAPE) * CELL)


@pytest.mark.parametrize("method", METHODS)
def test_nodes_keep_their_values(method, rough):
    nodes = np.array(list(itertools.product(*map(range, SHAPE)))) * CELL + ORIGIN
    distance, _ = ask(method, rough, nodes)
    np.testing.assert_allclose(distance, rough.values.reshape(-1).numpy(), atol=1e-14)


@pytest.mark.parametrize("method", METHODS)
def test_a_linear_field_is_exact(method):
    slope = np.array([0.6, 0.0, -0.8])
    points = points_in(500, rim=1.0)
    distance, gradient = ask(method, grid_of(lambda nodes: nodes @ slope + 0.01), points)
    np.testing.assert_allclose(distance, points @ slope + 0.01, atol=1e-15)
    np.testing.assert_allclose(gradient, np.broadcast_to(slope, points.shape), atol=1e-12)


def test_tricubic_keeps_quadratic_fields():
    """Keys' a = −1/2 is the one value that does: the order is three."""
    form = np.array([[3.0, 1.0, -2.0], [0.0, 1.0, 0.5], [0.0, 0.0, -4.0]])
    points = points_in(500, rim=1.0)
    distance, _ = ask("tricubic", grid_of(lambda nodes: np.einsum("...i,ij,...j", nodes, form, nodes)), points)
    np.testing.assert_allclose(distance, np.einsum("...i,ij,...j", points, form, points), atol=1e-16)


@pytest.mark.parametrize("method", METHODS)
def test_convergence_order_on_a_sphere(method):
    rng = np.random.default_rng(0)
    way = rng.normal(size=(4000, 3))
    points = way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0.015, 0.024, (4000, 1))
    cells, errors, turns = 0.03 / np.array([10, 20, 40, 80]), [], []
    for cell in cells:
        num = round(0.06 / cell) + 3
        grid = grid_of(lambda nodes: np.linalg.norm(nodes, axis=-1) - 0.02, (num,) * 3, cell, np.full(3, -0.03 - cell))
        distance, gradient = ask(method, grid, points)
        errors.append(np.abs(distance - (np.linalg.norm(points, axis=1) - 0.02)).max())
        turns.append(np.linalg.norm(gradient - points / np.linalg.norm(points, axis=1, keepdims=True), axis=1).max())
    slope = np.polyfit(np.log(cells), np.log(errors), 1)[0]
    assert ORDER[method] - 0.15 < slope < ORDER[method] + 1.2
    assert np.polyfit(np.log(cells), np.log(turns), 1)[0] > ORDER[method] - 1.15


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradient_is_a_unit_vector_everywhere(method, dtype, rough):
    points = np.concatenate([points_in(500), points_in(500) * 3 - 0.02, points_in(5) * 1e8, points_in(5) * np.inf])
    grid = in_dtype(rough, dtype)
    distance, gradient = ask(method, grid, points, dtype)
    assert np.isfinite(distance).all()
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_where_the_gradient_vanishes_it_is_a_fixed_unit_vector(method):
    distance, gradient = ask(method, grid_of(lambda nodes: np.full(SHAPE, 0.004)), points_in(10))
    np.testing.assert_allclose(distance, 0.004, rtol=1e-14)
    np.testing.assert_array_equal(np.linalg.norm(gradient, axis=1), 1.0)


@pytest.mark.parametrize("method", METHODS)
def test_gradient_is_the_derivative(method, rough):
    """Inside, across the border and outside; trilinear not at faces of cells, where its gradient jumps."""
    points = np.concatenate([points_in(10), points_in(10, seed=1) * 3 - 0.02])
    p = torch.tensor(points, requires_grad=True)

    def distance(p: torch.Tensor) -> torch.Tensor:
        return METHODS[method](tuple(p.unbind(-1)), rough)[0]

    assert torch.autograd.gradcheck(distance, p, eps=1e-9, atol=1e-5)
    (derivative,) = torch.autograd.grad(distance(p).sum(), p)
    _, gradient = ask(method, rough, points)
    np.testing.assert_allclose(derivative / derivative.norm(dim=-1, keepdim=True), gradient, atol=1e-9)


def test_tricubic_gradient_is_continuous_at_faces_of_cells(rough):
    nodes = np.array(list(itertools.product(range(2, 4), range(2, 5), range(2, 6)))) * CELL + ORIGIN
    points = nodes + np.random.default_rng(0).uniform(0, CELL, nodes.shape) * [0, 1, 1]
    sides = [ask("tricubic", rough, points + [side * 1e-12, 0, 0])[1] for side in (-1, 1)]
    np.testing.assert_allclose(*sides, atol=1e-6)
    p = torch.tensor(points[::3], requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: tricubic(tuple(p.unbind(-1)), rough)[0], p, eps=1e-9, atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_outside_the_way_to_the_box_is_added(method, rough):
    low, high = ORIGIN, ORIGIN + (np.array(SHAPE) - 1) * CELL
    points = points_in(500) * 4 - 0.03
    nearest = np.clip(points, low, high)
    away = np.linalg.norm(points - nearest, axis=1)
    assert (away > 0).sum() > 300
    np.testing.assert_allclose(ask(method, rough, points)[0], ask(method, rough, nearest)[0] + away, atol=1e-14)


@pytest.mark.parametrize("method", METHODS)
def test_outside_reads_no_less_than_the_true_distance(method):
    center, margin = ORIGIN + 3 * CELL, 2 * CELL
    grid = grid_of(lambda nodes: np.linalg.norm(nodes - center, axis=-1) - CELL)
    points = points_in(500) * 4 - 0.03
    points = points[((points < ORIGIN) | (points > ORIGIN + (np.array(SHAPE) - 1) * CELL)).any(axis=1)]
    distance, _ = ask(method, grid, points)
    assert (distance > np.linalg.norm(points - center, axis=1) - CELL - 0.1 * CELL).all()
    assert (distance > margin - 0.1 * CELL).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_is_not_a_number(method, dtype, rough):
    inside = points_in(1)[0]
    table = np.array([np.where(mask, bad, inside) for bad in (np.nan, np.inf, -np.inf) for mask in np.eye(3, dtype=bool)])
    distance, gradient = ask(method, in_dtype(rough, dtype), table, dtype)
    np.testing.assert_array_equal(np.isnan(distance), [True] * 3 + [False] * 6)
    assert (distance[3:] >= 1e15 * (1 - 1e-6)).all()
    assert (np.sign(gradient[3:]) * np.concatenate([np.eye(3), -np.eye(3)])).sum(axis=1).min() == 1
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-5)
    np.testing.assert_array_equal(gradient[:3], [[1, 0, 0]] * 3)


@pytest.mark.parametrize("method", METHODS)
def test_float32_differs_by_roundings(method):
    grid = grid_of(lambda nodes: np.linalg.norm(nodes - 0.01, axis=-1))
    points = points_in(1000)
    double, _ = ask(method, grid, points)
    single, _ = ask(method, in_dtype(grid, torch.float32), points, torch.float32)
    assert np.abs(single - double).max() < 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_planes_broadcast(method, rough):
    x, y, z = torch.tensor(points_in(4)).unbind(-1)
    distance, gradient = METHODS[method]((x[:, None, None], y[:3, None], z), rough)
    assert distance.shape == (4, 3, 4) and all(part.shape == (4, 3, 4) for part in gradient)
    alone, _ = METHODS[method]((x[2], y[1], z[3]), rough)
    assert distance[2, 1, 3] == alone


@pytest.mark.parametrize("method", METHODS)
def test_each_point_asks_its_own_of_several_grids(method):
    """Grids of different sizes, places and cells in one table give what each gives alone."""
    balls = [
        grid_of(lambda nodes, r=r: np.linalg.norm(nodes - 0.01, axis=-1) - r, shape, cell, origin)
        for r, shape, cell, origin in (
            (0.004, (6, 7, 8), 0.003, ORIGIN),
            (0.006, (9, 5, 4), 0.004, ORIGIN + 0.002),
            (0.002, (4, 4, 12), 0.002, ORIGIN - 0.001),
        )
    ]
    which = torch.arange(300) % 3
    first = torch.tensor([0, *np.cumsum([len(ball.values) for ball in balls])[:-1]])
    table = Grid(
        values=torch.cat([ball.values for ball in balls]),
        first=first[which],
        num=tuple(torch.tensor(part)[which] for part in zip(*(ball.num for ball in balls), strict=True)),
        origin=tuple(torch.stack(part)[which] for part in zip(*(ball.origin for ball in balls), strict=True)),
        cell=torch.stack([ball.cell for ball in balls])[which],
    )
    points = points_in(300, rim=-2)
    distance, gradient = ask(method, table, points)
    for i, ball in enumerate(balls):
        own, own_gradient = ask(method, ball, points[i::3])
        np.testing.assert_array_equal(distance[i::3], own)
        np.testing.assert_array_equal(gradient[i::3], own_gradient)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_compiles_whole_for_any_size(method):
    torch.manual_seed(0)
    grid = one_grid(torch.rand(6, 7, 8).double(), torch.zeros(3).double(), torch.tensor(0.15).double())
    compiled = torch.compile(METHODS[method], fullgraph=True, dynamic=True, backend="aot_eager")
    for count in (300, 7, 1000):
        point = tuple(torch.rand(count, 3).double().mul(2).sub(0.4).T.contiguous().unbind())
        torch.testing.assert_close(compiled(point, grid), METHODS[method](point, grid), rtol=1e-9, atol=1e-9)
