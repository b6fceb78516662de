"""Triton kernels on the CPU, by Triton's interpreter."""

import atexit
import json
import os
import runpy
import subprocess
import sys
import tempfile
import traceback
from functools import cache
from typing import IO

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
    """Run a test's module in a process without run-time checks of types, and return its output.

    Those checks wrap functions, of which torch then cannot infer the schema of an operator.
    """
    server = script_server(**chosen)
    assert server.stdin and server.stdout
    print(json.dumps([path, *arguments]), file=server.stdin, flush=True)
    status, output, errors = json.loads(server.stdout.readline())
    assert status == 0, errors[-4000:]
    return output


@cache
def script_server(**chosen: str) -> subprocess.Popen[str]:
    """Return a process that has imported torch and Triton, which takes 3 s, and forks to run each script."""
    chosen |= {"PYTHONWARNINGS": "ignore", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", "import kernels; kernels.serve()"]
    server = subprocess.Popen(command, env=os.environ | chosen, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(server.communicate)
    return server


def serve() -> None:
    """Run a script for each line of the input, a path and its arguments as JSON; write status, output and errors."""
    for line in sys.stdin:
        with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
            if (child := os.fork()) == 0:
                os.dup2(output.fileno(), 1)
                os.dup2(errors.fileno(), 2)
                run_script(*json.loads(line))
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            print(json.dumps([status, *(read_all(file) for file in (output, errors))]), flush=True)


def run_script(path: str, *arguments: str) -> None:
    """Run a script and end the process, which is a fork of the server."""
    sys.argv, status = [path, *arguments], 1
    try:
        runpy.run_path(path, run_name="__main__")
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def read_all(file: IO[bytes]) -> str:
    """Return the text of a file."""
    file.seek(0)
    return file.read().decode()


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
