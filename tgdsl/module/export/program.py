"""A module's step as a graph of torch's own operations, with flat inputs and outputs and any number of environments.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tgdsl.errors import TgdslError, listed
from tgdsl.module.export.signature import Port, Signature
from tgdsl.module.memory.clock import SHARED
from tgdsl.plan import tree
from tgdsl.plan.plan import Plan
from tgdsl.tensors.torch_internals import ASSERT_DTYPE, assert_dtype

Tensors = Mapping[str, Tensor]
EXAMPLE_ENVS = 3
"""Environments of the tensors that are traced: no size of a module's, and neither 0 nor 1, which torch takes for constants."""
ON_HOST = {
    "tgdsl::mesh_distance": "`query: raycast` searches triangles with NVIDIA Warp, which runs in Python; expected `query: sdf`",
}
"""Operations of tgdsl that run in Python alone, with the reason."""


class Step(NamedTuple):
    """What is exported of a module."""

    plan: Plan  # its plan
    module: nn.Module  # holds its constants
    # `TactileModule.pure_step`
    pure_step: Callable[[Tensors, Tensors, Tensor | None], tuple[dict[str, Tensor], dict[str, Tensor]]]
    observe: Callable[[Tensors], dict[str, Tensor]]  # `observing.observe` of this plan
    tensors: dict[str, Tensor]  # fields of a state of `EXAMPLE_ENVS` environments
    memory: dict[str, Tensor]  # memory of as many
    dt: float | None  # time between steps [s], if fields have it


class FlatStep(nn.Module):
    """The step, of tensors in the order of `ports`; what all environments share is part of it."""

    def __init__(self, step: Step):
        super().__init__()
        self._step, self.touch = step, step.module
        self._memory = [name for name in step.memory if name not in SHARED]
        self._fields = [name for name in step.tensors if name != "dt"]
        self._shared = {name: f"shared_{i}" for i, name in enumerate([*SHARED, "dt"]) if name in step.memory | step.tensors}
        for name, buffer in self._shared.items():
            self.register_buffer(buffer, (step.memory | step.tensors)[name].clone())

    @property
    def example(self) -> dict[str, Tensor]:
        """The inputs that are traced, by name."""
        step = self._step
        result = {name: step.tensors[name] for name in self._fields}
        if self._memory:
            result["reset"] = torch.zeros(EXAMPLE_ENVS, dtype=torch.bool, device=next(iter(result.values())).device)
        return result | {f"memory/{name}": step.memory[name] for name in self._memory}

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Return readings, observations and the memory after the step."""
        given = dict(zip(self.example, tensors, strict=True))
        for name, tensor in given.items():
            assert_dtype(tensor, self.example[name].dtype)
        return tuple(self.outputs(given).values())

    def outputs(self, given: Tensors) -> dict[str, Tensor]:
        """Return the outputs by name."""
        shared = {name: self.get_buffer(buffer) for name, buffer in self._shared.items()}
        fields = {name: given[name] for name in self._fields} | {name: shared[name] for name in shared if name == "dt"}
        memory = {name: given[f"memory/{name}"] for name in self._memory} | shared
        readings, after = self._step.pure_step(fields, memory, given.get("reset"))
        observations = self._step.observe(readings) if self._step.plan.observations else {}
        result = {f"reading/{name}": reading for name, reading in readings.items()}
        result |= {f"observation/{name}": observation for name, observation in observations.items()}
        return result | {f"next/{name}": after[name].clone() for name in self._memory}


def signature_of(flat: FlatStep, step: Step, source: str, overrides: Sequence[str]) -> Signature:
    """Return what goes into a step and comes out of it."""
    inputs = flat.example
    with torch.no_grad():
        outputs = flat.outputs(inputs)

    def port(name: str, tensor: Tensor, rest: float | None = None) -> Port:
        return Port(name, tuple(tensor.shape[1:]), str(tensor.dtype).removeprefix("torch."), rest)

    def rest(name: str, tensor: Tensor) -> float | None:
        return next(iter(tensor.flatten().tolist()), 0.0) if name.startswith("memory/") else None

    return Signature(
        tuple(port(name, tensor, rest(name, tensor)) for name, tensor in inputs.items()),
        tuple(port(name, tensor) for name, tensor in outputs.items()),
        step.dt,
        step.plan.taxels_id,
        source,
        tuple(overrides),
        version("tgdsl"),
    )


def traced(flat: FlatStep, plan: Plan) -> torch.export.ExportedProgram:
    """Return the step as a graph.

    Raises:
        TgdslError: If some sensor computes by an operation that is none of torch's own.
    """
    example = flat.example
    env = torch.export.Dim.DYNAMIC
    with torch.no_grad():
        program = torch.export.export(flat, tuple(example.values()), dynamic_shapes=(tuple({0: env} for _ in example),))
    for node in list(program.graph.nodes):
        if node.target is torch.ops.aten.unbind.int and not node.users:  # of no rows: torch writes it and cannot read it
            program.graph.erase_node(node)
        elif getattr(node.target, "namespace", "aten") not in ("aten", "prims"):
            raise _refused(node.target.name().split(".")[0], plan)
    return program


def _refused(operation: str, plan: Plan) -> TgdslError:
    if operation in ON_HOST:
        names = [sensor.sensor for sensor in plan.sensors if any(_is_on_host(plan.quantities[name]) for name in sensor.uses)]
        return TgdslError(f"{listed(list(dict.fromkeys(names)))} cannot be exported: {ON_HOST[operation]}")
    return TgdslError(f"found the operation {operation}, which is none of torch's own: no exported file can have it")


def _is_on_host(part: Any) -> bool:
    """Return whether triangles are searched for some use of a quantity."""
    found = []

    def is_host(record: Any) -> bool:
        found.extend([record] if getattr(record, "stays_on_host", False) else [])
        return False

    tree.mapped(part, lambda array: array, is_host)
    return bool(found)


def without_strides(program: torch.export.ExportedProgram) -> torch.export.ExportedProgram:
    """Return a graph less views by strides of whole tensors, hints for Inductor, and less asserts: ONNX has neither."""
    for node in list(program.graph.nodes):
        if node.target is torch.ops.aten.as_strided.default and node.args[0].meta["val"].shape == node.meta["val"].shape:
            node.replace_all_uses_with(node.args[0])
            program.graph.erase_node(node)
        elif str(node.target) == ASSERT_DTYPE:
            program.graph.erase_node(node)
    program.graph_module.recompile()
    return program
