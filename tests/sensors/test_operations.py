"""Operations with kernels: each kernel matches its definition, interpreted and on a GPU, and is launched when possible."""

import ast
import json
import sys
from functools import cache, partial
from pathlib import Path

import pytest
import torch
from kernels import as_script, assemble_kernels, interpreted, needs_triton, use_kernels
from operation_examples import EXAMPLES, mapped

from tgdsl.sensors.operations import OPERATIONS

PACKAGE = Path(__file__).parents[2] / "tgdsl"
OPERATION = {operation.name: operation for operation in OPERATIONS}
NAMES = list(OPERATION)
KERNEL_FILES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*_kernel.py"))
LIBRARIES = {"geometry/shapes_kernel.py"}
"""Functions that kernels call."""


def operators(file: str) -> set[str]:
    """Return the names of the custom operators that a file defines."""
    calls = [node for node in ast.walk(ast.parse((PACKAGE / file).read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    return {
        call.args[0].value.removeprefix("tgdsl::")  # type: ignore[union-attr]
        for call in calls
        if ast.unparse(call.func).rpartition(".")[2] in ("triton_op", "custom_op")
    }


def test_each_kernel_belongs_to_an_operation():
    assert len(NAMES) == len(OPERATIONS) and set(NAMES) == EXAMPLES.keys()
    names_by_file = {file: operators(file) & set(NAMES) for file in KERNEL_FILES if file not in LIBRARIES}
    assert {file for file, names in names_by_file.items() if not names} == set()
    assert sorted(name for names in names_by_file.values() for name in names) == sorted(NAMES)


@pytest.mark.parametrize("operation", OPERATIONS, ids=NAMES)
def test_a_cpu_does_not_take_the_kernel(operation):
    example = EXAMPLES[operation.name]
    assert not operation.takes_kernel(*example.arguments(torch.float32))


def error_of(name, result, arguments):
    """Return the error of a result against the definition in float64, as text."""
    example, exact = EXAMPLES[name], EXAMPLES[name].arguments(torch.float64)
    expected = example.compared(OPERATION[name].definition(*exact), exact)
    result = example.compared(result, arguments)
    for i, (part, other, tolerance) in enumerate(zip(result, expected, example.tolerances, strict=True)):
        if not other.double().abs().max() > 20 * tolerance:
            return f"part {i} is nothing"
        if not (part.double() - other.double()).abs().max() <= tolerance:
            return f"part {i} is off by {(part.double() - other.double()).abs().max():.2g}"
    return ""


def interpret(name):
    """Return the error of an interpreted kernel."""
    use_kernels()
    arguments = EXAMPLES[name].arguments(torch.float32)
    return error_of(name, OPERATION[name](*arguments), arguments)


def assemble(name):
    """Return "" if a GPU's kernel compiles to machine code."""
    assembled = assemble_kernels()
    (kernel,) = (Path(file).stem for file in KERNEL_FILES if name in operators(file))
    OPERATION[name](*EXAMPLES[name].arguments(torch.float32))
    return "" if any(compiled.startswith(kernel) for compiled in assembled) else f"no {kernel} among {assembled}"


def trace(name):
    """Return "" if one Dynamo graph contains the operator, on any device."""
    use_kernels()
    operators = []

    def backend(graph, inputs):
        operators.extend(str(node.target) for node in graph.graph.nodes)
        raise NotImplementedError("no kernel runs on this device")

    torch.compiler.reset()
    try:
        torch.compile(OPERATION[name], fullgraph=True, backend=backend)(*EXAMPLES[name].arguments(torch.float32))
    except Exception as error:
        if not operators:
            return str(error)
    return "" if f"tgdsl.{name}.default" in operators else f"there is no tgdsl::{name} in {operators}"


def launch(name, is_compiled):
    """Return the error of a GPU's kernel, or that it was not launched."""
    arguments = mapped(torch.Tensor.cuda, EXAMPLES[name].arguments(torch.float32))
    torch.compiler.reset()
    call = torch.compile(OPERATION[name], fullgraph=True) if is_compiled else OPERATION[name]
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        result = call(*arguments)
        torch.cuda.synchronize()
    (kernel,) = (Path(file).stem for file in KERNEL_FILES if name in operators(file))
    if not any(event.key.startswith(kernel) for event in profile.key_averages()):
        return f"no {kernel} among {[event.key for event in profile.key_averages()]}"
    return error_of(name, mapped(torch.Tensor.cpu, result), mapped(torch.Tensor.cpu, arguments))


MODES = {
    "interpret": interpret,
    "assemble": assemble,
    "trace": trace,
    "eager": partial(launch, is_compiled=False),
    "compiled": partial(launch, is_compiled=True),
}


@pytest.fixture(scope="module")
def errors():
    """Return a function from a mode to its errors by operation: one process runs all operations."""

    @cache
    def errors_of_mode(mode):
        return json.loads((interpreted if mode == "interpret" else as_script)(__file__, mode))

    return errors_of_mode


@needs_triton
@pytest.mark.parametrize("name", NAMES)
def test_an_interpreted_kernel_matches_its_definition(errors, name):
    assert errors("interpret")[name] == ""


@pytest.mark.slow
@needs_triton
@pytest.mark.parametrize("name", NAMES)
def test_a_kernel_compiles_for_an_absent_gpu(errors, name):
    assert errors("assemble")[name] == ""


@pytest.mark.slow
@needs_triton
@pytest.mark.parametrize("name", NAMES)
def test_one_graph_launches_the_kernel(errors, name):
    assert errors("trace")[name] == ""


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("mode", ["eager", "compiled"])
def test_a_gpu_launches_the_kernel_and_matches_the_definition(errors, mode, name):
    assert errors(mode)[name] == ""


def main() -> None:
    """Print the error of each operation."""
    with torch.no_grad():
        print(json.dumps({name: MODES[sys.argv[1]](name) for name in NAMES}))


if __name__ == "__main__":
    main()
