"""Triton kernels on the CPU, by Triton's interpreter."""

import os
import subprocess
import sys
from functools import cache

import pytest
import torch.library

from tgdsl.tensors import operations
from tgdsl.tensors.operations import HAS_TRITON

needs_triton = pytest.mark.skipif(not HAS_TRITON, reason="Triton is not installed")


def interpreted(path: str, *arguments: str) -> str:
    """Run a test's module as a script whose kernels are interpreted, and return what it prints.

    That has to be chosen before Triton is imported, so it is a process of its own.
    """
    return as_script(path, *arguments, TRITON_INTERPRET="1")


def as_script(path: str, *arguments: str, **chosen: str) -> str:
    """Run a test's module in a process without run-time checks of types, and return what it prints.

    Those checks wrap functions, of which torch then cannot infer the schema of an operator.
    """
    chosen |= {"PYTHONWARNINGS": "ignore", "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run([sys.executable, path, *arguments], env=os.environ | chosen, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-4000:]
    return run.stdout


def use_kernels() -> None:
    """Have operations of this process launch kernels for float32 on the CPU, as they do on a GPU."""
    if os.environ.get("TRITON_INTERPRET"):
        torch.library.wrap_triton = lambda kernel: kernel  # only torch.compile wants it; older torch takes no interpreted one
        patch_language_once()
    operations.are_kernel_inputs = lambda *tensors: all(tensor.dtype == torch.float32 for tensor in tensors)


def patch_language_once() -> None:
    """Leave `triton.language` patched: the interpreter takes half of its time to do that at each call of a function in a kernel."""
    from triton.runtime import interpreter

    patch, patched = interpreter._patch_lang, set()

    def patch_once(function):
        if function.__module__ not in patched:
            patched.add(function.__module__)
            patch(function)
        return interpreter._LangPatchScope()  # has nothing to restore

    interpreter._patch_lang = patch_once


class AbsentGpu:
    """What Triton asks of a driver when it compiles: an H200's kind of GPU, which need not be there."""

    def get_current_target(self):
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", 90, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0


@cache
def assemble_kernels() -> list[str]:
    """Have kernels of this process compiled to machine code where they are launched, and no more; return their names so far."""
    from triton.runtime import driver
    from triton.runtime.jit import JITFunction

    assembled: list[str] = []
    own = JITFunction.run

    def run(self, *args, grid, warmup, **kwargs):
        kernel = own(self, *args, grid=grid, warmup=True, **kwargs)
        assert kernel.asm["cubin"]
        assembled.append(self.fn.__name__)

    driver.set_active(AbsentGpu())
    JITFunction.run = run
    use_kernels()
    return assembled
