"""Only one file touches torch's private parts, and they work as tgdsl expects."""

import ast
from pathlib import Path

import pytest
import torch
from torch import nn

from tgdsl.tensors import torch_internals
from tgdsl.tensors.torch_internals import HookedModule, buffers_of, num_writes, with_own_code

PACKAGE = Path(__file__).parents[2] / "tgdsl"
OF_MODULES = {name for name in {*dir(nn.Module), *vars(nn.Module())} if name.startswith("_") and not name.endswith("__")}
OF_TENSORS = {"_version"}
"""Other private names of tensors are names in tgdsl too."""


def dotted(node: ast.AST) -> str:
    """Return "torch.ops.aten" for nested attributes of a name; "" for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (prefix := dotted(node.value)):
        return f"{prefix}.{node.attr}"
    return ""


def private_parts(text: str) -> set[str]:
    """Return the private names of torch that a source file touches."""

    def is_private(path: str) -> bool:
        return path.split(".")[0] == "torch" and any(
            part.startswith("_") and not part.endswith("__") for part in path.split(".")[1:]
        )

    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if is_private(alias.name)}
        elif isinstance(node, ast.ImportFrom):
            names |= {path for alias in node.names if is_private(path := f"{node.module}.{alias.name}")}
        elif isinstance(node, ast.Attribute):
            names |= {dotted(node)} if is_private(dotted(node)) else {node.attr} & (OF_MODULES | OF_TENSORS)
        elif isinstance(node, ast.ClassDef):
            names |= {part.name for part in node.body if isinstance(part, ast.FunctionDef)} & OF_MODULES
    return names


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import torch._dynamo", {"torch._dynamo"}),
        ("from torch._dynamo.utils import counters", {"torch._dynamo.utils.counters"}),
        ("from torch import _foreach_add_", {"torch._foreach_add_"}),
        ("torch.ops.aten._foreach_add_(a, b)", {"torch.ops.aten._foreach_add_"}),
        ("class A(nn.Module):\n  def _apply(self, fn): pass", {"_apply"}),
        ("module.constants._buffers[name] = 1", {"_buffers"}),
        ("reading()._version", {"_version"}),
        ("import torch\ntorch.__version__; self._rings\ndef _parameters(): pass", set()),
    ],
)
def test_private_parts_are_recognised(text, found):
    assert private_parts(text) == found


def test_only_two_files_touch_private_parts_of_torch():
    private = {
        path.relative_to(PACKAGE).as_posix(): private_parts(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")
    }
    standalone = "module/export/standalone.py"  # runs without tgdsl
    assert private.pop(standalone) == {"torch._inductor", "torch._inductor.aoti_load_package"}
    assert private.pop("tensors/torch_internals.py") > {
        "torch._foreach_copy_",
        "_apply",
        "_load_from_state_dict",
        "_buffers",
        "_version",
    }
    assert {name: parts for name, parts in private.items() if parts} == {}


class Recorder(HookedModule):
    """Records its events, and refuses incomplete state."""

    def __init__(self):
        super().__init__()
        self.register_buffer("value", torch.zeros(2))
        self.register_buffer("other", torch.zeros(2))
        self.events = []

    def on_move(self, fn, move):
        self.events.append((fn(torch.zeros(())).dtype, buffers_of(self)["value"].dtype))
        move()
        self.events.append(buffers_of(self)["value"].dtype)

    def on_load(self, state_dict, prefix, errors, load):
        if f"{prefix}other" in state_dict:
            load()
        else:
            errors.append(f"half of {prefix}")


@pytest.mark.parametrize("depth", [0, 1])
def test_hooks_run_on_move_and_on_load(depth):
    recorder = Recorder()
    whole, prefix = (nn.Sequential(recorder), "0.") if depth else (recorder, "")
    assert whole.double() is whole
    assert recorder.events == [(torch.float64, torch.float32), torch.float64]
    whole.load_state_dict({f"{prefix}value": torch.ones(2), f"{prefix}other": torch.ones(2)})
    assert recorder.value.tolist() == [1, 1] and recorder.value.dtype == torch.float64
    with pytest.raises(RuntimeError, match=f"{type(whole).__name__}:\n\thalf of {prefix}$"):
        whole.load_state_dict({f"{prefix}value": torch.zeros(2), f"{prefix}unknown": torch.zeros(2)})
    assert recorder.value.tolist() == [1, 1]


def test_writes_are_counted():
    tensor = torch.zeros(3)
    initial = num_writes(tensor)
    tensor[1] = 1
    assert num_writes(tensor) == num_writes(tensor.detach()) == initial + 1
    with torch.inference_mode():
        assert num_writes(torch.zeros(3)) == -1


def test_below_autograd_tensors_stay_ordinary():
    """They work with derivatives afterwards, writes are counted, and results match to the last bit."""
    parameter = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    base = torch.rand(3)
    expected, initial = (2 * base)[1:].exp().sum(), num_writes(base)
    with torch.no_grad(), torch_internals.below_autograd():
        twice = 2 * base
        part = twice[1:]
        part.exp_()
        assert not (parameter * base).requires_grad
    assert torch.equal(twice[1:].sum(), expected) and num_writes(base) == initial
    assert num_writes(twice) == num_writes(part) == 1 and not twice.is_inference()
    (parameter * twice).sum().backward()
    assert torch.equal(parameter.grad, twice)


def test_every_tensor_of_a_list_is_written():
    tensors = [torch.zeros(2), torch.ones(3)]
    torch_internals.add_each(tensors, [2, 3])
    assert [tensor.tolist() for tensor in tensors] == [[2, 2], [4, 4, 4]]
    torch_internals.copy_each(tensors, [torch.ones(2), torch.zeros(3)])
    assert [tensor.tolist() for tensor in tensors] == [[1, 1], [0, 0, 0]]


def test_objects_share_no_compiled_code():
    class Adder:
        def __init__(self, number):
            self.number = number

        def add(self, tensor):
            return tensor + self.number

    torch.compiler.reset()
    initial = torch_internals.num_compiled_graphs()
    with torch._dynamo.config.patch(error_on_recompile=True, recompile_limit=1):
        for number in range(3):
            call = torch.compile(with_own_code(Adder(number).add), backend="eager")
            assert call(torch.zeros(1)).item() == call(torch.zeros(1)).item() == number
    assert torch_internals.num_compiled_graphs() == initial + 3


def test_inductor_knows_the_options():
    from torch._inductor import config

    for name in torch_internals.inductor_options(True, True, True, True):
        assert name in config.get_config_copy()
