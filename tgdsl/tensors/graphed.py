"""Calls of a compiled function as replayed CUDA graphs: the host's work for a call is a copy of the inputs and one launch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tgdsl.tensors.torch_internals import copy_each

Tensors = dict[str, Tensor]
Function = Callable[[Tensors, Tensors], Tensors]
Replay = Callable[[], Any]

WARM_CALLS = 2  # calls before the one that is captured: they compile and load kernels


def captured(call: Callable[[], Tensors]) -> tuple[Replay, Tensors]:
    """Capture a call as a CUDA graph; return what replays it, and the tensors that each replay writes."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_CALLS):
            call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
        outputs = call()
    return graph.replay, outputs


class Graphed:
    """A function of inputs and of memory that it changes in place, captured as a graph at the first call and replayed after it.

    It is captured again when shapes or dtypes of the inputs change, or memory lies elsewhere. What it returns is in the same
    tensors at each call.
    """

    def __init__(self, function: Function, capture: Callable[[Callable[[], Tensors]], tuple[Replay, Tensors]] = captured):
        """Capture nothing yet; the function takes inputs and memory by name, and returns tensors without derivatives."""
        self._function = function
        self._capture = capture
        self._key: object = None

    def __call__(self, tensors: Tensors, memory: Tensors) -> Tensors:
        """Return what the function does of these tensors."""
        shapes = [(name, value.shape, value.dtype) for name, value in tensors.items()]
        key = shapes, [(name, value.data_ptr(), value.shape) for name, value in memory.items()]
        if key != self._key:
            self._start(tensors, memory)
            self._key = key
        for own, names in self._groups:
            copy_each(own, [tensors[name] for name in names])
        self._replay()
        return dict(self._made)

    def forget(self) -> None:
        """Capture again at the next call: constants lie elsewhere."""
        self._key = None

    def _start(self, tensors: Tensors, memory: Tensors) -> None:
        """Capture a call on inputs of its own; memory is then as it was before."""
        with torch.inference_mode(False), torch.no_grad():
            inputs = {name: value.clone() for name, value in tensors.items()}
            old_memory = {name: value.clone() for name, value in memory.items()}
            self._replay, self._made = self._capture(lambda: self._function(inputs, memory))
            for name, value in old_memory.items():
                memory[name].copy_(value)
        kinds = {value.dtype for value in inputs.values()}
        names = [[name for name, value in inputs.items() if value.dtype == kind] for kind in kinds]
        self._groups = [([inputs[name] for name in group], group) for group in names]
