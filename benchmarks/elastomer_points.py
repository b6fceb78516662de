"""Time an elastomer with `anchors: points` on a CPU: with a sum over all points, and over those that pull alone.

    python benchmarks/elastomer_points.py [--num-envs 1024] [--threads 1] [--repeats 20]

500 points of a 4 cm cube over 100 taxels, shear alone: the cube at rest on the pad, off it, and with all points in contact.
Times are medians of alternating compiled calls, in CPU time, which other processes disturb less. The difference is the largest
of two readings relative to the largest reading.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import tyro
from module import PAD

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.sensors.elastomer import point_anchors


@dataclass(frozen=True)
class Options:
    """Command-line options."""

    num_envs: int = 1024
    threads: int = 1
    repeats: int = 20
    """Timed calls of each sum."""

    def run(self) -> None:
        """Measure and print one row per scene."""
        torch.set_num_threads(self.threads)
        machine = f"{torch.backends.cpu.get_cpu_capability()}, {self.threads} threads"
        print(f"torch {torch.__version__}, {machine}, {self.num_envs} environments, float32\n")
        print(
            "| cube | points that pull | all summed, ms | those that pull, ms | ratio | difference |\n|---|---|---|---|---|---|"
        )
        for name, (height, standoff) in SCENES.items():
            self._scene(name, height, standoff)

    def _scene(self, name: str, height: float, standoff: float) -> None:
        readings, modules, times = {}, {}, {True: [], False: []}
        for is_compacted in times:
            touch = pad_of_points(standoff).compile()
            with summing(is_compacted), torch.no_grad():
                for shift in (0.0, 1e-4):
                    state = on_pad(touch, self.num_envs, height, shift)
                    readings[is_compacted] = touch(state)["skin"].clone()
            modules[is_compacted] = touch, state
        for _ in range(self.repeats):
            for is_compacted, (touch, state) in modules.items():
                with summing(is_compacted), torch.no_grad():
                    start = time.process_time()
                    touch(state)
                    times[is_compacted].append(1e3 * (time.process_time() - start))
        compacted, whole = (float(np.median(times[is_compacted])) for is_compacted in (True, False))
        difference = float((readings[True] - readings[False]).abs().max() / readings[False].abs().max().clamp(min=1e-30))
        held = float(modules[True][0].memory.get_buffer("skin:held").sum(dim=1).mean())
        times_text = f"{whole:.1f} | {compacted:.1f} | {compacted / whole:.2f}"
        print(f"| {name} | {held:.0f} of 500 | {times_text} | {difference:.0e} |", flush=True)


SCENES = {"at rest": (0.0245, 0.0), "off the pad": (0.05, 0.0), "all in contact": (0.0245, 0.2)}
"""Height of the cube's centre above the pad's [m], and the skin's standoff [m]."""


@contextmanager
def summing(is_compacted: bool) -> Iterator[None]:
    """Make modules that are compiled and called meanwhile sum over the points that pull, or over all."""
    original = point_anchors.are_compacted
    point_anchors.are_compacted = original if is_compacted else lambda *_: False
    try:
        yield
    finally:
        point_anchors.are_compacted = original


def pad_of_points(standoff: float) -> TactileModule:
    """Return a sensor with 500 anchors on a cube, shear alone, on a 10 × 10 pad."""
    grid = {"method": "grid", "rows": 10, "columns": 10, "direction": [0, 0, -1], "radius": 0.004}
    skin = {"kind": "elastomer", "links": "pad", "feels": ["cube"], "anchors": "points", "points": 500, "gate": "geometric"}
    with TemporaryDirectory() as folder:
        model = Path(folder) / "pad.xml"
        model.write_text(PAD)
        document = {
            "tgdsl": 1,
            "robot": {"model": str(model), "layout": {"resolutions": {"r": {"pad": grid}}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {"skin": {**skin, "standoff": standoff, "dilation_strength": 0}},
        }
        return tgdsl.compile(document)


def on_pad(touch: TactileModule, num_envs: int, height: float, shift: float) -> SceneState:
    """Return states with the cube level, near the pad's centre, and displaced by a random shift [m]."""
    random = torch.Generator().manual_seed(0)
    state = touch.example_state(num_envs, dtype=torch.float32)
    assert state.body_pos is not None and state.body_quat is not None
    cube = touch.inputs.bodies.index("cube")
    state.body_pos[:] = 0
    state.body_quat[:] = torch.tensor([1.0, 0, 0, 0])
    place = torch.randn((2, num_envs, 2), generator=random)
    state.body_pos[:, cube, :2] = 1e-3 * place[0] + shift * place[1]
    state.body_pos[:, cube, 2] = height
    return state


if __name__ == "__main__":
    tyro.cli(Options, description=__doc__).run()
