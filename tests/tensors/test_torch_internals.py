"""That what is private in torch is touched in one file alone, and what tgdsl expects of it."""

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
"""Others of a tensor's are names of ours too."""


def dotted(node: ast.AST) -> str:
    """Return "torch.ops.aten" of an attribute of attributes of a name; "" of anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (before := dotted(node.value)):
        return f"{before}.{node.attr}"
    return ""


def private_parts(text: str) -> set[str]:
    """Return the private names of torch that a source file touches."""

    def is_private(path: str) -> bool:
        return path.split(".")[0] == "torch" and any(
            part.startswith("_") and not part.endswith("__") for part in path.split(".")[1:]
        )

    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if is_private(alias.name)}
        elif isinstance(node, ast.ImportFrom):
            found |= {path for alias in node.names if is_private(path := f"{node.module}.{alias.name}")}
        elif isinstance(node, ast.Attribute):
            found |= {dotted(node)} if is_private(dotted(node)) else {node.attr} & (OF_MODULES | OF_TENSORS)
        elif isinstance(node, ast.ClassDef):
            found |= {part.name for part in node.body if isinstance(part, ast.FunctionDef)} & OF_MODULES
    return found


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
def test_the_finder_of_private_parts(text, found):
    assert private_parts(text) == found


def test_nothing_else_touches_what_is_private_in_torch():
    found = {
        path.relative_to(PACKAGE).as_posix(): private_parts(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")
    }
    alone = "module/export/standalone.py"  # runs where tgdsl is not
    assert found.pop(alone) == {"torch._inductor", "torch._inductor.aoti_load_package"}
    assert found.pop("tensors/torch_internals.py") > {
        "torch._foreach_copy_",
        "_apply",
        "_load_from_state_dict",
        "_buffers",
        "_version",
    }
    assert {name: parts for name, parts in found.items() if parts} == {}


class Recorder(HookedModule):
    """Notes what happens to it, and loads nothing that is wrong."""

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
def test_a_module_acts_when_it_is_moved_and_when_it_is_loaded(depth):
    own = Recorder()
    whole, prefix = (nn.Sequential(own), "0.") if depth else (own, "")
    assert whole.double() is whole
    assert own.events == [(torch.float64, torch.float32), torch.float64]
    whole.load_state_dict({f"{prefix}value": torch.ones(2), f"{prefix}other": torch.ones(2)})
    assert own.value.tolist() == [1, 1] and own.value.dtype == torch.float64
    with pytest.raises(RuntimeError, match=f"{type(whole).__name__}:\n\thalf of {prefix}$"):
        whole.load_state_dict({f"{prefix}value": torch.zeros(2), f"{prefix}unknown": torch.zeros(2)})
    assert own.value.tolist() == [1, 1]


def test_writes_are_counted():
    tensor = torch.zeros(3)
    before = num_writes(tensor)
    tensor[1] = 1
    assert num_writes(tensor) == num_writes(tensor.detach()) == before + 1
    with torch.inference_mode():
        assert num_writes(torch.zeros(3)) == -1


def test_below_autograd_tensors_stay_ordinary_ones():
    """They can be used with derivatives afterwards, writes are counted, and what is computed is the same to the last bit."""
    parameter = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    base = torch.rand(3)
    expected, before = (2 * base)[1:].exp().sum(), num_writes(base)
    with torch.no_grad(), torch_internals.below_autograd():
        twice = 2 * base
        part = twice[1:]
        part.exp_()
        assert not (parameter * base).requires_grad
    assert torch.equal(twice[1:].sum(), expected) and num_writes(base) == before
    assert num_writes(twice) == num_writes(part) == 1 and not twice.is_inference()
    (parameter * twice).sum().backward()
    assert torch.equal(parameter.grad, twice)


def test_each_of_some_tensors_is_written():
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
    before = torch_internals.num_compiled_graphs()
    with torch._dynamo.config.patch(error_on_recompile=True, recompile_limit=1):
        for number in range(3):
            call = torch.compile(with_own_code(Adder(number).add), backend="eager")
            assert call(torch.zeros(1)).item() == call(torch.zeros(1)).item() == number
    assert torch_internals.num_compiled_graphs() == before + 3


def test_inductor_has_the_options():
    from torch._inductor import config

    for name in torch_internals.inductor_options(True, True, True):
        assert name in config.get_config_copy()
