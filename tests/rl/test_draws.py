"""Counted random numbers: uniform, normal and whole, independent of each other, of the batch and of the order of asking."""

import numpy as np
import pytest
import torch

from tgdsl.rl.draws import Draws

COUNT = 200_000


def ones(num: int) -> torch.Tensor:
    return torch.ones(num, dtype=torch.int64)


def test_uniform_and_normal_numbers_have_their_moments():
    """Mean, variance and fourth moment within 5 standard errors."""
    draws = Draws(0, COUNT)
    flat = draws.uniform("a", ones(COUNT), 2, -1.0, 3.0).numpy()
    assert flat.min() >= -1 and flat.max() <= 3
    assert abs(flat.mean() - 1) < 5 * 4 / np.sqrt(12 * flat.size)
    assert abs(flat.var() - 16 / 12) < 5 * 16 / np.sqrt(180 * flat.size)
    bell = draws.normal("b", ones(COUNT), 3).numpy()
    assert bell.shape == (COUNT, 3)
    assert abs(bell.mean()) < 5 / np.sqrt(bell.size) and abs(bell.var() - 1) < 5 * np.sqrt(2 / bell.size)
    assert abs((bell**4).mean() - 3) < 5 * np.sqrt(96 / bell.size)
    assert np.abs(np.corrcoef(np.concatenate([flat, bell], axis=1).T) - np.eye(5)).max() < 5 / np.sqrt(COUNT)


def test_whole_numbers_have_both_ends_and_equal_shares():
    found = Draws(0, COUNT).integers("c", ones(COUNT), 1, -2, 2).flatten()
    counts = torch.bincount(found + 2, minlength=5)
    assert len(counts) == 5
    assert (counts - COUNT / 5).abs().max() < 5 * np.sqrt(COUNT * 0.2 * 0.8)


@pytest.mark.parametrize("other", ["what", "count", "high count", "env", "seed"])
def test_another_purpose_count_environment_or_seed_has_other_numbers(other):
    num = 10_000
    first = Draws(0, num).uniform("a", ones(num), 1).numpy().ravel()
    second = {
        "what": lambda: Draws(0, num).uniform("b", ones(num), 1),
        "count": lambda: Draws(0, num).uniform("a", 2 * ones(num), 1),
        "high count": lambda: Draws(0, num).uniform("a", ones(num) + (1 << 32), 1),
        "env": lambda: Draws(0, num, first_env=num).uniform("a", ones(num), 1),
        "seed": lambda: Draws(1, num).uniform("a", ones(num), 1),
    }[other]()
    assert abs(np.corrcoef(first, second.numpy().ravel())[0, 1]) < 5 / np.sqrt(num)


def test_numbers_do_not_hang_on_batch_order_or_on_how_many_are_asked_for():
    whole = Draws(3, 8)
    numbers = whole.uniform("x", torch.arange(8), 4)
    halves = [Draws(3, 4, first_env=first).uniform("x", torch.arange(first, first + 4), 4) for first in (0, 4)]
    assert torch.equal(numbers, torch.cat(halves))
    late = Draws(3, 8)
    late.normal("y", ones(8), 5)
    assert torch.equal(late.uniform("x", torch.arange(8), 2), numbers[:, :2])
