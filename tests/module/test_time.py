"""Time: the rate of a sensor, its delay, and the time step that a scene gives."""

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


def sampled(dts, rate) -> list[int]:
    """Return which call's sample is read at each call, in exact arithmetic.

    The k-th sample is due k/rate after the first call, and taken at the call from which that is no further than half a step.
    """
    read, time, taken = [], Fraction(0), -1
    for i, dt in enumerate(map(Fraction, dts)):
        time += dt if i else 0
        due = 0 if i == 0 else int((time + dt / 2) * Fraction(rate))
        if due > taken:
            taken = due
            read.append(i)
        else:
            read.append(read[-1])
    return read


# rate


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sensor_at_50_hz_called_at_200_hz_holds_for_four_calls(build, dtype):
    touch, depths = build(dtype, s={"rate": 50}), ramp(40)
    found = run(touch, depths, [0.005] * 40)
    np.testing.assert_allclose(found[:, 0], np.repeat(depths[::4, 0], 4), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "dt", "every"), [(50, 0.001, 20), (30, 1 / 240, 8)])
def test_the_phase_does_not_drift(build, rate, dt, every):
    """Over 10⁵ calls in float32 every sample is taken at its own call."""
    touch = build(torch.float32, s={"rate": rate})
    memory = touch.memory.tensors(1, dt, touch.dtype, touch.device)
    phase, step, taken = torch.zeros(1), torch.tensor(dt), []
    for call in range(100_000):
        now = touch.memory.clock.nows({**memory, "clock/age": torch.tensor([call]), "s:sample/phase": phase}, step)["s"]
        assert now.is_sample is not None and now.period is not None
        if now.is_sample.item():
            taken.append(call)
        phase = _phase(phase, now.period, now)
    assert taken == list(range(0, 100_000, every))


@pytest.mark.parametrize("rate", [200, 333, 1000, 1e5])
def test_a_rate_above_that_of_the_calls_samples_at_every_call(build, rate):
    touch, depths = build(s={"rate": rate}), ramp(30)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        np.testing.assert_allclose(run(touch, depths, [0.005] * 30), depths, atol=1e-12)
    assert [f'"s" has a rate of {rate:g} Hz' in str(warning.message) for warning in caught] == [True] * (rate > 200)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [37, 60, 120])
def test_a_rate_that_does_not_divide_that_of_the_calls(build, rate):
    """Samples are taken at the nearest call, so their mean rate is the sensor's own."""
    dts = [Fraction(1, 200)] * 400
    read = sampled(dts, rate)
    assert len(set(read)) == pytest.approx(400 * rate / 200, abs=1)
    touch, depths = build(s={"rate": rate}), ramp(400)
    np.testing.assert_allclose(run(touch, depths, [float(dt) for dt in dts])[:, 0], depths[read, 0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_uneven_steps_that_grow_and_shrink_little(build, seed):
    rng = np.random.default_rng(seed)
    dts = [Fraction(int(value), 1_000_000) for value in rng.integers(4500, 5500, 300)]
    touch, depths = build(s={"rate": 61}), ramp(300)
    found = run(touch, depths, [float(dt) for dt in dts])[:, 0]
    np.testing.assert_allclose(found, depths[sampled(dts, 61), 0], atol=1e-12)


def test_a_short_step_after_a_long_one_takes_no_sample_again(build):
    """What was due is taken once: 20 ms after the first, for the one due after 25 ms; not again 1 ms later, nor after 25 ms."""
    dts = [Fraction(ms, 1000) for ms in (20, 20, 1, 1, 1, 1, 1, 1, 1, 1)]
    assert sampled(dts, 40) == [0] + [1] * 9
    touch, depths = build(s={"rate": 40}), ramp(10)
    found = run(touch, depths, [float(dt) for dt in dts])[:, 0]
    np.testing.assert_allclose(found, depths[sampled(dts, 40), 0], atol=1e-12)


def test_a_reset_takes_a_sample_and_starts_the_phase_there_alone(build):
    touch, depths = build(s={"rate": 50}), ramp(16, 3)
    found = run(touch, depths[:6], [0.005] * 6)
    touch.reset([1])
    found = np.concatenate([found, run(touch, depths[6:], [0.005] * 10)])
    for env in (0, 2):
        np.testing.assert_allclose(found[:, env], np.repeat(depths[::4, env], 4), atol=1e-12)
    read = [0, 0, 0, 0, 4, 4, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14]
    np.testing.assert_allclose(found[:, 1], depths[read, 1], atol=1e-12)


def test_noise_is_drawn_once_per_sample(build):
    """White noise stays while a sample is held, and a random walk makes one step per sample: var = σ² n over samples."""
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
def test_a_wrong_dt_is_named(build, sensor):
    touch = build(s=sensor)
    assert "dt" in touch.inputs.fields
    with pytest.raises(StateError, match=r"^SceneState lacks dt, .*; set `state.dt` to the seconds since the last call$"):
        touch(pressed(touch, 1e-3))
    with pytest.raises(StateError, match=r"^SceneState.dt has shape \(1, 1\), expected one number"):
        touch(pressed(touch, 1e-3, torch.full((1, 1), 0.005)))
    for dt in (0.0, -0.005, float("nan"), float("inf")):
        with pytest.raises(StateError, match=rf"^SceneState.dt is {dt}, expected a finite time above 0 s$"):
            touch(pressed(touch, 1e-3, dt))
    assert touch.num_envs is None  # nothing was remembered of what was refused
    touch(pressed(touch, 1e-3, 0.005))


def test_who_does_not_want_dt_takes_any(build):
    touch = build(s={"noise": {"white_noise": 1e-3, "drift": 1e-4}, "history": 2})
    assert "dt" not in touch.inputs.fields
    for dt in (None, 0.0, -1.0):
        touch(pressed(touch, 1e-3, dt))


def test_a_dt_that_the_ring_is_too_short_for_is_named(build):
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
def test_a_delay_reads_what_was_so_at_any_step(build, dt):
    """A ramp that is read 25 ms late: the closed form x(t − Δ), constant before the start."""
    touch, num = build(s={"noise": LATE}), 60
    times = dt * np.arange(num)
    depths = (1e-3 + 2e-3 * times / times[-1])[:, None]
    expected = 1e-3 + 2e-3 * np.maximum(times - 0.025, 0) / times[-1]
    np.testing.assert_allclose(run(touch, depths, [dt] * num)[:, 0], expected, atol=1e-13)


def test_a_longer_dt_is_fine_once_the_past_is_of_it(build):
    dts = [0.005] * 10 + [0.010] * 20
    times = np.cumsum(dts)
    touch = build(s={"noise": LATE})
    found = run(touch, (1e-3 + 1e-3 * times)[:, None], dts)[:, 0]
    np.testing.assert_allclose(found[:10], 1e-3 + 1e-3 * np.maximum(times[:10] - 0.025, times[0]), atol=1e-13)
    np.testing.assert_allclose(found[13:], 1e-3 + 1e-3 * (times[13:] - 0.025), atol=1e-13)


def test_a_delay_reads_what_was_so_while_dt_changes(build):
    """The calls that it remembers were made at their own steps, not at the present one."""
    dts = [0.005] * 10 + [0.010, 0.005] * 5 + [0.010] * 10
    times = np.cumsum(dts)
    touch = build(s={"noise": LATE})
    found = run(touch, (1e-3 + 1e-2 * times)[:, None], dts)[:, 0]
    np.testing.assert_allclose(found, 1e-3 + 1e-2 * np.maximum(times - 0.025, times[0]), atol=1e-13)


def test_hysteresis_takes_steps_of_any_length(build):
    """A ramp in uneven steps: x + β v τ (1 − exp(−t/τ)), the Maxwell branch's closed form."""
    strength, tau = 0.5, 0.05
    noise = {"hysteresis": {"strength": strength, "time_constant": tau}}
    dts = np.random.default_rng(0).uniform(1e-3, 3e-2, 60)
    times = np.cumsum(dts) - dts[0]
    speed = 2e-3 / times[-1]
    found = run(build(s={"noise": noise}), (1e-3 + speed * times)[:, None], dts)[:, 0]
    expected = 1e-3 + speed * times + strength * speed * tau * (1 - np.exp(-times / tau))
    np.testing.assert_allclose(found, expected, atol=1e-12)


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
    assert clock.get_buffer("age").tolist() == [2, 7, 4]
