"""What `tgdsl.show` costs a loop: the same steps with and without the page, in blocks that alternate, with a browser connected.

The browser is a websocket that reads what the page sends and draws nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

import tgdsl


@dataclass
class ViewCost:
    """Time a document's loop, bare and shown."""

    document: tyro.conf.Positional[Path] = Path("examples/xhand1_palm.yaml")
    num_envs: int = 64
    threads: int = 0
    """CPU threads of physics; 0: one per CPU."""
    seconds: float = 2.0
    """Length of a block."""
    blocks: int = 9
    port: int = 8440

    def run(self) -> None:
        """Print the ratio of the times of a step, shown over bare: median and quartiles over pairs of blocks."""
        touch = tgdsl.compile(self.document)
        sim = tgdsl.simulate(touch, num_envs=self.num_envs, substeps=5, threads=self.threads)
        page = tgdsl.show(touch, sim, port=self.port)

        def bare() -> None:
            sim.step()
            touch(sim.state())

        def shown() -> None:
            sim.step()
            page.update(touch(sim.state()))

        browser = subprocess.Popen([sys.executable, __file__, "browser", page.url.rpartition(":")[2]])
        self._block(bare)
        time.sleep(1.0)
        self._block(shown)
        frames_before = page.num_frames
        pairs = np.array([[self._block(bare), self._block(shown)] for _ in range(self.blocks)])
        rate = (page.num_frames - frames_before) / (self.blocks * self.seconds)
        browser.kill()
        page.close()
        cpus, torch_threads = len(os.sched_getaffinity(0)), torch.get_num_threads()
        print(f"{self.document}: {self.num_envs} environments, {cpus} CPUs, physics threads {self.threads or cpus}, ", end="")
        print(f"torch threads {torch_threads}, {rate:.1f} frames/s")
        for i, name in enumerate(("wall", "CPU of the loop")):
            low, mid, high = np.quantile(pairs[:, 1, i] / pairs[:, 0, i], (0.25, 0.5, 0.75))
            step = 1e3 * np.median(pairs[:, 0, i])
            print(f"{name}: {step:.2f} ms per step, shown / bare {mid:.3f} ({low:.3f} to {high:.3f})")

    def _block(self, step: Callable[[], None]) -> tuple[float, float]:
        """Return wall and CPU time of a step [s]."""
        begin, cpu, count = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - begin < self.seconds:
            step()
            count += 1
        return (time.perf_counter() - begin) / count, (time.process_time() - cpu) / count


async def browse(port: int) -> None:
    """Read what a page sends until it ends."""
    import msgspec
    import viser
    import websockets

    camera = {"type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "fov": 1.0, "near": 0.01, "far": 10.0}
    camera |= {"image_height": 480, "image_width": 640}
    camera |= {"position": (0, 0, 1), "look_at": (0, 0, 0), "up_direction": (0, 1, 0)}
    options = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None, "compression": None}
    async with websockets.connect(f"ws://localhost:{port}", **options) as socket:
        await socket.send(msgspec.msgpack.encode(camera))  # by which viser knows a browser
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                await socket.recv()


if __name__ == "__main__":
    if sys.argv[1:2] == ["browser"]:
        asyncio.run(browse(int(sys.argv[2])))
    else:
        tyro.cli(ViewCost).run()
