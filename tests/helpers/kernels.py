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
    chosen = {"TRITON_INTERPRET": "1", "PYTHONWARNINGS": "ignore", "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run([sys.executable, path, *arguments], env=os.environ | chosen, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-4000:]
    return run.stdout


def use_kernels() -> None:
    """Have operations of this process, which interprets kernels, launch them for float32 on the CPU as they do on a GPU."""
    torch.library.wrap_triton = lambda kernel: kernel  # torch.compile alone wants it, and older torch no interpreted one
    operations.are_kernel_inputs = lambda *tensors: all(tensor.dtype == torch.float32 for tensor in tensors)
