"""How the steps of a module are called: eager, compiled by torch, or replayed as CUDA graphs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from tgdsl.module.state import CHOICES
from tgdsl.plan.plan import Plan
from tgdsl.quantities.base import Quantity
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.tensors import torch_internals

Tensors = dict[str, Tensor]
Step = Callable[..., Any]  # a bound method of a module that takes tensors and memory by name, and returns tensors by name
Replay = Callable[[], Any]
WARM_CALLS = 2  # calls before the captured call: they compile and load kernels


def captured(call: Callable[[], Tensors]) -> tuple[Replay, Tensors]:
    """Capture a call as a CUDA graph; return its replay function, and the tensors that each replay writes."""
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
    """A function that updates memory in place, captured as a CUDA graph at the first call and replayed afterwards.

    Per call the host copies the inputs and launches once. The graph is captured again when shapes or dtypes of the inputs
    change, or the memory has moved. All calls return the same tensors.
    """

    def __init__(self, function: Step, capture: Callable[[Callable[[], Tensors]], tuple[Replay, Tensors]] = captured):
        self._function, self._capture = function, capture
        self._key: object = None

    def __call__(self, tensors: Tensors, memory: Tensors) -> Tensors:
        """Return the function's outputs for these tensors."""
        shapes = [(name, value.shape, value.dtype) for name, value in tensors.items()]
        key = shapes, [(name, value.data_ptr(), value.shape) for name, value in memory.items()]
        if key != self._key:
            self._start(tensors, memory)
            self._key = key
        for static_inputs, names in self._groups:
            torch_internals.copy_each(static_inputs, [tensors[name] for name in names])
        self._replay()
        return dict(self._outputs)

    def forget(self) -> None:
        """Capture again at the next call: constants have moved."""
        self._key = None

    def _start(self, tensors: Tensors, memory: Tensors) -> None:
        """Capture a call on cloned inputs, then restore the memory."""
        with torch.inference_mode(False), torch.no_grad():
            inputs = {name: value.clone() for name, value in tensors.items()}
            old_memory = {name: value.clone() for name, value in memory.items()}
            self._replay, self._outputs = self._capture(lambda: self._function(inputs, memory))
            for name, value in old_memory.items():
                memory[name].copy_(value)
        dtypes = {value.dtype for value in inputs.values()}
        names = [[name for name, value in inputs.items() if value.dtype == dtype] for dtype in dtypes]
        self._groups = [([inputs[name] for name in group], group) for group in names]


class Calls:
    """Compiled and graph-captured steps of a module. A copy of a module compiles its own."""

    def __init__(self) -> None:
        self._wanted: tuple[bool, dict[str, Any]] | None = None
        self.compiled: dict[str, Step] = {}  # compiled steps, by their names; another dictionary after each `compile`
        self.graphed: dict[str, Graphed] = {}  # the same steps as CUDA graphs, if requested

    def compile(self, graph: bool, **options: Any) -> None:
        """Compile each step at its first call; with `graph`, replay calls without derivatives as CUDA graphs."""
        self._wanted, self.compiled, self.graphed = (graph, options), {}, {}

    def of(self, step: Step) -> Step:
        """Return the callable for a step; inside a caller's graph capture, the function that our graph would capture."""
        name = step.__name__
        if self._wanted is not None and name not in self.compiled:
            graph, options = self._wanted
            self.compiled[name] = torch.compile(torch_internals.with_own_code(step), **options)
            if graph:
                self.graphed[name] = Graphed(self.compiled[name])
        if name in self.graphed and not torch.is_grad_enabled() and not torch.cuda.is_current_stream_capturing():
            return self.graphed[name]
        return self.compiled.get(name, step)

    def forget_graphs(self) -> None:
        """Capture again at the next calls: constants have moved."""
        for graphed in self.graphed.values():
            graphed.forget()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out compiled steps: they are bound to this module."""
        return {"_wanted": self._wanted, "compiled": {}, "graphed": {}}


def inductor_options(plan: Plan, quantities: Sequence[Quantity], device: torch.device) -> dict[str, Any]:
    """Return Inductor's options for a plan and its quantities.

    Kernels check the range of indices only if the user supplies some: variants or materials. If the taxels of one link query
    primitives for a depth or a distance only, blocks are tiles of environments and taxels: values per environment are loaded
    once per tile. With more links they are gathered per taxel, and with more outputs a tile takes too many registers. If
    patches are the only quantity, kernels on a CPU are as large as possible: on a GPU one kernel takes twice as long as three.
    """
    is_slight = (
        all(quantity.is_light(plan.quantities[quantity.name]) for quantity in quantities)
        and not any(sensor.noise for sensor in plan.sensors)
        and all(target.num_pairs == 1 for target in plan.objects)
    )
    is_fused = device.type == "cpu" and bool(quantities) and all(quantity.is_fused for quantity in quantities)
    checks_indices = any(name in plan.inputs.fields for name in CHOICES)
    has_slots = any(name in plan.inputs.fields for name in SLOT_FIELDS)
    return torch_internals.inductor_options(checks_indices, is_slight, has_slots, is_fused)


def cpp_compiler() -> str | None:
    """Return the C++ compiler that Inductor needs for a CPU; None if there is none."""
    result = (shutil.which(name) for name in (os.environ.get("CXX", ""), "g++", "clang++") if name)
    return next((path for path in result if path), None)
