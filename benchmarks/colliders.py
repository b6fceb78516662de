"""Measure primitive colliders, capped iterations and tolerances: the speed of physics, and its error against exact settings.

    python benchmarks/colliders.py speed --device cuda --envs 8192
    python benchmarks/colliders.py error                    # on a CPU, one thread
    python benchmarks/colliders.py load --states 256        # load on held objects, on a CPU
    python benchmarks/colliders.py pairs                    # pairs of links in contact, on a CPU

`speed` runs MuJoCo Warp with the drives, random actions and randomisation of the task. Per variant it measures the time of a
control step's physics (a CUDA graph from the same states; blocks alternate between variants; medians), and the Newton
iterations of the last substep (mean, and of the slowest environment, for which all wait). Per environment it counts contacts,
pairs after the broad phase, and rows of constraints. colliders_error.py explains `error` and `pairs`, colliders_load.py `load`.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import colliders_error
import colliders_load
import torch
from colliders_error import COLLISIONS, CONES, Variant

from tgdsl.console.tables import text_table
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.runtime.warp.simulation import WarpSimulation

TASK = Path(__file__).parents[1] / "examples" / "tasks" / "in_palm_rotate.yaml"
SPEED_OPTIONS: tuple[dict[str, float], ...] = (
    {},
    {"iterations": 20},
    {"iterations": 10},
    {"iterations": 5},
    {"iterations": 3},
    {"tolerance": 1e-5},
    {"tolerance": 1e-4},
    {"iterations": 10, "ls_iterations": 10},
    {"iterations": 10, "tolerance": 1e-5},
    {"iterations": 5, "tolerance": 1e-4},
)
"""Options of MuJoCo that replace the scene's; the first variant is the scene."""
ERROR_OPTIONS = (*SPEED_OPTIONS, {"tolerance": 1e-6}, {"tolerance": 1e-3}, {"ls_iterations": 10})


# ---- speed


class TimedScene:
    """Environments in MuJoCo Warp with one kind of colliders and one cone, whose solver's options change."""

    FIELDS = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")

    def __init__(self, options: argparse.Namespace, collision: str, cone: str):
        """Create environments at evenly spread steps of their episodes, and step them."""
        overrides = dict(entry.split("=", 1) for entry in options.set)
        overrides |= {"physics.collision": collision, "physics.cone": cone}
        task = load_task(options.task, overrides)
        self.env = TouchEnv(task, options.envs, device=options.device, simulator="warp", compiled=False, seed=0)
        assert isinstance(self.env.sim, WarpSimulation)
        self.sim = self.env.sim
        self.env.steps.copy_(torch.arange(options.envs) * self.env.max_steps // options.envs)
        generator = torch.Generator(self.env.device).manual_seed(0)
        shape = (16, options.envs, self.env.num_actions)
        self._actions = 2.0 * torch.rand(shape, generator=generator, device=self.env.device) - 1.0
        for i in range(options.warm):
            self.env.step(self._actions[i % 16])
        self._state = {name: self.sim.arrays[name].clone() for name in self.FIELDS}
        self._defaults = self._solver()

    def _solver(self) -> dict[str, float]:
        opt = self.sim.warp_model.opt
        return {name: float(_number(getattr(opt, name))) for name in ("iterations", "ls_iterations", "tolerance")}

    def set(self, options: dict[str, float]) -> None:
        """Set options of the solver; the others are the scene's."""
        opt = self.sim.warp_model.opt
        for name, value in (self._defaults | options).items():
            if name == "tolerance":
                opt.tolerance.fill_(max(value, 1e-6))  # like put_model: the limit of float32
            else:
                setattr(opt, name, int(value))

    def call(self) -> Callable[[], object]:
        """Return a control step's physics with the present options, which its first calls capture."""
        env = self.env
        return env.sim.repeated(lambda: env.sim.step(env._commanded(env._action, env.sim.ctrl)))

    def block(self, call: Callable[[], object], steps: int) -> float:
        """Return the time of a step [ms], from the saved states."""
        for name, value in self._state.items():
            self.sim.arrays[name].copy_(value)
        is_cuda = self.env.device.type == "cuda"
        events = [torch.cuda.Event(enable_timing=True) for _ in range(2)] if is_cuda else []
        start = time.process_time()
        for event in events[:1]:
            torch.cuda.synchronize()
            event.record()
        for i in range(steps):
            self.env._action.copy_(self._actions[i % 16])
            call()
        for event in events[1:]:
            event.record()
            torch.cuda.synchronize()
        elapsed = events[0].elapsed_time(events[1]) if is_cuda else 1e3 * (time.process_time() - start)
        return elapsed / steps

    def counts(self) -> dict[str, float]:
        """Return counts of the last substep, per environment."""
        data, num = self.sim.warp_data, self.env.num_envs
        rounds, rows = data.solver_niter.numpy(), data.nefc.numpy()
        result = {"rounds": float(rounds.mean()), "rounds_max": float(rounds.max()), "rows": float(rows.mean())}
        result |= {"rows_max": float(rows.max()), "contacts": float(data.nacon.numpy()[0]) / num}
        return result | {"pairs": float(data.ncollision.numpy()[0]) / num}


def _number(value: Any) -> float:
    return float(value.numpy().ravel()[0]) if hasattr(value, "numpy") else float(value)


def speed(options: argparse.Namespace) -> None:
    """Print a row per variant, and the table."""
    rows = []
    for cone in options.cones:
        scenes = {collision: TimedScene(options, collision, cone) for collision in options.collisions}
        variants = [Variant(collision, cone, solver) for solver in options.variants for collision in scenes]
        calls = []
        for variant in variants:
            scene = scenes[variant.collision]
            scene.set(variant.options)
            calls.append(scene.call())
            for _ in range(3):
                scene.block(calls[-1], 1)
        all_times: list[list[float]] = [[] for _ in variants]
        all_counts: list[list[dict[str, float]]] = [[] for _ in variants]
        for _ in range(options.blocks):
            for i, (variant, call) in enumerate(zip(variants, calls, strict=True)):
                scene = scenes[variant.collision]
                scene.set(variant.options)
                all_times[i].append(scene.block(call, options.steps))
                all_counts[i].append(scene.counts())
        for variant, times, counts in zip(variants, all_times, all_counts, strict=True):
            numbers = {name: statistics.fmean(count[name] for count in counts) for name in counts[0]}
            rows.append(asdict(variant) | {"ms": statistics.median(times)} | numbers)
            print(variant.name, " ".join(f"{name} {rows[-1][name]:.3f}" for name in ("ms", *numbers)), flush=True)
        pairs = {name: int(scene.sim.warp_model.nxn_geom_pair_filtered.shape[0]) for name, scene in scenes.items()}
        print(f"pairs of geoms that may meet: {pairs}", flush=True)
        for scene in scenes.values():
            scene.env.close()
    print(table(rows))


# ---- the command line


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table of `speed`: times, relative to the first row of the same cone, and counts."""
    cells = []
    for row in rows:
        first = next(other for other in rows if other["cone"] == row["cone"])
        solver = " ".join(f"{name}={value:g}" for name, value in row["options"].items()) or "-"
        times = f"{row['ms']:.2f}", f"{first['ms'] / row['ms']:.2f}x", f"{row['rounds']:.2f}", f"{row['rounds_max']:.1f}"
        cells.append((row["collision"], row["cone"], solver, *times, f"{row['contacts']:.2f}"))
    return text_table(("colliders", "cone", "options", "ms", "faster", "rounds", "slowest", "contacts"), cells)


PARTS = {"speed": speed, "error": colliders_error.error, "load": colliders_load.load, "pairs": colliders_error.pairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--task", type=Path, default=TASK)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--envs", type=int, default=8192)
    parser.add_argument("--collisions", nargs="+", default=list(COLLISIONS), choices=COLLISIONS)
    parser.add_argument("--cones", nargs="+", default=list(CONES), choices=CONES)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="change the task's document (`speed`)")
    parser.add_argument("--warm", type=int, default=60, help="control steps before timing")
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--steps", type=int, default=5, help="control steps of a block")
    parser.add_argument("--states", type=int, default=64, help="number of states of `error`, `load` and `pairs`")
    parser.add_argument("--ahead", type=int, default=160, help="control steps from each state")
    parser.add_argument("--quick", action="store_true", help="only the first solver options")
    options = parser.parse_args()
    options.variants = SPEED_OPTIONS[:3] if options.quick else SPEED_OPTIONS
    options.error_variants = ERROR_OPTIONS[:3] if options.quick else ERROR_OPTIONS
    PARTS[options.part](options)


if __name__ == "__main__":
    main()
