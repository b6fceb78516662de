"""Compare the proximity taxel by a baked field and by sampled points: error against the surface integral, and time.

    python benchmarks/proximity.py [--device cuda] [--num-envs 1024] [--num-taxels 100] [--repeats 10] [--eager]

A 4 cm cube is at random poses within reach of probes of 10 mm radius on a pad of its size. Times are medians of alternating
calls. Errors of the normal force, relative to its largest magnitude, are against the surface integral as a sum over points
every 0.1 mm, in the first environments.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import tyro
from module import median_ms
from scipy.spatial.transform import Rotation
from torch import Tensor

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.quantities.moment_fields import moment_sums
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.quadrature import outer_surface

SCENE = """
<mujoco><worldbody>
  <body name="pad"><freejoint/><geom type="box" size=".02 .02 .002"/></body>
  <body name="cube"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""
TRUE_ENVS = 24
"""Environments whose readings are compared."""
ROOM = 2**29
"""Memory limit of fields and lists [bytes]."""
BACKENDS: dict[str, dict[str, Any]] = {
    "field, 0.5 %": {"tolerance": 0.005},
    "field, 2 %": {"tolerance": 0.02},
    "5,000 points": {"backend": "points", "points": 5_000},
    "100,000 points": {"backend": "points", "points": 100_000},
}


@dataclass(frozen=True)
class Options:
    """Command-line options."""

    device: str = "cpu"
    num_envs: int = 1024
    num_taxels: int = 100
    """Taxels, a square number."""
    repeats: int = 10
    """Timed calls of each module."""
    eager: bool = False
    """Whether to leave the modules uncompiled."""


def module(folder: Path, options: Options, **sensor: Any) -> TactileModule:
    """Return a module with one proximity sensor."""
    path = folder / "scene.xml"
    path.write_text(SCENE)
    points = [{"pos": pos, "normal": [0, 0, 1], "radius": 0.01} for pos in probes(options.num_taxels)]
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(path), "layout": layout},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"s": {"kind": "proximity", "links": "pad", "feels": ["cube"], "max_bytes": ROOM, **sensor}},
    }
    return tgdsl.compile(document, device=options.device)


def nearby_state(touch: TactileModule, num_envs: int) -> SceneState:
    """Return random states in which the cube is in front of the pad, 0 to 8 mm away."""
    state = touch.example_state(num_envs, dtype=torch.float32, spread=0.004)
    assert state.body_pos is not None and state.body_quat is not None
    pad, cube = (touch.inputs.bodies.index(name) for name in ("pad", "cube"))
    state.body_pos[:, pad] = 0
    state.body_quat[:] = 0.05 * state.body_quat
    state.body_quat[..., 0] += 1
    state.body_pos[:, cube, 2] += 0.027
    return state


def probes(num_taxels: int) -> list[list[float]]:
    """Return the positions of the probes on the pad [m]."""
    side = round(num_taxels**0.5)
    line = [0.04 * ((i + 0.5) / side - 0.5) for i in range(side)]
    return [[x, y, 0.002] for x in line for y in line]


def converged(state: SceneState, num_taxels: int) -> Tensor:
    """Return the normal force of the first environments' probes, −k ρ S0 [N], from a sum over points every 0.1 mm."""
    assert state.body_pos is not None and state.body_quat is not None
    geom = Geom(0, "", "", "cube", "box", np.full(3, 0.02), np.zeros(3), np.eye(3), True)
    surface = outer_surface([SurfaceGeom(geom, None)], 1e-4).quadrature(1e-4)
    positions, quats = (value[:TRUE_ENVS].double().cpu().numpy() for value in (state.body_pos, state.body_quat))
    cube, pad = 0, 1  # the bodies are sorted by name
    forces = []
    for pos, quat in zip(positions, quats, strict=True):
        to_world, to_cube = (Rotation.from_quat(quat[body], scalar_first=True) for body in (pad, cube))
        world = pos[pad] + to_world.apply(probes(num_taxels))
        moments = moment_sums(surface, to_cube.inv().apply(world - pos[cube]), 0.01, 4, block=1)
        forces.append(-300 * 100 / (6 * 0.04**2) * moments[:, 0])
    return torch.from_numpy(np.stack(forces))


def main(options: Options) -> None:
    """Print the table."""
    machine = torch.cuda.get_device_name() if options.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {machine}, {options.num_envs} × {options.num_taxels}, medians of {options.repeats}\n")
    rows, calls, forces = {}, {}, {}
    with TemporaryDirectory() as folder, torch.no_grad():
        state = nearby_state(module(Path(folder), options, tolerance=0.02), options.num_envs)
        true = converged(state, options.num_taxels)
        for name, sensor in BACKENDS.items():
            start = time.perf_counter()
            touch = module(Path(folder), options, **sensor)
            rows[name] = time.perf_counter() - start, sum(b.numel() * b.element_size() for b in touch.constants.buffers())
            forces[name] = touch(state)["s"][: len(true), :, 2].double().cpu()
            if not options.eager:
                touch.compile()
            calls[name] = lambda touch=touch: touch(state)
        times = median_ms(calls, options.repeats, options.device)
    first = times[next(iter(times))]
    print("| backend | error, RMS | largest | ms | ratio | constants, MiB | compiled in, s |\n|---|---|---|---|---|---|---|")
    for name, (seconds, size) in rows.items():
        error = (forces[name] - true).abs() / true.abs().max()
        rms = f"{100 * error.square().mean().sqrt():.2f} % | {100 * error.max():.2f} %"
        print(f"| {name} | {rms} | {times[name]:.3f} | {times[name] / first:.1f} | {size / 2**20:.1f} | {seconds:.1f} |")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
