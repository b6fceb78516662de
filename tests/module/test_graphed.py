"""When calls are captured again, and that what is remembered is left as it was; what is captured needs a GPU."""

import pytest
import torch

from tgdsl.module.calls import WARM_CALLS, Graphed


class Recorder:
    """Captures as a GPU does: the call runs beforehand, and a replay writes to the tensors that were captured."""

    def __init__(self):
        self.count = 0

    def __call__(self, call):
        self.count += 1
        for _ in range(WARM_CALLS):
            call()
        made = {name: torch.full_like(value, float("nan")) for name, value in call().items()}

        def replay():
            for name, value in call().items():
                made[name].copy_(value)

        return replay, made


def add_up(tensors, memory):
    memory["total"].add_(tensors["a"].sum(dim=1) + tensors["b"].float().sum(dim=1))
    return {"total": memory["total"].clone(), "a": 2 * tensors["a"]}


def inputs(num_envs, seed, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(num_envs, 3, generator=generator, dtype=dtype)
    return {"a": a, "b": torch.randint(0, 5, (num_envs, 2), generator=generator)}


def test_replays_are_calls():
    recorder, memory, own = Recorder(), {"total": torch.zeros(4)}, {"total": torch.zeros(4)}
    graphed = Graphed(add_up, recorder)
    for seed in range(5):
        found, expected = graphed(inputs(4, seed), memory), add_up(inputs(4, seed), own)
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[name], expected[name]) for name in found)
        assert torch.equal(memory["total"], own["total"])
    assert recorder.count == 1


@pytest.mark.parametrize("change", ["batch", "dtype", "memory"])
def test_it_is_captured_anew_when_something_lies_elsewhere(change):
    recorder, memory = Recorder(), {"total": torch.zeros(4)}
    graphed = Graphed(add_up, recorder)
    graphed(inputs(4, 0), memory)
    num_envs, dtype = (6, torch.float32) if change == "batch" else (4, torch.float64 if change == "dtype" else torch.float32)
    if change != "dtype":
        memory = {"total": torch.ones(num_envs)}
    own = {"total": memory["total"].clone()}
    found, expected = graphed(inputs(num_envs, 1, dtype), memory), add_up(inputs(num_envs, 1, dtype), own)
    assert recorder.count == 2
    assert all(torch.equal(found[name], expected[name]) for name in found)
    assert torch.equal(memory["total"], own["total"])


def test_what_was_captured_under_inference_mode_serves_without_it():
    memory = {"total": torch.zeros(4)}
    graphed = Graphed(add_up, Recorder())
    with torch.inference_mode():
        graphed(inputs(4, 0), memory)
    found = graphed(inputs(4, 1), memory)
    assert not found["a"].is_inference()
    assert torch.equal(found["a"], 2 * inputs(4, 1)["a"])
