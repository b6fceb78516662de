"""Counted random numbers: uniform, normal and whole; independent of each other, of the batch and of the order of calls."""

import numpy as np
import pytest
import torch

from tgdsl.rl.draws import Draws, within
from tgdsl.sensors.noise.random import FACTORS, SHIFTS, UNIFORM_BITS, mix, mix_on_host, sensor_key

COUNT = 200_000


def ones(num: int) -> torch.Tensor:
    return torch.ones(num, dtype=torch.int64)


def test_uniform_and_normal_numbers_have_their_moments():
    """Mean, variance and fourth moment lie within 5 standard errors."""
    draws = Draws(0, COUNT)
    uniform = draws.uniform("a", ones(COUNT), 2, -1.0, 3.0).numpy()
    assert uniform.min() >= -1 and uniform.max() <= 3
    assert abs(uniform.mean() - 1) < 5 * 4 / np.sqrt(12 * uniform.size)
    assert abs(uniform.var() - 16 / 12) < 5 * 16 / np.sqrt(180 * uniform.size)
    normal = draws.normal("b", ones(COUNT), 3).numpy()
    assert normal.shape == (COUNT, 3)
    assert abs(normal.mean()) < 5 / np.sqrt(normal.size) and abs(normal.var() - 1) < 5 * np.sqrt(2 / normal.size)
    assert abs((normal**4).mean() - 3) < 5 * np.sqrt(96 / normal.size)
    assert np.abs(np.corrcoef(np.concatenate([uniform, normal], axis=1).T) - np.eye(5)).max() < 5 / np.sqrt(COUNT)


def test_whole_numbers_include_both_bounds_equally_often():
    numbers = Draws(0, COUNT).integers("c", ones(COUNT), 1, -2, 2).flatten()
    counts = torch.bincount(numbers + 2, minlength=5)
    assert len(counts) == 5
    assert (counts - COUNT / 5).abs().max() < 5 * np.sqrt(COUNT * 0.2 * 0.8)


@pytest.mark.parametrize("other", ["what", "count", "high count", "env", "seed"])
def test_numbers_differ_by_purpose_count_environment_and_seed(other):
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


def test_numbers_do_not_depend_on_batch_order_or_amount():
    whole = Draws(3, 8)
    numbers = whole.uniform("x", torch.arange(8), 4)
    halves = [Draws(3, 4, first_env=first).uniform("x", torch.arange(first, first + 4), 4) for first in (0, 4)]
    assert torch.equal(numbers, torch.cat(halves))
    late = Draws(3, 8)
    late.normal("y", ones(8), 5)
    assert torch.equal(late.uniform("x", torch.arange(8), 2), numbers[:, :2])


def hashed_number(seed: int, purpose: str, env: int, count: int, index: int) -> float:
    """Return the number in (0, 1) that the definition gives, in Python's integers."""
    mask = 2**32 - 1

    def mix(word: int) -> int:
        for shift, factor in zip(SHIFTS, (*FACTORS, 1), strict=True):
            word = ((word ^ (word >> shift)) * factor) & mask
        return word

    first, second = (
        mix(mix(mix((env ^ key) & mask) ^ (count & mask)) ^ mix(count >> 32))
        for key in (k & mask for k in sensor_key(seed, purpose))
    )
    word = mix(index ^ first) ^ second
    return ((word >> (32 - UNIFORM_BITS)) + 0.5) / 2**UNIFORM_BITS


def test_numbers_for_several_purposes_equal_separate_calls():
    """Against the definition in plain Python, with counts beyond 32 bits, before and after reseeding."""
    draws, counts = Draws(3, 5, first_env=7), torch.tensor([0, 1, (5 << 32) + 2, 2**40, 9])
    for seed in (3, 4):
        draws.reseed(seed)
        shares = draws.shares({"a": 3, "b": 1, "c": 2}, counts)
        for purpose, share in shares.items():
            expected = [
                [hashed_number(seed, purpose, 7 + e, int(counts[e]), i) for i in range(share.shape[1])] for e in range(5)
            ]
            np.testing.assert_array_equal(share.numpy(), np.float32(expected))
            assert torch.equal(draws.uniform(purpose, counts, share.shape[1], -1.0, 2.0), within(share, -1.0, 2.0))


def test_torch_and_numpy_mix_words_identically():
    """For all shapes, including empty and non-contiguous tensors."""
    generator = torch.Generator().manual_seed(0)
    word = torch.randint(-(2**31), 2**31, (40, 30, 2), generator=generator).to(torch.int32)
    for words in (word, word[:, 3:7].transpose(0, 1), word[..., 1], word[:0]):
        mixed = mix_on_host(words.numpy().view(np.uint32))
        assert mixed.dtype == np.uint32
        np.testing.assert_array_equal(mixed.view(np.int32), mix(words).numpy())
    assert word.min() < 0 < word.max()


@pytest.mark.parametrize("is_compiled", [False, True])
def test_numbers_drawn_ahead_equal_separate_calls(is_compiled):
    """While counters advance, restart, go back or stay, and after reseeding."""
    draws, plain, counts = Draws(2, 4), Draws(2, 4), torch.arange(4) + (3 << 32)
    draws._is_on_host = not is_compiled
    for call in range(24):
        if call in (4, 5, 13):
            counts[call % 4] = (call + 9) << 32
        if call == 9:
            counts -= 2
        if call == 17:
            draws.reseed(5), plain.reseed(5)
        shares = draws.shares_ahead("noise", counts, 3, ahead=5)
        assert torch.equal(shares, plain.shares({"noise": 3}, counts)["noise"]), call
        counts += call != 11
    assert torch.equal(draws.shares_ahead("other", counts, 2, ahead=5), plain.shares({"other": 2}, counts)["other"])
