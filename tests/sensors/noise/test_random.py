"""Random numbers by counting: the batched hash against one on unsigned words, and the statistics of both."""

import numpy as np
import pytest
import torch
from oracles.setups.signals import KOLMOGOROV, correlation, normal_distance, standard_errors, uniform_distance

from tgdsl.sensors.noise import random, reference

NORMAL = 2e-6
"""Sine and cosine of the batched form are series, to 3.1e-7; the radius is at most 5.4; float32 rounds about as much."""
N = 10**6
STEPS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 5 * 2**32 + 7)
PURPOSES = tuple(range(6))


def batched(seed=0, name="touch", env=1, step=0, episode=0, purpose=random.READING, count=N, first_env=0) -> torch.Tensor:
    """Return words (env, count) of a stream."""
    keys = torch.tensor([random.sensor_key(seed, sensor) for sensor in ("another", name)], dtype=torch.int32)
    envs, episodes = torch.arange(env) + first_env, torch.full((env,), episode)
    stream = random.streams(keys, envs, torch.full((env,), step), episodes)[1][purpose]
    return random.words(stream, torch.arange(count, dtype=torch.int32))


def uniforms(**options) -> np.ndarray:
    return random.uniform(batched(**options), torch.float64).numpy()


@pytest.mark.parametrize("purpose", PURPOSES)
def test_words_equal_the_reference(purpose):
    index = np.arange(70, dtype=np.uint64)
    for seed, name, first in ((0, "touch", 0), (-3, "grip", 2**20), (2**40, "", 2**31 + 5)):
        key = random.sensor_key(seed, name)
        for step, episode in zip(STEPS, reversed(STEPS), strict=True):
            words = batched(seed, name, 3, step, episode, purpose, 70, first)
            counter = step if purpose in random.PER_STEP else episode
            for env in range(3):
                expected = reference.words(key, first + env, counter, purpose, index)
                np.testing.assert_array_equal(words[env].numpy().view(np.uint32), expected)


def test_mix_is_a_bijection():
    """Its shifts and odd products are invertible, so no two words collide."""
    word = np.arange(0, 2**32, 4099, dtype=np.uint64)
    mixed = reference.mix(word)
    for shift, factor in list(zip(random.SHIFTS, (*random.FACTORS, 1), strict=True))[::-1]:
        mixed = mixed * np.uint64(pow(factor, -1, 2**32)) & np.uint64(reference.WORD)
        mixed = mixed ^ (mixed >> np.uint64(shift)) ^ (mixed >> np.uint64(2 * shift))
        assert 3 * shift >= 32
    np.testing.assert_array_equal(mixed, word)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_uniform_and_normal_numbers_equal_the_reference(dtype):
    word = torch.cat([batched(count=10**5)[0], torch.tensor([0, -1, 1, 2, 3, -(2**31), 2**31 - 1], dtype=torch.int32)])
    unsigned = word.numpy().view(np.uint32).astype(np.uint64)
    np.testing.assert_array_equal(random.uniform(word, dtype).double().numpy(), reference.uniform(unsigned))
    for numbers, expected in zip(random.normal_pair(word, dtype), reference.normal_pair(unsigned), strict=True):
        np.testing.assert_allclose(numbers.numpy(), expected, rtol=0, atol=NORMAL)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_are_finite_and_off_the_ends(dtype):
    ends = torch.tensor([0, -1, -(2**31), 2**31 - 1], dtype=torch.int32)
    uniform = random.uniform(ends, dtype)
    assert ((uniform > 0) & (uniform < 1)).all()
    for numbers in random.normal_pair(ends, dtype):
        assert (numbers.abs() <= np.sqrt(2 * np.log(2.0**21)) + 1e-5).all()


def test_normal_numbers_in_bfloat16_are_finite():
    """A uniform number then rounds to 1, whose logarithm is 0."""
    for numbers in random.normal_pair(torch.arange(-(2**31), 2**31, 4099).to(torch.int32), torch.bfloat16):
        assert numbers.isfinite().all() and numbers.abs().max() > 3


def test_numbers_do_not_depend_on_the_rest_of_the_batch():
    """Splitting a batch, more taxels and other environments change no number."""
    whole = batched(env=6, count=50, step=9)
    assert torch.equal(whole[4:], batched(env=2, first_env=4, count=50, step=9))
    assert torch.equal(whole[:, :20], batched(env=6, count=20, step=9))


def test_keys_of_seeds_and_names_are_distinct():
    keys = [random.sensor_key(seed, name) for seed in range(-50, 50) for name in ("touch", "grip", "", "1touch")]
    assert len({half for key in keys for half in key}) == 2 * len(keys)
    assert random.sensor_key(1, "2touch") != random.sensor_key(12, "touch")


@pytest.mark.parametrize("along", ["taxel", "env", "step", "episode", "seed"])
def test_each_bit_is_set_half_the_time(along):
    words = {
        "taxel": lambda: batched(count=10**5),
        "env": lambda: batched(env=10**5, count=1),
        "step": lambda: torch.cat([batched(env=500, count=1, step=i) for i in range(200)]),
        "episode": lambda: torch.cat([batched(env=500, count=1, purpose=random.GAIN, episode=i) for i in range(200)]),
        "seed": lambda: torch.cat([batched(seed=i, env=10, count=100) for i in range(100)]),
    }[along]()
    assert flips(words, torch.zeros_like(words)) < 5


def flips(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return by how many standard errors the bit that flips most or least is off one half."""
    bits = np.unpackbits((a ^ b).numpy().view(np.uint8)).reshape(-1, 32)
    return float(np.abs(bits.mean(axis=0) - 0.5).max() / (0.5 / np.sqrt(len(bits))))


def test_neighbours_differ_in_half_their_bits():
    """Each bit flips half the time between neighbouring taxels, environments, steps, episodes, purposes, sensors and seeds."""
    base = {"env": 400, "count": 400}
    here = batched(**base)
    of_episode = batched(**base, purpose=random.GAIN)
    for distance in (1, 2, 7, 64):
        assert flips(here[:, :-distance], here[:, distance:]) < 5
        assert flips(here[:-distance], here[distance:]) < 5
        assert flips(here, batched(**base, step=distance)) < 5
        assert flips(here, batched(**base, step=distance << 32)) < 5
        assert flips(of_episode, batched(**base, purpose=random.GAIN, episode=distance)) < 5
        assert flips(here, batched(**base, seed=distance)) < 5
        assert flips(here, batched(**base, name=f"touch{distance}")) < 5
    for purpose in PURPOSES[1:]:
        assert flips(here, batched(**base, purpose=purpose)) < 5


def test_neighbours_are_uncorrelated():
    base = {"env": 400, "count": 400}
    here = uniforms(**base)
    of_episode = uniforms(**base, purpose=random.GAIN)
    correlations = {
        "taxels": correlation(here[:, :-1], here[:, 1:]),
        "environments": correlation(here[:-1], here[1:]),
        "steps": correlation(here, uniforms(**base, step=1)),
        "episodes": correlation(of_episode, uniforms(**base, purpose=random.GAIN, episode=1)),
        "sensors": correlation(here, uniforms(**base, name="grip")),
        "seeds": correlation(here, uniforms(**base, seed=1)),
        **{f"purpose {p}": correlation(here, uniforms(**base, purpose=p)) for p in PURPOSES[1:]},
    }
    assert max(map(abs, correlations.values())) < 5, correlations


def test_the_two_normal_numbers_of_a_word_are_independent():
    first, second = (x.numpy() for x in random.normal_pair(batched()[0], torch.float64))
    for x in (first, second, (first + second) / np.sqrt(2), (first - second) / np.sqrt(2)):
        assert normal_distance(x, 1.0) < KOLMOGOROV
    assert abs(correlation(first, second)) < 5
    assert abs(correlation(first**2, second**2)) < 5
    for moment, expected, spread in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert standard_errors((first**moment).mean(), expected, np.sqrt(spread / N)) < 5


def test_uniform_numbers_are_uniform_in_the_plane_of_neighbours():
    """χ² of pairs of neighbours in 32 × 32 cells."""
    here = uniforms(env=1000, count=1001)
    for a, b in ((here[:, :-1], here[:, 1:]), (here[:-1], here[1:])):
        counts = np.histogram2d(a.ravel(), b.ravel(), bins=32, range=[[0, 1], [0, 1]])[0]
        expected = a.size / 1024
        assert standard_errors(((counts - expected) ** 2 / expected).sum(), 1023, np.sqrt(2 * 1023)) < 5
    assert uniform_distance(here, 0, 1) < KOLMOGOROV
