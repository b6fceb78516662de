"""Statistics of up to a million samples of each stage. Bounds are theoretical: 5 standard errors, or as unlikely (`KOLMOGOROV`)."""

from typing import Any

import numpy as np
import pytest
import torch
from oracles.noise import DT, SIDE, million, reading, variance_error
from oracles.noise import NUM as N
from oracles.setups.signals import KOLMOGOROV, MM, Noise, correlation, standard_errors, uniform_distance
from torch import Tensor

from tgdsl.sensors.noise import pipeline, random
from tgdsl.sensors.noise.stage import Now
from tgdsl.sensors.noise.stages import Radius


def test_white_noise_is_white():
    noise, other = million({"white_noise": 1.0}), million({"white_noise": 1.0}, name="grip")
    first, second, third = (reading(noise) for _ in range(3))
    noise.reset()
    correlations = {
        "taxels": correlation(first[:, :-1], first[:, 1:]),
        "environments": correlation(first[:-1], first[1:]),
        "steps": correlation(first, second),
        "two steps": correlation(first, third),
        "episodes": correlation(first, reading(noise)),
        "sensors": correlation(first, reading(other)),
        "channels": correlation(*Noise({"white_noise": 1.0}, SIDE, ("a", "b"), num_envs=SIDE).read(0.0).numpy().T),
    }
    assert max(map(abs, correlations.values())) < 5, correlations


def test_drift_is_a_random_walk():
    """Its steps are independent of one another and of white noise; a reset restarts some walks."""
    sigma = 1e-3
    noise, white = million({"drift": sigma}), million({"white_noise": 1.0})
    walk, steps, noises = np.zeros((SIDE, SIDE)), [], []
    for _ in range(8):
        level = reading(noise)
        steps.append(level - walk)
        noises.append(reading(white))
        walk = level
    for lag in (1, 2, 7):
        assert abs(correlation(steps[0], steps[lag])) < 5
    assert abs(correlation(steps[-1], walk - steps[-1])) < 5
    assert abs(correlation(steps[-1][:, :-1], steps[-1][:, 1:])) < 5
    assert abs(correlation(steps[-1], noises[-1])) < 5
    assert abs(correlation(steps[-1] ** 2, noises[-1] ** 2)) < 5
    noise.reset(np.arange(0, SIDE, 2))
    level = reading(noise)
    assert variance_error(level[::2], sigma**2) < 5
    assert variance_error(level[1::2], 9 * sigma**2) < 5


def test_dead_taxels_have_their_share_and_stay_stuck_until_a_reset():
    share, low, high = 0.05, -1.0, 3.0
    knobs = {"dead_probability": share, "dead_range": [low, high]}
    noise = Noise(knobs, SIDE, ("a", "b"), num_envs=SIDE, dtype=torch.float32)
    first = noise.read(100.0).double().numpy()
    is_dead = first[..., 0] != 100
    assert (is_dead == (first[..., 1] != 100)).all()
    assert standard_errors(is_dead.mean(), share, np.sqrt(share * (1 - share) / N)) < 5
    counts, spread = is_dead.sum(axis=1), SIDE * share * (1 - share)
    assert standard_errors(counts.var(), spread, spread * np.sqrt(2 / SIDE)) < 5
    stuck = first[is_dead]
    assert stuck.min() >= low and stuck.max() <= high
    for channel in stuck.T:
        assert uniform_distance(channel, low, high) < KOLMOGOROV
    assert (stuck[:, 0] == stuck[:, 1]).all()  # one number per taxel, as in the paper
    for signal in (100.0, 7.0):
        later = noise.read(signal).double().numpy()
        assert (later[is_dead] == stuck).all() and (later[~is_dead] == signal).all()
    noise.reset(slice(SIDE // 2))
    new = noise.read(100.0).double().numpy()
    assert (new[SIDE // 2 :] == first[SIDE // 2 :]).all()
    is_dead_now, was_dead = new[: SIDE // 2, :, 0] != 100, is_dead[: SIDE // 2]
    assert standard_errors(is_dead_now.mean(), share, np.sqrt(share * (1 - share) / is_dead_now.size)) < 5
    assert standard_errors((is_dead_now & was_dead).mean(), share**2, share / np.sqrt(is_dead_now.size)) < 5
    both = is_dead_now & was_dead
    assert (new[: SIDE // 2][both] != first[: SIDE // 2][both]).all()


def test_gains_are_uniform_and_held_until_a_reset():
    noise = million({"gain": [0.85, 1.15]}, dtype=torch.float64)
    first = reading(noise, 1.0)
    assert first.min() > 0.85 and first.max() < 1.15
    assert uniform_distance(first, 0.85, 1.15) < KOLMOGOROV
    np.testing.assert_allclose(reading(noise, -2.0), -2 * first, rtol=1e-15)
    noise.reset(np.arange(SIDE) < 500)
    second = reading(noise, 1.0)
    assert (second[500:] == first[500:]).all() and abs(correlation(second[:500], first[:500])) < 5
    assert uniform_distance(second[:500], 0.85, 1.15) < KOLMOGOROV
    assert abs(correlation(first[:, 1:], first[:, :-1])) < 5
    assert abs(correlation(first[1:], first[:-1])) < 5


def test_radii_are_uniform_at_each_step():
    noise, like = million({"radius_noise": 0.3 * MM}), torch.zeros(SIDE, SIDE)
    shifts = []
    for _ in range(2):
        now = noise.now()
        (radius,) = pipeline.draw(noise.stages, noise.constants, now)
        assert isinstance(radius, Radius)
        shifts.append(radius.shift(now, like).double().numpy())
        noise.read(0.0)
    for shift in shifts:
        assert np.abs(shift).max() <= 0.3 * MM
        assert uniform_distance(shift, -0.3 * MM, 0.3 * MM) < KOLMOGOROV
    assert abs(correlation(*shifts)) < 5
    assert abs(correlation(shifts[0][:, 1:], shifts[0][:, :-1])) < 5


@pytest.mark.parametrize("parts", [0.1, 1.0, 10.0])
def test_ages_are_independent(parts):
    dt, low, high, num_envs = DT / parts, 10e-3, 18e-3, 1000
    noise = Noise({"read_delay": low, "jitter": high - low}, 2, num_envs=num_envs, dt=dt)
    ages, first = [], int(np.ceil(high / dt))
    for call in range(first + 100):
        readings = noise.read(call * dt, dt)
        if call >= first:
            assert torch.equal(readings[:, 0], readings[:, 1])
            ages.append(call * dt - readings[:, 0, 0].numpy())
    sample = np.stack(ages)
    assert abs(correlation(sample[1:], sample[:-1])) < 5
    assert abs(correlation(sample[:, 1:], sample[:, :-1])) < 5


def test_ages_never_reach_before_the_first_call():
    noise = Noise({"read_delay": 10e-3, "jitter": 8e-3}, 1, num_envs=1000, dt=DT)
    for episode in range(3):
        for call in range(20):
            readings = noise.read(100.0 * episode + call * DT, DT)
            assert (readings >= 100 * episode).all()
            assert call > 4 or (readings == 100 * episode).all()
        noise.reset()


def test_ranges_are_uniform_over_environments():
    knobs = {
        "bias": [-1, 1], "white_noise": [0, 2], "drift": [3, 4], "quantization": [0.1, 0.2], "read_delay": [0, 0.1], "jitter": [0, 1],
        "dead_probability": [0.2, 0.4], "gain": [[0.5, 0.6], [1, 2]], "radius_noise": [0, 1e-3], "dead_range": [[-1, 0], [2, 3]],
        "hysteresis": {"strength": [0, 1], "time_constant": [0.1, 0.2]}, "crosstalk": {"strength": [0, 0.5], "sigma": [1e-3, 2e-3]},
    }  # fmt: skip
    noise = Noise(knobs, 1, num_envs=N // 10, dt=2.0)
    numbers = pipeline.draws_of(noise.stages)
    drawn = {name for name, value in noise.constants.items() if name in numbers and value.ndim == 3}
    assert drawn == set(pipeline.draws_of(pipeline.STAGES)) - {"release_threshold"}

    def values() -> dict[str, Tensor]:
        stages = pipeline.draw(noise.stages, noise.constants, noise.now())
        return {name: getattr(stage, name) for stage in stages for name in stage.numbers}

    initial = values()
    noise.reset()
    after = values()
    samples = {name: initial[name].numpy().ravel() for name in sorted(drawn)}
    for name, sample in samples.items():
        low, high = noise.constants[name].flatten().tolist()
        assert sample.shape == (N // 10,)
        assert uniform_distance(sample, low, high) < KOLMOGOROV, name
        assert abs(correlation(sample[1:], sample[:-1])) < 5, name
        assert abs(correlation(sample, after[name].numpy().ravel())) < 5, name
    names = list(samples)
    correlations = {(a, b): correlation(samples[a], samples[b]) for i, a in enumerate(names) for b in names[:i]}
    assert max(map(abs, correlations.values())) < 5, correlations


def advance(
    noise: Noise, signal: Tensor, dt: Tensor, step: Tensor, memory: dict[str, Tensor]
) -> tuple[Tensor, dict[str, Tensor]]:
    """Advance all environments by a call, as a pure function of (env, row) that compiles to one kernel."""
    signal, dt = signal.to(noise.dtype), dt.to(noise.dtype)
    (streams,) = random.streams(
        torch.tensor([noise.key], dtype=torch.int32), noise.env, step.expand(noise.num_envs), noise.episode
    )
    ages = memory["ages"] + dt
    steps = step.expand(noise.num_envs)[:, None]
    now = Now(dt, steps, steps, ages, None, None, streams)
    stages, past = pipeline.draw(noise.stages, noise.constants, now), {key: memory[key] for key in noise.memory}
    disturbed, new = pipeline.disturb(signal[:, None], stages, "", past, now)
    place = (step % memory["ring"].shape[1])[None]
    ring = memory["ring"].index_copy(1, place, new["ring"][:, None])
    ages = torch.cat([torch.zeros_like(ages[:, :1]), ages[:, :-1]], dim=1)
    return disturbed[:, 0].double(), {**new, "ring": ring, "ages": ages}


@pytest.mark.slow
def test_many_steps_in_float32_stay_near_float64():
    """Drift, hysteresis and delay of a varying input at a varying dt, for 20,000 steps; two calls per graph, for speed."""
    knobs = {
        "drift": 1e-3, "hysteresis": {"strength": 0.8, "time_constant": 0.05}, "read_delay": 9e-3, "jitter": 4e-3,
    }  # fmt: skip
    pair = [Noise(knobs, 2, num_envs=2, dt=1e-3, dtype=dtype) for dtype in (torch.float32, torch.float64)]
    parts, calls, rng = 2, 10_000, np.random.default_rng(0)
    dt = rng.uniform(1e-3, 3e-3, (calls, parts))
    time = np.cumsum(dt).reshape(*dt.shape, 1, 1)
    press = np.clip(3 * np.sin(time * [[1.0, 3.1], [0.2, 17.0]]), -1, 1) + rng.normal(0, 0.02, (*dt.shape, 2, 2))

    def several(signal: Tensor, dt: Tensor, step: Tensor, memory: list[dict[str, Tensor]]) -> tuple[Tensor, Any]:
        readings = []
        for k in range(parts):
            results = [
                advance(*arguments, step + k, past)
                for arguments, past in zip([(n, signal[k], dt[k]) for n in pair], memory, strict=True)
            ]
            memory = [new for _, new in results]
            readings.append(torch.stack([reading for reading, _ in results]))
        return torch.stack(readings, dim=1), memory

    torch.compiler.reset()
    run = torch.compile(several, fullgraph=True, dynamic=False, options={"cpp.simdlen": 1, "cpp.threads": 1})
    memory = [{**{key: held.nan_to_num() for key, held in n.memory.items()}, "ages": n.ages} for n in pair]
    signals, dts = torch.from_numpy(press), torch.from_numpy(dt)
    error = largest = torch.zeros((), dtype=torch.float64)
    with torch.no_grad():
        for i in range(calls):
            readings, memory = run(signals[i], dts[i], torch.tensor(parts * i), memory)
            error = torch.maximum(error, (readings[0] - readings[1]).abs().max())
            largest = torch.maximum(largest, readings[1].abs().max())
    assert 1 < largest < 20
    assert error < 1e-3 * largest
