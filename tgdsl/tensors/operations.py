"""Operations with a definition in torch and a Triton kernel, and the choice between the two.

An operation stands in the file of its definition. The kernel's file does not import that file; both import shared code from
lower modules. `tgdsl.sensors.operations` lists all operations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Generic, ParamSpec, TypeVar

import torch
from torch import Tensor

from tgdsl.tensors.torch_internals import is_exporting

P = ParamSpec("P")
R = TypeVar("R")

HAS_TRITON = find_spec("triton") is not None  # whether Triton is installed, as it is with every build of torch for a GPU


@dataclass(frozen=True)
class Operation(Generic[P, R]):
    """A function of tensors: torch's operations define it, a Triton kernel stands in for them where it can."""

    name: str  # name of the custom operator that launches the kernel, in the namespace "tgdsl"
    definition: Callable[P, R]  # in torch's operations; differentiable, for any device and dtype
    # the same by the kernel. It imports the kernel's file in its body: Triton is neither installed everywhere nor imported in
    # an instant, and torch.compile traces an import statement, but no `importlib.import_module`.
    kernel: Callable[P, R]
    inputs: Callable[P, Iterable[Tensor]]  # the tensors that must be float32, on a GPU and without derivatives
    condition: Callable[P, bool] | None = None  # further condition on the arguments; None: none

    def takes_kernel(self, *args: P.args, **kwargs: P.kwargs) -> bool:
        """Return whether a call with these arguments launches the kernel."""
        is_met = self.condition is None or self.condition(*args, **kwargs)
        return is_met and are_kernel_inputs(*self.inputs(*args, **kwargs))

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the operation's value, by the kernel if that can take the arguments."""
        if self.takes_kernel(*args, **kwargs):
            return self.kernel(*args, **kwargs)
        return self.definition(*args, **kwargs)


def are_kernel_inputs(*tensors: Tensor) -> bool:
    """Return whether a Triton kernel can take these: all float32 on a GPU, and no derivatives are wanted, which it lacks.

    An exported program has none: it runs where tgdsl is not.
    """
    are_fit = all(tensor.is_cuda and tensor.dtype == torch.float32 for tensor in tensors)
    return HAS_TRITON and len(tensors) > 0 and are_fit and not (needs_autograd(*tensors) or is_exporting())


def needs_autograd(*tensors: Tensor) -> bool:
    """Return whether derivatives with respect to any of these are wanted."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
