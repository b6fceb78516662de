"""When calls are captured again, and that capturing leaves memory unchanged. Real captures need a GPU."""

import pytest
import torch
from capture_recorder import Recorder

from tgdsl.module.calls import Graphed


def add_up(tensors, memory):
    memory["total"].add_(tensors["a"].sum(dim=1) + tensors["b"].float().sum(dim=1))
    return {"total": memory["total"].clone(), "a": 2 * tensors["a"]}


def inputs(num_envs, seed, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(num_envs, 3, generator=generator, dtype=dtype)
    return {"a": a, "b": torch.randint(0, 5, (num_envs, 2), generator=generator)}


def test_replays_equal_calls():
    recorder, memory, expected_memory = Recorder(), {"total": torch.zeros(4)}, {"total": torch.zeros(4)}
    graphed = Graphed(add_up, recorder)
    for seed in range(5):
        results, expected = graphed(inputs(4, seed), memory), add_up(inputs(4, seed), expected_memory)
        assert results.keys() == expected.keys()
        assert all(torch.equal(results[name], expected[name]) for name in results)
        assert torch.equal(memory["total"], expected_memory["total"])
    assert recorder.count == 1


@pytest.mark.parametrize("change", ["batch", "dtype", "memory"])
def test_other_shapes_dtypes_or_memory_are_captured_again(change):
    recorder, memory = Recorder(), {"total": torch.zeros(4)}
    graphed = Graphed(add_up, recorder)
    graphed(inputs(4, 0), memory)
    num_envs, dtype = (6, torch.float32) if change == "batch" else (4, torch.float64 if change == "dtype" else torch.float32)
    if change != "dtype":
        memory = {"total": torch.ones(num_envs)}
    expected_memory = {"total": memory["total"].clone()}
    results, expected = graphed(inputs(num_envs, 1, dtype), memory), add_up(inputs(num_envs, 1, dtype), expected_memory)
    assert recorder.count == 2
    assert all(torch.equal(results[name], expected[name]) for name in results)
    assert torch.equal(memory["total"], expected_memory["total"])


def test_a_capture_under_inference_mode_works_outside():
    memory = {"total": torch.zeros(4)}
    graphed = Graphed(add_up, Recorder())
    with torch.inference_mode():
        graphed(inputs(4, 0), memory)
    results = graphed(inputs(4, 1), memory)
    assert not results["a"].is_inference()
    assert torch.equal(results["a"], 2 * inputs(4, 1)["a"])
