import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tgdsl.geometry import planes


def stacked(parts):
    return torch.stack(parts, dim=-1).numpy()


def test_rotation_of_a_quaternion_of_any_length():
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(100, 4)) * rng.uniform(0.1, 10, (100, 1))
    expected = Rotation.from_quat(quats, scalar_first=True).as_matrix().reshape(-1, 9)
    np.testing.assert_allclose(stacked(planes.rotation(torch.tensor(quats))), expected, atol=1e-14)


def test_products_are_those_of_matrices():
    rng = np.random.default_rng(1)
    a, b = Rotation.random(20, random_state=2).as_matrix(), Rotation.random(20, random_state=3).as_matrix()
    v, w = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    ra, rb = (tuple(torch.tensor(m.reshape(-1, 9)).unbind(-1)) for m in (a, b))
    tv, tw = planes.split(torch.tensor(v)), planes.split(torch.tensor(w))
    np.testing.assert_allclose(stacked(planes.rotate(ra, tv)), np.einsum("nij,nj->ni", a, v), atol=1e-14)
    np.testing.assert_allclose(stacked(planes.rotate_back(ra, tv)), np.einsum("nji,nj->ni", a, v), atol=1e-14)
    product = np.einsum("nji,njk->nik", a, b).reshape(-1, 9)
    np.testing.assert_allclose(stacked(planes.transpose_times(ra, rb)), product, atol=1e-14)
    np.testing.assert_allclose(stacked(planes.cross(tv, tw)), np.cross(v, w), atol=1e-14)
    np.testing.assert_allclose(planes.dot(tv, tw).numpy(), (v * w).sum(1), atol=1e-14)


def test_length_and_direction_of_a_vector_that_vanishes():
    x = torch.tensor([0.0, 1e-20, 3.0], dtype=torch.float32, requires_grad=True)
    zero = torch.zeros(3)
    length, direction = planes.length_and_direction((zero, x, zero))
    np.testing.assert_array_equal(length.detach().numpy(), [0.0, 0.0, 3.0])
    np.testing.assert_array_equal(stacked([part.detach() for part in direction]), [[1, 0, 0], [1, 0, 0], [0, 1, 0]])
    (gradient,) = torch.autograd.grad(length.sum() + direction[1].sum(), x)
    assert torch.isfinite(gradient).all()


def test_powers_of_depths_that_are_all_none_are_the_zeros_of_a_look_at_each():
    exponent = torch.tensor(1.2)
    for depth in (torch.tensor([0.0, -0.0, -torch.inf, -1e-3]), torch.tensor([0.0, torch.nan]), torch.tensor([0.0, 1e-3])):
        with torch.no_grad():
            found = planes.power(depth, exponent)
        assert found.numpy().tobytes() == planes.power(depth, exponent).numpy().tobytes()
