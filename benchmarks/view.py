"""Measure the cost of a page for a loop or a learner: alternating blocks of steps with and without it, and a connected browser.

The browser is a websocket client that reads the page's messages and draws nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

import tgdsl
from tgdsl.view.mirror import LoopPage

Opened = tuple[LoopPage, Callable[[], object], Callable[[], object]]
"""A page, a step without it and a step with it."""


@dataclass
class ViewCost:
    """Time the loop of a document, or the iterations of a task's learner, bare and shown."""

    document: tyro.conf.Positional[Path] = Path("examples/xhand1_palm.yaml")
    learner: bool = False
    """Time `tgdsl train --view`; the document is a task."""
    num_envs: int = 64
    device: str = "cpu"
    """Device of a learner; a loop runs on the CPU."""
    threads: int = 0
    """CPU threads of a loop's physics; 0: one per CPU."""
    seconds: float = 2.0
    """Length of a block, which has at least one step or iteration."""
    blocks: int = 9
    port: int = 8440

    def run(self) -> None:
        """Print the ratio of a step's times, shown over bare: median and quartiles over pairs of blocks."""
        with self._learner() if self.learner else self._loop() as (page, bare, shown):
            browser = subprocess.Popen([sys.executable, __file__, "browser", page.url.rpartition(":")[2]])
            self._block(bare)
            time.sleep(1.0)
            self._block(shown)
            begin = page.num_frames
            pairs = [(self._block(bare), self._block(shown)) for _ in range(self.blocks)]
            browser.kill()
            num_frames = page.num_frames - begin
        ratios = np.array([[shown[i] / bare[i] for i in range(2)] for bare, shown in pairs])
        shown_seconds = sum(shown[2] for _, shown in pairs)
        print(f"{self.document}: {self.num_envs} environments, {self.device}, {len(os.sched_getaffinity(0))} CPUs, ", end="")
        print(f"torch threads {torch.get_num_threads()}, {num_frames / shown_seconds:.1f} frames/s while shown")
        for i, name in enumerate(("wall", "CPU of the loop")):
            low, mid, high = np.quantile(ratios[:, i], (0.25, 0.5, 0.75))
            step = 1e3 * np.median([bare[i] for bare, _ in pairs])
            print(f"{name}: {step:.2f} ms per step, shown / bare {mid:.3f} ({low:.3f} to {high:.3f})")

    @contextlib.contextmanager
    def _loop(self) -> Iterator[Opened]:
        touch = tgdsl.compile(self.document)
        sim = tgdsl.simulate(touch, num_envs=self.num_envs, substeps=5, threads=self.threads)
        page = tgdsl.show(touch, sim, port=self.port)

        def bare() -> None:
            sim.step()
            touch(sim.state())

        def shown() -> None:
            sim.step()
            page.update(touch(sim.state()))

        try:
            yield page, bare, shown
        finally:
            page.close()

    @contextlib.contextmanager
    def _learner(self) -> Iterator[Opened]:
        from tgdsl.commands.train import learner_page
        from tgdsl.rl.env import TouchEnv
        from tgdsl.rl.load import load_task
        from tgdsl.rl.train.learner import Learner

        loaded = load_task(self.document)
        env = TouchEnv(loaded, self.num_envs, device=self.device)
        learner = Learner(env, loaded, seed=0)
        with learner_page(learner) as page:
            send = learner.on_step

            def bare() -> None:
                learner.on_step = None
                learner.iterate()

            def shown() -> None:
                learner.on_step = send
                learner.iterate()

            yield page, bare, shown
        env.close()

    def _block(self, step: Callable[[], object]) -> tuple[float, float, float]:
        """Return wall and CPU time of a step, and the wall time of the block [s]."""
        begin, cpu, count = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - begin < self.seconds:
            step()
            count += 1
        seconds = time.perf_counter() - begin
        return seconds / count, (time.process_time() - cpu) / count, seconds


async def browse(port: int) -> None:
    """Read the messages of a page until it closes."""
    import msgspec
    import viser
    import websockets

    camera = {"type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "fov": 1.0, "near": 0.01, "far": 10.0}
    camera |= {"image_height": 480, "image_width": 640}
    camera |= {"position": (0, 0, 1), "look_at": (0, 0, 0), "up_direction": (0, 1, 0)}
    options = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None, "compression": None}
    async with websockets.connect(f"ws://localhost:{port}", **options) as socket:
        await socket.send(msgspec.msgpack.encode(camera))  # viser takes the client for a browser then
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                await socket.recv()


if __name__ == "__main__":
    if sys.argv[1:2] == ["browser"]:
        asyncio.run(browse(int(sys.argv[2])))
    else:
        tyro.cli(ViewCost).run()
