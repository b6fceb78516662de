"""Inputs of the graphs that torch.compile traces."""

import torch


def number_inputs(graph: torch.fx.GraphModule) -> list[str]:
    """Return the names of inputs that are numbers of the code or the plan: floats that `torch.compile(dynamic=True)` has read.

    Each costs microseconds a call, and double precision on a GPU; or all is traced again, and compiling takes twice as long.
    """
    inputs = {node.name: node.meta["example_value"] for node in graph.graph.nodes if node.op == "placeholder"}
    tensors = {name: value for name, value in inputs.items() if isinstance(value, torch.Tensor)}
    return [name for name, value in tensors.items() if value.ndim == 0 and value.dtype == torch.float64]
