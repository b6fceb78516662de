"""The step as a pure function: memory goes in and out, with gradients through it."""

import dataclasses

import pytest
import torch
from noisy_modules import EVERY_KNOB, EXAMPLE, document, felt_state
from torch.utils._python_dispatch import TorchDispatchMode

import tgdsl
from tgdsl.errors import StateError

NOISY = {"a": {"noise": EVERY_KNOB, "history": 3}, "b": {"rate": 40, "noise": {"read_delay": 0.013}}}


@pytest.fixture
def noisy(tmp_path):
    return tgdsl.compile(document(tmp_path, NOISY), dtype=torch.float64).seed(7)


def test_steps_read_the_same_as_calls(noisy):
    """With noise, delays, rates, history and resets; a step does not change its input memory."""
    memory = noisy.initial_memory(4, 0.01)
    for call in range(12):
        state, reset = felt_state(noisy, 4, call), torch.tensor([False, call == 5, call in (3, 4), False])
        if call:
            noisy.reset(reset)
        before = {name: value.clone() for name, value in memory.items()}
        readings, after = noisy.step(state, memory, reset if call else None)
        expected = noisy(state)
        assert all(torch.equal(readings[name], expected[name]) for name in expected)
        assert all(torch.equal(memory[name], before[name]) for name in before)
        memory = after
    module_memory = noisy.memory.tensors(4, 0.01, noisy.dtype, noisy.device)
    assert module_memory.keys() == memory.keys() and all(
        torch.equal(module_memory[name], memory[name]) for name in module_memory
    )


def test_noise_and_rates_copy_no_memory(noisy):
    """A copy protects memory from kernels that write in place, and nothing does so there."""
    copied = set()

    class Copies(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            if func is torch.ops.aten.clone.default:
                copied.add(args[0].data_ptr())
            return func(*args, **(kwargs or {}))

    state, memory = felt_state(noisy, 4, 0), noisy.initial_memory(4, 0.01)
    with Copies():
        noisy.step(state, memory)
    assert not [name for name, value in memory.items() if value.data_ptr() in copied]


def test_steps_of_every_kind_read_the_same_as_calls():
    touch = tgdsl.compile(EXAMPLE, resolution="low")
    memory = touch.initial_memory(2, 0.01)
    for call in range(3):
        state = touch.example_state(2, call)
        readings, memory = touch.step(state, memory)
        expected = touch(state)
        assert all(torch.equal(readings[name], expected[name]) for name in expected)


@pytest.mark.parametrize(("noise", "history"), [({"read_delay": 0.02}, None), ({}, {"length": 3, "reduce": "mean"})])
def test_gradients_flow_through_memory(tmp_path, noise, history):
    """∂(reading two steps later)/∂(position now), against central differences in float64."""
    sensor = {"noise": noise, **({"history": history} if history else {})}
    touch = tgdsl.compile(document(tmp_path, {"a": sensor}), dtype=torch.float64)
    states = [felt_state(touch, 8, seed) for seed in range(3)]

    def last(pos):
        memory = touch.initial_memory(8, 0.01)
        for state in (dataclasses.replace(states[0], body_pos=pos), *states[1:]):
            readings, memory = touch.step(state, memory)
        return readings["a"].sum()

    pos = states[0].body_pos.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(last(pos), pos)
    steepest = gradient.abs().flatten().topk(3).indices
    for element in [tuple(map(int, index)) for index in zip(*torch.unravel_index(steepest, pos.shape), strict=True)]:
        shift = torch.zeros_like(pos)
        shift[element] = 1e-7
        difference = (last(pos.detach() + shift) - last(pos.detach() - shift)) / 2e-7
        assert abs(difference) > 1e-3
        assert difference.item() == pytest.approx(gradient[element].item(), rel=1e-5, abs=1e-5)


def test_invalid_memory_is_refused(noisy):
    state, memory = felt_state(noisy, 4), noisy.initial_memory(4, 0.01)
    with pytest.raises(StateError, match="expected `dt`, the time between steps"):
        noisy.initial_memory(4)
    with pytest.raises(StateError, match='memory: found no "a:'):
        noisy.step(state, {})
    with pytest.raises(StateError, match=r"expected \(3, "):
        noisy.step(felt_state(noisy, 3), memory)
    with pytest.raises(StateError, match="begin with the shortest dt"):
        noisy.step(dataclasses.replace(state, dt=1e-3), memory)
