"""All of torch that is not public and that tgdsl needs, each behind one name, with the reason. Tried with torch 2.11 and 2.13.

Nothing else in tgdsl touches a name of torch that begins with an underscore (`tests/tensors/test_torch_internals.py`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import torch
from torch import Tensor, nn
from torch._C._functorch import maybe_current_level
from torch.autograd import forward_ad
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = ["HookedModule", "TorchDispatchMode"]
# TorchDispatchMode sees each operation that an eager run makes. torch documents it, but has it in a private module.


class HookedModule(nn.Module):
    """A module that can act when its tensors are moved or cast, and when a state dict is loaded.

    nn.Module has no hook for the first. For the second it has some, but none that can refuse to load: of half a state nothing
    may be loaded, nor may torch complain about names that are then unexpected.
    """

    def on_move(self, fn: Callable[[Tensor], Tensor], move: Callable[[], object]) -> None:
        """Move or cast all tensors, as in `to`, `cuda` and `double`: `move` does `fn` to each; a subclass may do more."""
        move()

    def on_load(self, state_dict: dict[str, Any], prefix: str, errors: list[str], load: Callable[[], object]) -> None:
        """Load the module's own buffers from below `prefix`; a subclass may make room for them first, or leave them.

        `errors` collects the errors of the state dict; `load_state_dict` raises all of them at its end.
        """
        load()

    def on_load_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Check the metadata that `state_dict` stored for this module, before its tensors are loaded; here, do nothing."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> HookedModule:
        self.on_move(fn, lambda: super(HookedModule, self)._apply(fn, recurse))
        return self

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, metadata: dict[str, Any], strict: bool, *messages: list[str]
    ) -> None:
        missing, unexpected, errors = messages
        self.on_load_metadata(metadata)
        arguments = state_dict, prefix, metadata, strict, missing, unexpected, errors
        self.on_load(state_dict, prefix, errors, lambda: super(HookedModule, self)._load_from_state_dict(*arguments))


def buffers_of(module: nn.Module) -> dict[str, Tensor | None]:
    """Return a module's own buffers, not a copy: `get_buffer` takes 1.2 µs where this takes 0.05 µs, for each at each call."""
    return module._buffers


def held_buffers(module: nn.Module) -> dict[str, Tensor]:
    """Return a new dictionary of a module's own buffers that are not None: `named_buffers` takes longer."""
    return {name: buffer for name, buffer in buffers_of(module).items() if buffer is not None}


def mark_static(tensor: Tensor) -> None:
    """Let torch.compile treat a tensor's shape as constant under dynamic shapes, as it does for a module's buffers.

    This is `torch._dynamo.mark_static` without importing `torch._dynamo`, which takes seconds.
    """
    tensor._dynamo_static_indices = set(range(tensor.ndim))  # type: ignore[attr-defined]
    tensor._has_dynamo_dim_marking = True  # type: ignore[attr-defined]


def num_writes(tensor: Tensor) -> int:
    """Return how often a tensor was written into, as autograd counts it; −1 of inference tensors, which do not count.

    There is no public way to see that memory was changed without a copy of it.
    """
    return -1 if tensor.is_inference() else tensor._version


def below_autograd() -> AbstractContextManager[object]:
    """Return a context in which operations skip autograd's layer of the dispatcher: small ones take four fifths of their time.

    For use where derivatives are off. Tensors stay ordinary ones, and writes are counted, unlike under `inference_mode`, whose
    tensors cannot be used outside of it. torch's own Python layer of custom operations enters it so.
    """
    context: Any = torch._C._AutoDispatchBelowAutograd()
    return context


def is_followed() -> bool:
    """Return whether torch intercepts each operation, so that work outside torch, or branches on values, would be lost.

    Interceptors are forward-mode derivatives (`torch.autograd.forward_ad`, `torch.func.jvp`), also without gradients; `vmap`;
    tracing; and dispatch modes, which count or record. The check takes 0.2 µs. Reason: none of it is public.
    """
    return (
        maybe_current_level() is not None
        or forward_ad._current_level >= 0
        or torch._C._len_torch_dispatch_stack() > 0
        or torch._C._is_tracing()
    )


def is_exporting() -> bool:
    """Return whether torch.export traces: to torch.compile of torch 2.11 `torch.compiler.is_exporting` is always true."""
    return torch.compiler._is_exporting_flag


def copy_each(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy tensors of one dtype into others by one kernel on a GPU. `copy_` launches one for each."""
    torch._foreach_copy_(list(targets), list(sources))  # pyright: ignore[reportPrivateImportUsage]


def add_each(targets: Sequence[Tensor], numbers: Sequence[int]) -> None:
    """Add a number to each of some tensors in place, by one kernel on a GPU and without a copy from the host."""
    torch.ops.aten._foreach_add_.ScalarList(list(targets), numbers)


def inductor_cache() -> Path:
    """Return the folder of what torch.compile has compiled: there is a public variable for it, but no public default."""
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir

    return Path(os.environ.get("TORCHINDUCTOR_CACHE_DIR") or default_cache_dir())


def with_own_code(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a bound method whose code object is a copy, so that torch.compile shares nothing between objects.

    Dynamo stores compiled code with the method's code object, for all objects together. It checks all of their guards at each
    call, and refuses to compile for more than eight objects (`recompile_limit`).
    """
    assert isinstance(method, MethodType)
    function = method.__func__
    copy = FunctionType(
        function.__code__.replace(), function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    return MethodType(copy, method.__self__)


def inductor_options(checks_indices: bool, has_tiles: bool, has_slots: bool, is_fused: bool) -> dict[str, Any]:
    """Return options for torch.compile, which are names of Inductor's private configuration.

    Kernels may assert that indices read from tensors are in range; on a GPU have tiles of 32 × 32 of two axes, not blocks of
    one flat axis; sum over slots of contacts; and have as many operations as can be, instead of 64 at most.
    """
    # Sizes of blocks are chosen by timing, but of a kernel that takes 10 µs that is the time of its launch. Without timing sums
    # over slots have one row a block (47 µs for 5), from where coordinate descent goes on; of a depth alone it chooses worse
    # tiles (14 to 31 µs for 11). From Hopper on each kernel with tiles is launched while the one before it ends (programmatic
    # dependent launch).
    options: dict[str, Any] = {
        "assert_indirect_indexing": checks_indices,
        "triton.prefer_nd_tiling": has_tiles,
        "triton.autotune_pointwise": not has_tiles,
        "coordinate_descent_tuning": has_tiles and has_slots,
        "triton.enable_pdl": has_tiles,
    }
    return options | {"max_fusion_size": 1024} if is_fused else options


def fix_sizes(tensor: Tensor, sizes: Sequence[int]) -> None:
    """Let torch.compile take the last sizes of a tensor for these constants, where it traces with dynamic shapes.

    `torch._check` is documented, but has no public name.
    """
    for size, expected in zip(tensor.shape[tensor.ndim - len(sizes) :], sizes, strict=True):
        torch._check(size == expected)


def expect_size(size: torch.SymInt, value: int) -> torch.SymInt:
    """Return a size that only a call will know, unchanged, after telling Inductor's estimates what to expect.

    `torch._check` can bound a size, but nothing public gives a likely value. Versions without this estimate less well.
    """
    hints = getattr(size.node.shape_env, "var_to_hint_override", None)
    if hints is not None:
        hints[size.node.expr] = value
    return size


ASSERT_DTYPE = "aten._assert_tensor_metadata.default"  # the operation that `assert_dtype` makes


def assert_dtype(tensor: Tensor, dtype: torch.dtype) -> None:
    """Have a graph of torch.export refuse tensors of another dtype: it looks at shapes by itself, and at nothing else."""
    torch.ops.aten._assert_tensor_metadata(tensor, None, None, dtype)


def write_package(program: torch.export.ExportedProgram, path: Path, options: Mapping[str, Any]) -> None:
    """Write AOTInductor's package of a graph; it looks at its inputs at each call, see `_checked`."""
    from torch._inductor import aoti_compile_and_package

    with _checked():
        aoti_compile_and_package(program, package_path=str(path), inductor_configs=dict(options))


@contextmanager
def _checked() -> Iterator[None]:
    """Have AOTInductor's packages refuse inputs of a wrong dtype, shape, stride or device, or of unlike numbers of rows."""
    from torch._inductor import config
    from torch._inductor.codegen.cpp_wrapper_cpu import CppWrapperCpu
    from torch._inductor.virtualized import V

    unset, set_ = "env_var_value != nullptr && env_var_value[0]", "env_var_value == nullptr || env_var_value[0]"
    original = CppWrapperCpu.generate_input_output_runtime_checks

    def generate(self: Any) -> None:
        original(self)
        lines = self.prefix._lines
        at = [i for i, line in enumerate(lines) if isinstance(line, str) and unset in line]
        assert len(at) == 1 and lines[-1].strip() == "}", "another version of Inductor, which writes other checks"
        lines[at[0]] = lines[at[0]].replace(unset, set_)
        lines.insert(-1, _EQUAL_ROWS.format(count=len(V.graph.graph_inputs)))

    CppWrapperCpu.generate_input_output_runtime_checks = generate
    try:
        with config.patch({"aot_inductor.check_lowerbound": False}):
            yield
    finally:
        CppWrapperCpu.generate_input_output_runtime_checks = original


_EQUAL_ROWS = """
    for (int i = 0; i < {count}; i++) {{
        int64_t rows, first;
        AOTI_TORCH_ERROR_CODE_CHECK(aoti_torch_get_size(input_handles[i], 0, &rows));
        AOTI_TORCH_ERROR_CODE_CHECK(aoti_torch_get_size(input_handles[0], 0, &first));
        if (rows != first) {{
            throw std::runtime_error("input_handles[" + std::to_string(i) + "]: found " + std::to_string(rows)
                + " rows, input_handles[0] has " + std::to_string(first));
        }}
    }}
"""


def num_compiled_graphs() -> int:
    """Return how many graphs torch.compile has captured in this process. `torch._dynamo` is imported late: it takes seconds."""
    from torch._dynamo.utils import counters

    return counters["stats"]["unique_graphs"]
