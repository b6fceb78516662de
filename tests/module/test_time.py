"""Time: the rate of a sensor, its history, its delay, and the time step that a scene gives."""

import itertools
import warnings
from fractions import Fraction

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError, StateError
from tgdsl.module.reading import _phase
from tgdsl.module.state import SceneState

BALL, RADIUS, UP = 0.03, 0.004, 0.01
"""Radius of the ball, of the probe, and the probe's height over its body [m]."""
SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01"/></body>
  <body name="item" pos="0 0 .05"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
LATE = {"read_delay": "25 ms"}


@pytest.fixture
def build(tmp_path):
    def compiled(dtype=torch.float64, observations=None, **sensors):
        (tmp_path / "scene.xml").write_text(SCENE)
        points = [{"pos": [0, 0, UP], "normal": [0, 0, 1]}, {"pos": [0.002, 0, UP], "normal": [0, 0, 1]}]
        layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points, "radius": RADIUS}}}}
        own = {"kind": "contact_depth", "links": "pad", "feels": ["item"], "gate": "geometric"}
        return tgdsl.compile(
            {
                "tgdsl": 1,
                "robot": {"model": str(tmp_path / "scene.xml"), "layout": layout},
                "objects": {"item": {"body": "item"}},
                "sensors": {name: {**own, **sensor} for name, sensor in sensors.items()},
                "observations": observations or {},
            },
            dtype=dtype,
        )

    return compiled


def pressed(touch, depth, dt=None) -> SceneState:
    """A state in which the first probe is `depth` deep, in each environment its own [m]."""
    depth = torch.as_tensor(np.atleast_1d(depth), dtype=torch.float64)
    pos, quat = torch.zeros(len(depth), 2, 3, dtype=torch.float64), torch.zeros(len(depth), 2, 4, dtype=torch.float64)
    quat[..., 0] = 1
    pos[:, touch.inputs.bodies.index("item"), 2] = UP + RADIUS + BALL - depth
    return SceneState(body_pos=pos, body_quat=quat, dt=dt)


def run(touch, depths, dts, name="s") -> np.ndarray:
    """Return the first probe's reading at each call (call, env)."""
    return np.array([touch(pressed(touch, depth, dt))[name][..., 0, 0].numpy() for depth, dt in zip(depths, dts, strict=True)])


def ramp(num: int, num_envs=1) -> np.ndarray:
    """Depths (call, env) that are all different [m]."""
    return 1e-3 + 2e-3 * (np.arange(num * num_envs).reshape(num, num_envs) / (num * num_envs))


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


SLOW_RATES = [(50, 0.005, 4), (30, 1 / 240, 8), (100, 0.002, 5)]


@pytest.mark.parametrize(
    ("rate", "dt", "every"), [(50, 0.001, 20), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW_RATES)]
)
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


@pytest.mark.parametrize("rate", [37, 60, 120])
def test_a_rate_that_does_not_divide_that_of_the_calls(build, rate):
    """Samples are taken at the nearest call, so their mean rate is the sensor's own."""
    dts = [Fraction(1, 200)] * 400
    read = sampled(dts, rate)
    assert len(set(read)) == pytest.approx(400 * rate / 200, abs=1)
    touch, depths = build(s={"rate": rate}), ramp(400)
    np.testing.assert_allclose(run(touch, depths, [float(dt) for dt in dts])[:, 0], depths[read, 0], atol=1e-12)


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


# history


@pytest.mark.parametrize("rate", [None, 50])
@pytest.mark.parametrize("length", [1, 2, 3, 6])
def test_history_is_a_window_over_the_last_calls(build, length, rate):
    """Against NumPy; before there are enough calls, and after a reset, the first reading stands for the missing."""
    own = {} if rate is None else {"rate": rate}
    reduced = {name: {**own, "history": {"length": length, "reduce": name}} for name in ("last", "mean", "median")}
    touch, plain = build(**reduced, stack={**own, "history": length}), build(plain=own)
    depths = 1e-3 + 2e-3 * np.random.default_rng(0).random((20, 3))
    past: list[list[np.ndarray]] = [[], [], []]
    for call, depth in enumerate(depths):
        if call == 11:
            touch.reset([1])
            plain.reset([1])
            past[1] = []
        dt = None if rate is None else 0.005
        readings, reading = touch(pressed(touch, depth, dt)), plain(pressed(plain, depth, dt))["plain"].numpy()
        windows = []
        for env in range(3):
            past[env].append(reading[env])
            windows.append(([past[env][0]] * length + past[env])[-length:])
        window = np.array(windows)
        np.testing.assert_array_equal(readings["stack"].numpy(), window)
        np.testing.assert_array_equal(readings["last"].numpy(), window[:, -1])
        np.testing.assert_allclose(readings["mean"].numpy(), window.mean(axis=1), atol=1e-15)
        np.testing.assert_allclose(readings["median"].numpy(), np.median(window, axis=1), atol=1e-15)


def test_a_stack_is_a_copy_that_later_calls_leave_alone(build):
    touch, depths = build(s={"history": 5}), ramp(12, 4)
    kept = [touch(pressed(touch, depth))["s"] for depth in depths]
    for call, stack in enumerate(kept):
        window = depths[np.maximum(np.arange(call - 4, call + 1), 0)].T
        np.testing.assert_allclose(stack[..., 0, 0].numpy(), window, atol=1e-15)


def test_a_stack_may_be_a_view_of_the_memory(build):
    """Each call writes over it, in the same place, and it reads what a copy reads."""
    touch, plain, depths = build(s={"history": {"length": 5, "view": True}}), build(s={"history": 5}), ramp(12, 4)
    views = []
    for depth in depths:
        views.append(touch(pressed(touch, depth))["s"])
        copy = plain(pressed(plain, depth))["s"]
        assert all(torch.equal(view, copy) for view in views)
    window = touch.memory.get_buffer("history/s")
    assert {view.untyped_storage().data_ptr() for view in views} == {window.untyped_storage().data_ptr()}


def test_only_a_stack_can_be_a_view(build):
    with pytest.raises(SpecError, match=r"`view` is used by `reduce: stack` alone, expected it to be left out"):
        build(s={"history": {"length": 5, "reduce": "mean", "view": True}})


@pytest.mark.parametrize("reduce", ["stack", "mean", "median"])
def test_a_history_keeps_the_gradient_of_its_last_call(build, reduce):
    """Against finite differences: what was read before is constant, so a mean of three has a third of the slope."""
    touch, depths = build(s={"history": {"length": 3, "reduce": reduce}}), torch.tensor([[1e-3], [3e-3], [2e-3]])
    touch(pressed(touch, depths[0]))
    touch(pressed(touch, depths[1]))
    state = pressed(touch, depths[2])
    assert state.body_pos is not None
    state.body_pos.requires_grad_()
    read = touch.peek(state)["s"][..., 0, 0].sum()
    (slope,) = torch.autograd.grad(read, state.body_pos)
    step, place = 1e-6, (0, touch.inputs.bodies.index("item"), 2)
    values = []
    for sign in (1, -1):
        moved = state.body_pos.detach().clone()
        moved[place] += sign * step
        values.append(touch.peek(SceneState(body_pos=moved, body_quat=state.body_quat))["s"][..., 0, 0].sum().item())
    assert slope[place].item() == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-6)
    assert slope[place].item() == pytest.approx({"stack": -1, "mean": -1 / 3, "median": -1}[reduce], rel=1e-6)


def test_a_stack_is_channel_major_per_call(build):
    touch = build(s={"kind": "kinematic_taxel", "history": 3})
    reading = touch(touch.example_state(4))["s"]
    assert reading.shape == (4, 3, 2, 6)
    assert reading.transpose(2, 3)[0].is_contiguous()


def test_observations_of_a_stack_are_those_of_its_calls_oldest_first(build):
    terms = {"policy": [{"type": "depth", "of": "s"}], "both": [{"type": "depth", "of": "p"}, {"type": "agg_force", "of": "s"}]}
    touch = build(observations=terms, s={"history": 3}, p={})
    depths = ramp(5, 2)
    for depth in depths:
        readings = touch(pressed(touch, depth))
    found = touch.observe(readings)
    probes = readings["s"].numpy()[..., 0]  # (env, step, taxel)
    np.testing.assert_allclose(probes[:, :, 0], depths[2:].T, atol=1e-12)
    np.testing.assert_array_equal(found["policy"].numpy(), probes.reshape(2, 6))
    force = np.zeros((2, 3, 3))
    force[:, :, 0] = 1e4 * probes.sum(axis=2)  # axes zyx
    expected = np.concatenate([readings["p"].numpy()[..., 0], force.reshape(2, 9)], axis=1)
    np.testing.assert_allclose(found["both"].numpy(), expected, rtol=1e-12)
    planned: dict[str, int] = {}
    for term in touch.plan.observations:
        planned[term.group] = planned.get(term.group, 0) + term.num_features
    assert planned == {"policy": 6, "both": 11}


def test_history_of_a_noisy_sensor_with_a_rate(build):
    """Calls are remembered, not samples: a stack of 8 calls at 200 Hz of a sensor at 50 Hz holds each sample four times."""
    sensor = {"rate": 50, "noise": {"white_noise": 1e-3, "gain": [0.9, 1.1]}}
    touch, plain = build(s={**sensor, "history": 8, "readout": "both"}), build(s=sensor)
    singles = []
    for depth in ramp(21, 3):
        readings = touch(pressed(touch, depth, 0.005))
        singles.append(plain(pressed(plain, depth, 0.005))["s"].numpy())
    np.testing.assert_array_equal(readings["s"].numpy(), np.stack(singles[-8:], axis=1))
    values = readings["s"][0, :, 0, 0].tolist()
    assert [len(list(group)) for _, group in itertools.groupby(values)] == [3, 4, 1]
    assert readings["s/clean"].shape == readings["s"].shape and not torch.equal(readings["s"], readings["s/clean"])


def test_history_under_inference_mode_and_after_it(build):
    touch = build(s={"history": 3})
    with torch.inference_mode():
        touch(pressed(touch, 1e-3))
    touch.reset()
    touch(pressed(touch, 2e-3))
    assert touch(pressed(touch, 3e-3))["s"][0, :, 0, 0].tolist() == pytest.approx([2e-3, 2e-3, 3e-3])


def test_history_fixes_the_batch(build):
    touch = build(s={"history": {"length": 3, "reduce": "mean"}})
    assert touch.has_state
    touch(pressed(touch, [1e-3, 2e-3]))
    assert touch.num_envs == 2
    with pytest.raises(
        StateError, match=r"^this module holds the state of 2 environments, the scene has 3; `free\(\)` lets go of it$"
    ):
        touch(pressed(touch, [1e-3] * 3))


# dt


@pytest.mark.parametrize(
    "sensor", [{"rate": 50}, {"noise": LATE}, {"noise": {"hysteresis": {"strength": 1, "time_constant": 1}}}]
)
def test_a_wrong_dt_is_named(build, sensor):
    touch = build(s=sensor)
    assert "dt" in touch.inputs.fields
    with pytest.raises(StateError, match=r"^SceneState.dt is missing; this module wants body_pos, body_quat, dt$"):
        touch(pressed(touch, 1e-3))
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
    assert str(caught.value) == f"{message}; begin with the shortest dt"
    touch(pressed(touch, 1e-3, 0.010))
    touch(pressed(touch, 1e-3, 0.009))  # three calls, as at first


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
