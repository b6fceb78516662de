"""Histories: readings of the last calls, stacked or reduced."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch
from pressed_probes import pad, pressed, ramp

from tgdsl.errors import SpecError, StateError
from tgdsl.module.state import SceneState


@pytest.fixture
def build(tmp_path):
    return partial(pad, tmp_path)


@pytest.mark.parametrize("rate", [None, 50])
@pytest.mark.parametrize("length", [1, 2, 3, 6])
def test_history_is_a_window_over_the_last_calls(build, length, rate):
    """Against NumPy; at the start and after a reset, the first reading fills the window."""
    rate_option = {} if rate is None else {"rate": rate}
    reduced = {name: {**rate_option, "history": {"length": length, "reduce": name}} for name in ("last", "mean", "median")}
    touch, plain = build(**reduced, stack={**rate_option, "history": length}), build(plain=rate_option)
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


def test_later_calls_do_not_change_a_stack(build):
    touch, depths = build(s={"history": 5}), ramp(12, 4)
    stacks = [touch(pressed(touch, depth))["s"] for depth in depths]
    for call, stack in enumerate(stacks):
        window = depths[np.maximum(np.arange(call - 4, call + 1), 0)].T
        np.testing.assert_allclose(stack[..., 0, 0].numpy(), window, atol=1e-15)


def test_a_stack_may_be_a_view_of_the_memory(build):
    """Each call overwrites it in place, and it equals a copy."""
    touch, plain, depths = build(s={"history": {"length": 5, "view": True}}), build(s={"history": 5}), ramp(12, 4)
    views = []
    for depth in depths:
        views.append(touch(pressed(touch, depth))["s"])
        copy = plain(pressed(plain, depth))["s"]
        assert all(torch.equal(view, copy) for view in views)
    window = touch.memory.get_buffer("history/s")
    assert {view.untyped_storage().data_ptr() for view in views} == {window.untyped_storage().data_ptr()}


def test_only_a_stack_can_be_a_view(build):
    with pytest.raises(SpecError, match=r"`view` has no effect without `reduce: stack`, expected it to be left out"):
        build(s={"history": {"length": 5, "reduce": "mean", "view": True}})


@pytest.mark.parametrize("reduce", ["stack", "mean", "median"])
def test_a_history_keeps_the_gradient_of_its_last_call(build, reduce):
    """Against finite differences: earlier readings are constant, so a mean of three has a third of the slope."""
    touch, depths = build(s={"history": {"length": 3, "reduce": reduce}}), torch.tensor([[1e-3], [3e-3], [2e-3]])
    touch(pressed(touch, depths[0]))
    touch(pressed(touch, depths[1]))
    state = pressed(touch, depths[2])
    assert state.body_pos is not None
    state.body_pos.requires_grad_()
    total = touch.peek(state)["s"][..., 0, 0].sum()
    (slope,) = torch.autograd.grad(total, state.body_pos)
    step, index = 1e-6, (0, touch.inputs.bodies.index("item"), 2)
    values = []
    for sign in (1, -1):
        moved = state.body_pos.detach().clone()
        moved[index] += sign * step
        values.append(touch.peek(SceneState(body_pos=moved, body_quat=state.body_quat))["s"][..., 0, 0].sum().item())
    assert slope[index].item() == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-6)
    assert slope[index].item() == pytest.approx({"stack": -1, "mean": -1 / 3, "median": -1}[reduce], rel=1e-6)


def test_a_stack_is_channel_major_per_call(build):
    touch = build(s={"kind": "kinematic_taxel", "history": 3})
    reading = touch(touch.example_state(4))["s"]
    assert reading.shape == (4, 3, 2, 6)
    assert reading.transpose(2, 3)[0].is_contiguous()


def test_observations_of_a_stack_have_its_calls_oldest_first(build):
    terms = {"policy": [{"type": "depth", "of": "s"}], "both": [{"type": "depth", "of": "p"}, {"type": "agg_force", "of": "s"}]}
    touch = build(observations=terms, s={"history": 3}, p={})
    depths = ramp(5, 2)
    for depth in depths:
        readings = touch(pressed(touch, depth))
    groups = touch.observe(readings)
    probes = readings["s"].numpy()[..., 0]  # (env, step, taxel)
    np.testing.assert_allclose(probes[:, :, 0], depths[2:].T, atol=1e-12)
    np.testing.assert_array_equal(groups["policy"].numpy(), probes.reshape(2, 6))
    force = np.zeros((2, 3, 3))
    force[:, :, 0] = 1e4 * probes.sum(axis=2)  # axes zyx
    expected = np.concatenate([readings["p"].numpy()[..., 0], force.reshape(2, 9)], axis=1)
    np.testing.assert_allclose(groups["both"].numpy(), expected, rtol=1e-12)
    num_features: dict[str, int] = {}
    for term in touch.plan.observations:
        num_features[term.group] = num_features.get(term.group, 0) + term.num_features
    assert num_features == {"policy": 6, "both": 11}


def test_a_history_holds_calls_and_not_samples(build):
    """A stack of 8 calls at 200 Hz holds each sample of a sensor at 50 Hz four times."""
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


def test_a_history_works_under_inference_mode_and_after_it(build):
    touch = build(s={"history": 3})
    with torch.inference_mode():
        touch(pressed(touch, 1e-3))
    touch.reset()
    touch(pressed(touch, 2e-3))
    assert touch(pressed(touch, 3e-3))["s"][0, :, 0, 0].tolist() == pytest.approx([2e-3, 2e-3, 3e-3])


def test_a_history_fixes_the_number_of_environments(build):
    touch = build(s={"history": {"length": 3, "reduce": "mean"}})
    assert touch.has_state
    touch(pressed(touch, [1e-3, 2e-3]))
    assert touch.num_envs == 2
    with pytest.raises(
        StateError, match=r"^this module holds the state of 2 environments, the scene has 3; `free\(\)` lets go of it$"
    ):
        touch(pressed(touch, [1e-3] * 3))
