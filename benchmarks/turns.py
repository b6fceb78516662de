"""One process on the GPU at a time, while others trace and compile.

Tracing and compiling a module takes several times as long as timing it. So each case runs in a separate process, and several
run at once. Timing, and the choice of launch configurations at the first run of the code, need the GPU alone. The turn is a
lock on a shared file. A process takes it to put inputs on the GPU, gives it back to trace and compile, and takes it again
when its code first runs, until the process ends. Calls from Python are timed too: use fewer processes than half the cores.
"""

from __future__ import annotations

import argparse
import fcntl
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

import torch
from torch.fx import GraphModule

from tgdsl.module.module import TactileModule

Case = tuple[str, ...]


class Turn:
    """A lock on a file, which one process holds at a time."""

    def __init__(self, path: Path):
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT)  # open until the process ends
        self._is_taken = False

    def take(self) -> None:
        """Wait for the turn, unless this process has it."""
        if not self._is_taken:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX)
            self._is_taken = True

    def give_back(self) -> None:
        """Release the turn once the GPU is idle."""
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        self._is_taken = False

    def compile(self, touch: TactileModule) -> None:
        """Compile a module as `touch.compile()` does; take the turn right before its code first runs."""
        touch.compile(backend=self._backend, options=touch.inductor_options())

    def _backend(self, graph: GraphModule, inputs: list[Any], options: dict[str, Any]) -> Callable[..., Any]:
        from torch._inductor.compile_fx import compile_fx  # takes seconds

        call: Any = compile_fx(graph, inputs, config_patches=options)

        def in_turn(*arguments: Any) -> Any:
            self.take()
            return call(*arguments)

        return in_turn


def end() -> NoReturn:
    """End this process and its turn at once: clean-up takes seconds, for which others would wait."""
    sys.stdout.flush()
    os._exit(0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `children` reads to a command."""
    parser.add_argument("--jobs", type=int, default=1, help="processes at once: one times, the others trace and compile")
    parser.add_argument("--turn", type=Path, help="file to lock, shared by runs at the same time")
    parser.add_argument("--minutes", type=float, default=math.inf, help="time after which no process starts")
    parser.add_argument("--child", action="store_true", help="measure in this process; `run` sets it for its processes")


def children(options: argparse.Namespace, flags: list[str], cases: list[Case]) -> Iterator[tuple[Case, str | None, Path]]:
    """Repeat a command in one process per case, in turns.

    Args:
        options: The options of `add_options`, and `arguments`: the script and its arguments.
        flags: The options that select a case.
        cases: Their values.

    Yields:
        As processes end, the case, its output (None if `--minutes` had passed before it could start), and the path of its
        rows, which may not exist.
    """
    start, threads = time.perf_counter(), max(1, (os.cpu_count() or 1) // options.jobs)
    environment = {**os.environ, "TORCHINDUCTOR_COMPILE_THREADS": str(threads)}
    with TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        command = [sys.executable, *options.arguments, "--turn", str(options.turn or Path(folder, "turn")), "--child"]

        def output_of(case: Case, out: Path) -> str | None:
            if time.perf_counter() - start > 60 * options.minutes:
                return None
            selection = [text for pair in zip(flags, case, strict=True) for text in pair]
            child = subprocess.run([*command, *selection, "--out", str(out)], capture_output=True, text=True, env=environment)
            if child.returncode == 0:
                return child.stdout
            return f"{child.stdout}{', '.join(case)}: FAILED, exit status {child.returncode}\n{child.stderr[-3000:]}"

        outs = {case: Path(folder, f"{i}.json") for i, case in enumerate(cases)}
        futures = {pool.submit(output_of, case, out): case for case, out in outs.items()}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result(), outs[futures[future]]
        finally:
            pool.shutdown(cancel_futures=True)  # no case starts after an interrupt
