"""A module's step as a file that runs without tgdsl: torch.export's, AOTInductor's or ONNX.

A step is a graph of torch's own operations with flat inputs and outputs and any number of environments. Its signature lists
inputs and outputs in order, as text in the same file.

Shapes: `env` environments.
"""

from __future__ import annotations

import json
import logging
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from tgdsl.errors import ArtifactError, TgdslError, listed
from tgdsl.files.write import atomic_path
from tgdsl.module.memory import SHARED
from tgdsl.plan import tree
from tgdsl.plan.plan import Plan
from tgdsl.tensors.torch_internals import ASSERT_DTYPE, assert_dtype, write_package

Tensors = Mapping[str, Tensor]
File = Literal["pt2", "aoti", "onnx"]
ENDINGS: dict[File, str] = {"pt2": ".pt2", "aoti": ".aoti.pt2", "onnx": ".onnx"}
ENTRY = "tgdsl.json"  # the text in a .pt2 file, below `extra/`; in an ONNX file it is metadata of the name without the ending
FORMAT = 1
OPSET = 20
EXAMPLE_ENVS = 3
"""Environments of the tensors that are traced: no size of a module's, and neither 0 nor 1, which torch takes for constants."""
# operations of tgdsl that run in Python alone, with the reason
ON_HOST = {
    "tgdsl::mesh_distance": "`query: raycast` searches triangles with NVIDIA Warp, which runs in Python; expected `query: sdf`",
}


@dataclass(frozen=True)
class Port:
    """A tensor that goes in or comes out: its shape after `env`, and its dtype, such as "float32".

    Its name is a field of `SceneState`, `substep/<i>/<field>`, `reset`, `memory/<name>`; `reading/<name>`,
    `observation/<group>`, `next/<name>`. `rest` is what all numbers of a memory are before the first call.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    rest: float | None = None


@dataclass(frozen=True)
class Signature:
    """All inputs and outputs of a step, in order; each `next/<name>` goes in as `memory/<name>` at the next one."""

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    dt: float | None  # time between the program's steps [s]; None if nothing depends on it
    taxels_id: str  # see `TactileModule.taxels_id`
    source: str  # document or artefact that it was exported from; empty if it was a module in memory
    overrides: tuple[str, ...]  # the document's overrides
    version: str  # of tgdsl
    format: int = FORMAT

    def to_json(self) -> str:
        """Return the text."""
        return json.dumps(asdict(self), indent=1)


def read_signature(path: Path) -> Signature:
    """Return the signature of an exported file."""
    try:
        if path.suffix == ".onnx":
            import onnx

            properties = onnx.load(str(path), load_external_data=False).metadata_props
            text = next(entry.value for entry in properties if entry.key == Path(ENTRY).stem)
        else:
            with zipfile.ZipFile(path) as archive:
                if damaged := archive.testzip():
                    raise zipfile.BadZipFile(f"{damaged} is damaged")
                name = next(name for name in archive.namelist() if name.endswith(f"/extra/{ENTRY}"))
                text = archive.read(name).decode()
        values: dict[str, Any] = json.loads(text)
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # what parsers of protobuf and zip raise has no common base
        why = f": {error}" if str(error) else ""
        raise ArtifactError(f"{path}: expected a whole file that `tgdsl export` wrote (.pt2, .onnx){why}") from error
    if values.get("format") != FORMAT:
        raise ArtifactError(f"{path}: found format {values.get('format')}, expected {FORMAT}; export it again")
    for side in ("inputs", "outputs"):
        values[side] = tuple(Port(**{**port, "shape": tuple(port["shape"])}) for port in values[side])
    return Signature(**{**values, "overrides": tuple(values["overrides"])})


class Step(NamedTuple):
    """The parts of a module that are exported."""

    plan: Plan
    constants: nn.Module
    pure_step: Callable[[Tensors, Tensors, Tensor | None], tuple[dict[str, Tensor], dict[str, Tensor]]]
    observe: Callable[[Tensors], dict[str, Tensor]]
    tensors: dict[str, Tensor]  # fields of a state of `EXAMPLE_ENVS` environments
    memory: dict[str, Tensor]  # memory of as many
    dt: float | None  # time between steps [s], if fields have it


class FlatStep(nn.Module):
    """The step, of tensors in the order of its ports; what all environments share is part of it."""

    def __init__(self, step: Step):
        super().__init__()
        self._step, self.touch = step, step.constants
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
        inputs = dict(zip(self.example, tensors, strict=True))
        for name, tensor in inputs.items():
            assert_dtype(tensor, self.example[name].dtype)
        return tuple(self.outputs(inputs).values())

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


def export_step(step: Step, path: Path, to: File, options: dict[str, Any], source: str, overrides: Sequence[str]) -> Signature:
    """Write a step; `options` are for Inductor. See `TactileModule.export`."""
    flat = FlatStep(step)
    with torch.no_grad():
        outputs = flat.outputs(flat.example)

    def port(name: str, tensor: Tensor) -> Port:
        rest = next(iter(tensor.flatten().tolist()), 0.0) if name.startswith("memory/") else None
        return Port(name, tuple(tensor.shape[1:]), str(tensor.dtype).removeprefix("torch."), rest)

    inputs, results = (tuple(port(name, tensor) for name, tensor in side.items()) for side in (flat.example, outputs))
    taxels, of_tgdsl = step.plan.taxels_id, version("tgdsl")
    signature = Signature(inputs, results, step.dt, taxels, source, tuple(overrides), of_tgdsl)
    program, text = _traced(flat, step.plan), {Path(ENTRY).stem: signature.to_json()}
    with atomic_path(path) as temporary:
        if to == "onnx":
            input_names, output_names = ([port.name for port in ports] for ports in (inputs, results))
            write_onnx(_without_strides(program), input_names, output_names, text, temporary)
        elif to == "pt2":
            torch.export.save(program, str(temporary), extra_files={ENTRY: signature.to_json()})
        else:
            write_package(program, temporary, {**options, "aot_inductor.metadata": text})
            with zipfile.ZipFile(temporary, "a") as archive:
                folder = archive.namelist()[0].partition("/")[0]
                archive.writestr(f"{folder}/extra/{ENTRY}", signature.to_json())
    return signature


def format_of(path: Path, to: str | None) -> File:
    """Return the format of a file, by its name's ending if it is not given."""
    result = to or next((name for name in reversed(ENDINGS) if path.name.endswith(ENDINGS[name])), None)
    if result not in ENDINGS:
        expected = f"expected one of {', '.join(ENDINGS)}, or a file's name with .pt2 or .onnx"
        raise TgdslError(f"found {to or path.name!r}, {expected}")
    if path.suffix != (ending := ".onnx" if result == "onnx" else ".pt2"):
        raise TgdslError(f"{path}: the format {result} has the ending {ending}")
    if result == "onnx" and not (find_spec("onnx") and find_spec("onnxscript")):
        raise TgdslError('ONNX files need onnx and onnxscript: pip install "tgdsl[export]"')
    return result


def write_onnx(
    program: torch.export.ExportedProgram,
    inputs: Sequence[str],
    outputs: Sequence[str],
    metadata: dict[str, str],
    path: Path,
) -> None:
    """Write a graph as ONNX, with names of its inputs and outputs in order, and texts by name as metadata."""
    import onnx

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # that torchvision is not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch's own use of a part of torch that it has deprecated
        converted: Any = torch.onnx.export(
            program,
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=True,
            optimize=False,  # it takes x + 1e-24 for x
            verbose=False,
        )
    model = converted.model_proto
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, str(path))


def _traced(flat: FlatStep, plan: Plan) -> torch.export.ExportedProgram:
    """Return the step as a graph; operations that are not torch's are errors."""
    example = flat.example
    env = torch.export.Dim.DYNAMIC
    with torch.no_grad():
        program = torch.export.export(flat, tuple(example.values()), dynamic_shapes=(tuple({0: env} for _ in example),))
    for node in list(program.graph.nodes):
        if node.target is torch.ops.aten.unbind.int and not node.users:  # of no rows: torch writes it and cannot read it
            program.graph.erase_node(node)
        elif getattr(node.target, "namespace", "aten") not in ("aten", "prims"):
            operation = node.target.name().split(".")[0]
            if operation not in ON_HOST:
                problem = f"found the operation {operation}, which is none of torch's own"
                raise TgdslError(f"{problem}: no exported file can have it")
            names = [
                sensor.sensor for sensor in plan.sensors if any(_is_on_host(plan.quantities[name]) for name in sensor.uses)
            ]
            raise TgdslError(f"{listed(list(dict.fromkeys(names)))} cannot be exported: {ON_HOST[operation]}")
    return program


def _is_on_host(part: Any) -> bool:
    """Return whether some use of a quantity searches triangles on the host."""
    flags: list[bool] = []
    tree.mapped(part, lambda array: array, lambda record: bool(flags.append(getattr(record, "stays_on_host", False))))
    return any(flags)


def _without_strides(program: torch.export.ExportedProgram) -> torch.export.ExportedProgram:
    """Return a graph less views by strides of whole tensors, hints for Inductor, and less asserts: ONNX has neither."""
    for node in list(program.graph.nodes):
        if node.target is torch.ops.aten.as_strided.default and node.args[0].meta["val"].shape == node.meta["val"].shape:
            node.replace_all_uses_with(node.args[0])
            program.graph.erase_node(node)
        elif str(node.target) == ASSERT_DTYPE:
            program.graph.erase_node(node)
    program.graph_module.recompile()
    return program
