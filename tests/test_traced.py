"""What a compiler for dynamic shapes sees of a module."""

from pathlib import Path

import pytest
import torch

import tgdsl

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize("name", ["every_sensor", "noisy_hand"])
def test_no_number_of_the_code_is_an_input_of_each_call(name, monkeypatch):
    """A module's float is one for `torch.compile(dynamic=True)`: it costs microseconds a call, and double precision on a GPU."""
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)
    touch, numbers = tgdsl.compile(EXAMPLES / f"{name}.yaml"), []

    def look(graph, _inputs):
        for node in (node for node in graph.graph.nodes if node.op == "placeholder"):
            value = node.meta["example_value"]
            if isinstance(value, torch.Tensor) and value.ndim == 0 and value.dtype == torch.float64:
                numbers.append(node.name)
        return graph.forward

    torch._dynamo.reset()
    with torch.no_grad():
        torch.compile(touch.advance, fullgraph=True, dynamic=True, backend=look)(*arguments(touch))
    assert [name for name in numbers if not name.endswith("_period")] == []  # a sensor's rate is the document's


def arguments(touch):
    state = touch.example_state(3, dtype=torch.float32)
    tensors = state.checked(touch.inputs, touch.device)
    if "dt" in touch.inputs.fields:
        tensors["dt"] = torch.tensor(state.dt, dtype=torch.float32)
    return tensors, touch.memory.tensors(3, state.dt, torch.float32, touch.device)
