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
from tgdsl.tensors import torch_internals

Tensors = dict[str, Tensor]
Step = Callable[..., Any]  # a bound method of a module that takes tensors and memory by name, and returns tensors by name
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

    The host's work for a call is a copy of the inputs and one launch. It is captured again when shapes or dtypes of the inputs
    change, or memory lies elsewhere. What it returns is in the same tensors at each call.
    """

    def __init__(self, function: Step, capture: Callable[[Callable[[], Tensors]], tuple[Replay, Tensors]] = captured):
        self._function, self._capture = function, capture
        self._key: object = None

    def __call__(self, tensors: Tensors, memory: Tensors) -> Tensors:
        """Return what the function does of these tensors."""
        shapes = [(name, value.shape, value.dtype) for name, value in tensors.items()]
        key = shapes, [(name, value.data_ptr(), value.shape) for name, value in memory.items()]
        if key != self._key:
            self._start(tensors, memory)
            self._key = key
        for own, names in self._groups:
            torch_internals.copy_each(own, [tensors[name] for name in names])
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
        dtypes = {value.dtype for value in inputs.values()}
        names = [[name for name, value in inputs.items() if value.dtype == dtype] for dtype in dtypes]
        self._groups = [([inputs[name] for name in group], group) for group in names]


class Calls:
    """How a module's steps are to be called. A copy of a module compiles its own."""

    def __init__(self) -> None:
        self._wanted: tuple[bool, dict[str, Any]] | None = None
        self.compiled: dict[str, Step] = {}  # compiled steps, by their names; another dictionary after each `compile`
        self.graphed: dict[str, Graphed] = {}  # the same as CUDA graphs, if those are wanted

    def compile(self, graph: bool, **options: Any) -> None:
        """Have steps compiled when they are first called, and calls without derivatives replayed as CUDA graphs if wanted."""
        self._wanted, self.compiled, self.graphed = (graph, options), {}, {}

    def of(self, step: Step) -> Step:
        """Return what to call for a step: inside a capture of the caller's own, what a graph of ours would capture."""
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
        """Capture again at the next calls: constants lie elsewhere."""
        for graphed in self.graphed.values():
            graphed.forget()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is compiled: it is bound to the module that this is of."""
        return {"_wanted": self._wanted, "compiled": {}, "graphed": {}}


def inductor_options(plan: Plan, quantities: Sequence[Quantity], device: torch.device) -> dict[str, Any]:
    """Return what is asked of Inductor for a plan and the quantities that it asks for.

    Kernels check that indices are in range only where some index is given by the user: a variant's or a material's number.
    Where taxels of one link ask primitives for a depth or a distance and no more, blocks are tiles of environments and taxels:
    what there is once per environment is loaded once per tile. With more links it is looked up per taxel, and with more to find
    a tile takes too many registers. Where nothing but patches is asked for, kernels on a CPU are as large as can be: on a GPU
    one kernel takes twice the time of three.
    """
    is_slight = (
        all(quantity.is_light(plan.quantities[quantity.name]) for quantity in quantities)
        and not any(sensor.noise for sensor in plan.sensors)
        and all(target.num_pairs == 1 for target in plan.objects)
    )
    is_fused = device.type == "cpu" and bool(quantities) and all(quantity.is_fused for quantity in quantities)
    return torch_internals.inductor_options(any(name in plan.inputs.fields for name in CHOICES), is_slight, is_fused)


def cpp_compiler() -> str | None:
    """Return the C++ compiler that Inductor needs for a CPU; None if there is none."""
    result = (shutil.which(name) for name in (os.environ.get("CXX", ""), "g++", "clang++") if name)
    return next((path for path in result if path), None)
