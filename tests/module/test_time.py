"""Time: the rate of a sensor, its delay, and the time step of a state."""

import warnings
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch
from pressed_probes import pad, pressed, ramp

from tgdsl.errors import StateError
from tgdsl.module.sensing import _phase

LATE = {"read_delay": "25 ms"}


@pytest.fixture
def build(tmp_path):
    return partial(pad, tmp_path)


def run(touch, depths, dts, name="s") -> np.ndarray:
    """Return the first probe's reading at each call (call, env)."""
    return np.array([touch(pressed(touch, depth, dt))[name][..., 0, 0].numpy() for depth, dt in zip(depths, dts, strict=True)])


def sample_indices(dts, rate) -> list[int]:
    """Return the call whose sample is read at each call, in exact arithmetic.

    The k-th sample is due k/rate after the first call, and taken at the call within half a step of that.
    """
    indices, time, last_sample = [], Fraction(0), -1
    for i, dt in enumerate(map(Fraction, dts)):
        time += dt if i else 0
        due = 0 if i == 0 else int((time + dt / 2) * Fraction(rate))
        if due > last_sample:
            last_sample = due
            indices.append(i)
        else:
            indices.append(indices[-1])
    return indices


# rate


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sensor_at_50_hz_holds_its_sample_for_four_calls_at_200_hz(build, dtype):
    touch, depths = build(dtype, s={"rate": 50}), ramp(40)
    readings = run(touch, depths, [0.005] * 40)
    np.testing.assert_allclose(readings[:, 0], np.repeat(depths[::4, 0], 4), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "dt", "every"), [(50, 0.001, 20), (30, 1 / 240, 8)])
def test_the_phase_does_not_drift(build, rate, dt, every):
    """Over 10⁵ calls in float32, every sample is taken at the right call."""
    touch = build(torch.float32, s={"rate": rate})
    memory = touch.memory.tensors(1, dt, touch.dtype, touch.device)
    phase, step, sampled_calls = torch.zeros(1), torch.tensor(dt), []
    for call in range(100_000):
        now = touch.memory.clock.nows({**memory, "clock/step": torch.tensor([call]), "s:sample/phase": phase}, step)["s"]
        assert now.is_sample is not None and now.period is not None
        if now.is_sample.item():
            sampled_calls.append(call)
        phase = _phase(phase, now.period, now)
    assert sampled_calls == list(range(0, 100_000, every))


@pytest.mark.parametrize("rate", [200, 333, 1000, 1e5])
def test_a_rate_above_the_calls_samples_at_every_call(build, rate):
    touch, depths = build(s={"rate": rate}), ramp(30)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        np.testing.assert_allclose(run(touch, depths, [0.005] * 30), depths, atol=1e-12)
    assert [f'"s" has a rate of {rate:g} Hz' in str(warning.message) for warning in caught] == [True] * (rate > 200)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [37, 60, 120])
def test_a_rate_that_does_not_divide_the_calls_is_kept_on_average(build, rate):
    """Samples are taken at the nearest call, so their mean rate is the sensor's rate."""
    dts = [Fraction(1, 200)] * 400
    read = sample_indices(dts, rate)
    assert len(set(read)) == pytest.approx(400 * rate / 200, abs=1)
    touch, depths = build(s={"rate": rate}), ramp(400)
    np.testing.assert_allclose(run(touch, depths, [float(dt) for dt in dts])[:, 0], depths[read, 0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_uneven_steps_sample_at_the_nearest_call(build, seed):
    rng = np.random.default_rng(seed)
    dts = [Fraction(int(value), 1_000_000) for value in rng.integers(4500, 5500, 300)]
    touch, depths = build(s={"rate": 61}), ramp(300)
    readings = run(touch, depths, [float(dt) for dt in dts])[:, 0]
    np.testing.assert_allclose(readings, depths[sample_indices(dts, 61), 0], atol=1e-12)


def test_a_short_step_after_a_long_one_takes_no_second_sample(build):
    """The sample due at 25 ms is taken at 20 ms; it is not taken again 1 ms later, nor at 25 ms."""
    dts = [Fraction(ms, 1000) for ms in (20, 20, 1, 1, 1, 1, 1, 1, 1, 1)]
    assert sample_indices(dts, 40) == [0] + [1] * 9
    touch, depths = build(s={"rate": 40}), ramp(10)
    readings = run(touch, depths, [float(dt) for dt in dts])[:, 0]
    np.testing.assert_allclose(readings, depths[sample_indices(dts, 40), 0], atol=1e-12)


def test_reset_samples_and_restarts_the_phase_only_in_its_environments(build):
    touch, depths = build(s={"rate": 50}), ramp(16, 3)
    readings = run(touch, depths[:6], [0.005] * 6)
    touch.reset([1])
    readings = np.concatenate([readings, run(touch, depths[6:], [0.005] * 10)])
    for env in (0, 2):
        np.testing.assert_allclose(readings[:, env], np.repeat(depths[::4, env], 4), atol=1e-12)
    sampled_calls = [0, 0, 0, 0, 4, 4, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14]
    np.testing.assert_allclose(readings[:, 1], depths[sampled_calls, 1], atol=1e-12)


def test_noise_is_drawn_once_per_sample(build):
    """White noise is constant while a sample is held; a random walk takes one step per sample: var = σ² n."""
    num, every, sigma = 41, 4, 1e-3
    touch = build(s={"rate": 50, "noise": {"drift": sigma}}, w={"rate": 50, "noise": {"white_noise": sigma}})
    state = pressed(touch, np.full(3000, 1e-3), 0.005)
    walk, white = [], []
    for _ in range(num):
        readings = touch(state)
        walk.append(readings["s"].flatten().numpy())
        white.append(readings["w"].flatten().numpy())
    for series in (walk, white):
        for start in range(0, num, every):
            assert all(np.array_equal(series[start], other) for other in series[start : start + every])
        assert not np.isclose(series[0], series[every]).any()
    steps = np.diff(np.array(walk[::every]), axis=0) / sigma
    np.testing.assert_allclose(steps.var(axis=1), 1, atol=5 * np.sqrt(2 / steps.shape[1]))  # five standard deviations
    spread = np.var(walk[-1] / sigma)
    assert spread == pytest.approx(11, abs=5 * 11 * np.sqrt(2 / steps.shape[1]))


@pytest.mark.parametrize(
    "sensor", [{"rate": 50}, {"noise": LATE}, {"noise": {"hysteresis": {"strength": 1, "time_constant": 1}}}]
)
def test_an_invalid_dt_is_named(build, sensor):
    touch = build(s=sensor)
    assert "dt" in touch.inputs.fields
    with pytest.raises(StateError, match=r"^SceneState lacks dt, .*; set `state.dt` to the seconds since the last call$"):
        touch(pressed(touch, 1e-3))
    with pytest.raises(StateError, match=r"^SceneState.dt has shape \(1, 1\), expected one number"):
        touch(pressed(touch, 1e-3, torch.full((1, 1), 0.005)))
    for dt in (0.0, -0.005, float("nan"), float("inf")):
        with pytest.raises(StateError, match=rf"^SceneState.dt is {dt}, expected a finite time above 0 s$"):
            touch(pressed(touch, 1e-3, dt))
    assert touch.num_envs is None  # a refused state leaves no memory
    touch(pressed(touch, 1e-3, 0.005))


def test_a_module_without_dt_accepts_any(build):
    touch = build(s={"noise": {"white_noise": 1e-3, "drift": 1e-4}, "history": 2})
    assert "dt" not in touch.inputs.fields
    for dt in (None, 0.0, -1.0):
        touch(pressed(touch, 1e-3, dt))


def test_a_dt_too_short_for_the_ring_is_named(build):
    touch = build(s={"noise": LATE}, t={"noise": {"read_delay": "5 ms", "jitter": "10 ms"}})
    touch(pressed(touch, 1e-3, 0.010))
    with pytest.raises(StateError) as caught:
        touch(pressed(touch, 1e-3, 0.005))
    message = 'SceneState.dt is 0.005 s, shorter than at first: the ring of "s" does not hold 0.025 s of so many calls'
    hint = "begin with the shortest dt, or call `touch.free()` to forget the past and start with this dt"
    assert str(caught.value) == f"{message}; {hint}"
    touch(pressed(touch, 1e-3, 0.010))
    touch(pressed(touch, 1e-3, 0.009))  # three calls, as at first
    touch.free()
    touch(pressed(touch, 1e-3, 0.005))


@pytest.mark.parametrize("dt", [0.001, 0.005, 0.010, 0.0125, 0.025, 0.04])
def test_a_delay_is_exact_for_any_dt(build, dt):
    """A ramp read 25 ms late: the closed form x(t − Δ), constant before the start."""
    touch, num = build(s={"noise": LATE}), 60
    times = dt * np.arange(num)
    depths = (1e-3 + 2e-3 * times / times[-1])[:, None]
    expected = 1e-3 + 2e-3 * np.maximum(times - 0.025, 0) / times[-1]
    np.testing.assert_allclose(run(touch, depths, [dt] * num)[:, 0], expected, atol=1e-13)


def test_a_longer_dt_is_exact_once_it_fills_the_ring(build):
    dts = [0.005] * 10 + [0.010] * 20
    times = np.cumsum(dts)
    touch = build(s={"noise": LATE})
    readings = run(touch, (1e-3 + 1e-3 * times)[:, None], dts)[:, 0]
    np.testing.assert_allclose(readings[:10], 1e-3 + 1e-3 * np.maximum(times[:10] - 0.025, times[0]), atol=1e-13)
    np.testing.assert_allclose(readings[13:], 1e-3 + 1e-3 * (times[13:] - 0.025), atol=1e-13)


def test_a_delay_is_exact_while_dt_changes(build):
    """Remembered calls keep their own time steps."""
    dts = [0.005] * 10 + [0.010, 0.005] * 5 + [0.010] * 10
    times = np.cumsum(dts)
    touch = build(s={"noise": LATE})
    readings = run(touch, (1e-3 + 1e-2 * times)[:, None], dts)[:, 0]
    np.testing.assert_allclose(readings, 1e-3 + 1e-2 * np.maximum(times - 0.025, times[0]), atol=1e-13)


def test_hysteresis_is_exact_for_uneven_steps(build):
    """A ramp in uneven steps: x + β v τ (1 − exp(−t/τ)), the Maxwell branch's closed form."""
    strength, tau = 0.5, 0.05
    noise = {"hysteresis": {"strength": strength, "time_constant": tau}}
    dts = np.random.default_rng(0).uniform(1e-3, 3e-2, 60)
    times = np.cumsum(dts) - dts[0]
    speed = 2e-3 / times[-1]
    readings = run(build(s={"noise": noise}), (1e-3 + speed * times)[:, None], dts)[:, 0]
    expected = 1e-3 + speed * times + strength * speed * tau * (1 - np.exp(-times / tau))
    np.testing.assert_allclose(readings, expected, atol=1e-12)


def test_the_clock_counts_calls_and_episodes(build):
    touch = build(s={"noise": {"white_noise": 1e-3}})
    for call in range(7):
        touch(pressed(touch, [1e-3] * 3))
        if call == 2:
            touch.reset([0, 2])
        if call == 4:
            touch.reset(torch.tensor([True, False, False]))
    clock = touch.memory.clock
    assert clock.get_buffer("step").tolist() == [7, 7, 7]
    assert clock.get_buffer("episode").tolist() == [2, 0, 1]
    assert clock.get_buffer("reset_step").tolist() == [5, 0, 3]
