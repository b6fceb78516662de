"""What a compiler for dynamic shapes sees of a module."""

from pathlib import Path

import pytest
import torch
from torch._dynamo.backends.common import aot_autograd

import tgdsl

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["every_sensor", "noisy_hand"])
def test_no_number_of_the_code_or_the_plan_is_an_input(name):
    """A float that is read is one for `torch.compile(dynamic=True)`.

    It costs microseconds a call, and double precision on a GPU; or all is traced again, and compiling takes twice as long.
    """
    touch = tgdsl.compile(EXAMPLES / f"{name}.yaml")
    numbers, traced = [], []
    behind = aot_autograd(fw_compiler=lambda graph, _inputs: graph.forward)

    def look(graph, inputs):
        traced.append(len(graph.graph.nodes))
        for node in (node for node in graph.graph.nodes if node.op == "placeholder"):
            value = node.meta["example_value"]
            if isinstance(value, torch.Tensor) and value.ndim == 0 and value.dtype == torch.float64:
                numbers.append(node.name)
        return behind(graph, inputs)

    torch._dynamo.reset()
    with torch.no_grad():
        torch.compile(touch.advance, fullgraph=True, dynamic=True, backend=look)(*arguments(touch))
    assert numbers == [] and len(traced) == 1


def arguments(touch):
    state = touch.example_state(3, dtype=torch.float32)
    tensors = touch.incoming.tensors(state, torch.float32, touch.device)
    return tensors, touch.memory.tensors(3, state.dt, torch.float32, touch.device)
