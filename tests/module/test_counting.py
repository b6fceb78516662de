"""Counted operations against known numbers."""

import math

import torch

from tgdsl.geometry.bvh import TriangleMesh, nearest
from tgdsl.module.explain import OperationCounter


def num_operations(compute) -> int:
    with torch.no_grad(), OperationCounter() as counter:
        compute()
    return counter.elements


def test_a_matrix_product_takes_two_operations_for_each_factor_pair():
    a, b = torch.zeros(3, 5), torch.zeros(5, 7)
    assert num_operations(lambda: a @ b) == 2 * 3 * 5 * 7
    assert num_operations(lambda: torch.bmm(a[None], b[None])) == 2 * 3 * 5 * 7


def test_other_operations_count_one_per_written_element():
    a = torch.zeros(3, 5)
    assert num_operations(lambda: a + 1) == 15
    assert num_operations(lambda: a.max(dim=1)) == 3
    assert num_operations(lambda: a.T.unsqueeze(0)[0]) == 0


def test_a_fourier_transform_takes_n_log_n():
    a = torch.zeros(16, 32)
    assert num_operations(lambda: torch.fft.rfft2(a)) == int(2.5 * 512 * math.log2(512))
    wave = torch.fft.rfft2(a)
    assert 0 < num_operations(lambda: torch.fft.irfft2(wave, s=(16, 32))) < 4 * 512 * math.log2(512)


def test_a_nearest_search_over_more_triangles_takes_more():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64).numpy()
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    few = TriangleMesh(corners, torch.tensor(faces).numpy())
    many = TriangleMesh(corners, torch.tensor(faces * 64).numpy())
    point = (torch.zeros(9),) * 3
    num_few, num_many = (num_operations(lambda mesh=mesh: nearest(point, [mesh], 1.0)) for mesh in (few, many))
    assert 9 * 100 < num_few < num_many < 9 * 10000
