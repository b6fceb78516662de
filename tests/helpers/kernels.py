"""Triton kernels on the CPU, by Triton's interpreter."""

import os
import subprocess
import sys

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
    operations.are_kernel_inputs = lambda *tensors: all(tensor.dtype == torch.float32 for tensor in tensors)
