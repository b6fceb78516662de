"""Gradients through noise."""

import dataclasses

import pytest
import torch
from noisy_modules import EVERY_KNOB, RANGES, felt_state


def gradients(touch, state, weight=None, name="s"):
    """Return the derivatives of the weighted sum of a reading with respect to poses."""
    tensors = {n: getattr(state, n).clone().requires_grad_() for n in ("body_pos", "body_quat")}
    reading = touch(dataclasses.replace(state, **tensors))[name]
    return torch.autograd.grad(
        (reading * (torch.ones_like(reading) if weight is None else weight)).sum(), list(tensors.values())
    )


@pytest.mark.parametrize("noise", [EVERY_KNOB, RANGES])
def test_gradients_are_finite(build, noise):
    touch = build(s={"noise": noise})
    for seed in range(3):
        touch.reset()
        for call in range(3):
            for gradient in gradients(touch, felt_state(touch, 4, 10 * seed + call)):
                assert gradient.isfinite().all()
                assert call > 0 or gradient.abs().max() > 0  # later readings may depend only on earlier calls


def test_gradients_are_the_clean_ones_times_the_gain(build):
    touch, clean = build(s={"noise": {"gain": [0.5, 2.0]}}), build(s={})
    state = felt_state(touch)
    with torch.no_grad():
        a, b = touch(state)["s"], clean(state)["s"]
        ratio = torch.where(b.abs() > 0, a / b, 0.0)
    weight = torch.randn(a.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for gradient, expected in zip(gradients(touch, state, weight), gradients(clean, state, weight * ratio), strict=True):
        torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-12)
    tensors = [state.body_pos.clone().requires_grad_(), state.body_quat.clone().requires_grad_()]

    def readings(pos, quat):
        return touch(dataclasses.replace(state, body_pos=pos, body_quat=quat))["s"]

    assert torch.autograd.gradcheck(readings, tensors, eps=1e-7, atol=1e-4, rtol=1e-4, fast_mode=True)


def test_gradients_pass_the_quantiser_and_vanish_at_dead_taxels(build):
    fine, coarse = build(s={}), build(s={"noise": {"quantization": 0.1}})
    state = felt_state(fine)
    with torch.no_grad():
        reading = coarse(state)["s"]
    assert (reading / 0.1 - (reading / 0.1).round()).abs().max() < 1e-9 and reading.abs().max() > 0
    for result, expected in zip(gradients(coarse, state), gradients(fine, state), strict=True):
        torch.testing.assert_close(result, expected, rtol=0, atol=0)
    tensor = state.body_pos.clone().requires_grad_()
    with_grad = coarse(dataclasses.replace(state, body_pos=tensor))["s"]
    torch.testing.assert_close(with_grad.detach(), reading, rtol=0, atol=1e-15)
    dead = build(s={"noise": {"dead_probability": 1.0}})
    assert not any(gradient.any() for gradient in gradients(dead, state))
