"""One process on the GPU at a time, while others trace and compile.

To trace and compile a module takes several times as long as to time it. So each case has a process of its own, and some run at
once. But what is timed needs the GPU for itself, and so do launch configurations, which are chosen by timing when code runs
first. So a process has the turn, a lock on a file that all share, while it puts its inputs on the GPU; gives it back to trace
and compile; and takes it again when its code runs first, to hold it until it ends. Calls from Python are timed too: processes
should be fewer than half of the processors.
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
    """A process's turn: only one of all has it at a time."""

    def __init__(self, path: Path):
        """Take nothing yet; the turn is the lock on a file."""
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT)  # which nothing closes
        self._is_taken = False

    def take(self) -> None:
        """Wait for the turn; there is nothing to do while it is taken."""
        if not self._is_taken:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX)
            self._is_taken = True

    def give_back(self) -> None:
        """Let others have the turn once the GPU is done."""
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        self._is_taken = False

    def compile(self, touch: TactileModule) -> None:
        """Compile a module as `touch.compile()` does; right before its code runs first, the turn is taken."""
        touch.compile(backend=self._backend, options=touch.inductor_options())

    def _backend(self, graph: GraphModule, inputs: list[Any], options: dict[str, Any]) -> Callable[..., Any]:
        from torch._inductor.compile_fx import compile_fx  # takes seconds

        call: Any = compile_fx(graph, inputs, config_patches=options)

        def in_turn(*arguments: Any) -> Any:
            self.take()
            return call(*arguments)

        return in_turn


def end() -> NoReturn:
    """End this process and its turn at once: to tidy up takes seconds, for which others would wait."""
    sys.stdout.flush()
    os._exit(0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add to a command what `children` asks for."""
    parser.add_argument("--jobs", type=int, default=1, help="processes at once: one times, the others trace and compile")
    parser.add_argument("--turn", type=Path, help="file of the turns, for runs at the same time that share them")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin nothing after so long")
    parser.add_argument("--child", action="store_true", help="measure here, as `run` asks of each process that it begins")


def children(options: argparse.Namespace, flags: list[str], cases: list[Case]) -> Iterator[tuple[Case, str | None, Path]]:
    """Run a command again in a process per case, in turns.

    Args:
        options: What `add_options` added; and `arguments`, the script and its arguments.
        flags: The options that say which case it is.
        cases: Their values.

    Yields:
        As processes end, the case, what was printed (None: the time was up before it began), and where its rows are, if any.
    """
    start, threads = time.perf_counter(), max(1, (os.cpu_count() or 1) // options.jobs)
    environment = {**os.environ, "TORCHINDUCTOR_COMPILE_THREADS": str(threads)}
    with TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        always = [sys.executable, *options.arguments, "--turn", str(options.turn or Path(folder, "turn")), "--child"]

        def printed(case: Case, out: Path) -> str | None:
            if time.perf_counter() - start > 60 * options.minutes:
                return None
            own = [text for pair in zip(flags, case, strict=True) for text in pair]
            done = subprocess.run([*always, *own, "--out", str(out)], capture_output=True, text=True, env=environment)
            if done.returncode == 0:
                return done.stdout
            return f"{done.stdout}{', '.join(case)}: FAILED, exit status {done.returncode}\n{done.stderr[-3000:]}"

        outs = {case: Path(folder, f"{i}.json") for i, case in enumerate(cases)}
        ended = {pool.submit(printed, case, out): case for case, out in outs.items()}
        try:
            for future in as_completed(ended):
                yield ended[future], future.result(), outs[ended[future]]
        finally:
            pool.shutdown(cancel_futures=True)  # who is interrupted begins nothing more
