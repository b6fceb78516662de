"""What physics gains by primitive colliders, caps on iterations and tolerances, and what they cost against MuJoCo's own result.

    python benchmarks/colliders.py speed --device cuda --envs 8192 --out out/colliders --limit 240
    python benchmarks/colliders.py error --out out/colliders                     # on a CPU, one thread
    python benchmarks/colliders.py load --states 256 --out out/colliders         # how colliders load what links hold, on a CPU
    python benchmarks/colliders.py pairs                                        # which pairs of links come near, on a CPU

`speed`, in MuJoCo Warp, with the drives, random actions and randomisation of the task: milliseconds of a control step's physics
(a CUDA graph; from the same states, blocks alternate between variants, medians), Newton's rounds in the last substep (mean, and
of the slowest environment, which all wait for), contacts, pairs that pass the broad phase, and rows of constraints, of each
environment. `error` and `pairs` are explained in colliders_error.py, `load` in
colliders_load.py.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import colliders_error
import colliders_load
import torch
from colliders_error import COLLISIONS, CONES, Variant

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
"""Options of MuJoCo in place of the scene's; the first are the scene's own."""
ERROR_OPTIONS = (*SPEED_OPTIONS, {"tolerance": 1e-6}, {"tolerance": 1e-3}, {"ls_iterations": 10})
PARTS = ("speed", "error", "load", "pairs")


# ---- speed


class Timed:
    """Environments with one kind of colliders and one cone in MuJoCo Warp, whose solver is given several options in turn."""

    KEPT = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")

    def __init__(self, options: argparse.Namespace, collision: str, cone: str):
        """Make them and step them until they are in the midst of their episodes."""
        given = dict(entry.split("=", 1) for entry in options.set)
        given |= {"physics.collision": collision, "physics.cone": cone}
        task = load_task(options.task, given)
        self.env = TouchEnv(task, options.envs, device=options.device, simulator="warp", compiled=False, seed=0)
        assert isinstance(self.env.sim, WarpSimulation)
        self.sim = self.env.sim
        self.env.steps.copy_(torch.arange(options.envs) * self.env.max_steps // options.envs)
        generator = torch.Generator(self.env.device).manual_seed(0)
        shape = (16, options.envs, self.env.num_actions)
        self._actions = 2.0 * torch.rand(shape, generator=generator, device=self.env.device) - 1.0
        for i in range(options.warm):
            self.env.step(self._actions[i % 16])
        self._kept = {name: self.sim.arrays[name].clone() for name in self.KEPT}
        self._own = self._solver()

    def _solver(self) -> dict[str, float]:
        opt = self.sim.warp_model.opt
        return {name: float(_number(getattr(opt, name))) for name in ("iterations", "ls_iterations", "tolerance")}

    def set(self, options: dict[str, float]) -> None:
        """Give the solver options; those that are left out are as they were."""
        opt = self.sim.warp_model.opt
        for name, value in (self._own | options).items():
            if name == "tolerance":
                opt.tolerance.fill_(max(value, 1e-6))  # as put_model has it: float32 resolves no more
            else:
                setattr(opt, name, int(value))

    def call(self) -> Callable[[], object]:
        """Return a control step's physics, captured as it is now; the first calls capture it."""
        env = self.env
        return env.sim.repeated(lambda: env.sim.step(env._commanded(env._action, env.sim.ctrl)))

    def block(self, call: Callable[[], object], steps: int) -> float:
        """Return milliseconds of a step, from the states that were kept."""
        for name, value in self._kept.items():
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
        taken = events[0].elapsed_time(events[1]) if is_cuda else 1e3 * (time.process_time() - start)
        return taken / steps

    def counts(self) -> dict[str, float]:
        """Return what the last step's last substep did, per environment."""
        data, num = self.sim.warp_data, self.env.num_envs
        rounds, rows = data.solver_niter.numpy(), data.nefc.numpy()
        found = {"rounds": float(rounds.mean()), "rounds_max": float(rounds.max()), "rows": float(rows.mean())}
        found |= {"rows_max": float(rows.max()), "contacts": float(data.nacon.numpy()[0]) / num}
        return found | {"pairs": float(data.ncollision.numpy()[0]) / num}


def _number(value: Any) -> float:
    return float(value.numpy().ravel()[0]) if hasattr(value, "numpy") else float(value)


def speed(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row per variant; those that the limit leaves no time for are left out."""
    start, rows = time.perf_counter(), []
    for cone in options.cones:
        if time.perf_counter() - start > options.limit:
            break
        each = {collision: Timed(options, collision, cone) for collision in options.collisions}
        variants = [Variant(collision, cone, chosen) for chosen in options.variants for collision in each]
        calls = []
        for variant in variants:
            own = each[variant.collision]
            own.set(variant.options)
            calls.append(own.call())
            for _ in range(3):
                own.block(calls[-1], 1)
        taken: list[list[float]] = [[] for _ in variants]
        counted: list[list[dict[str, float]]] = [[] for _ in variants]
        for _ in range(options.blocks):
            for i, (variant, call) in enumerate(zip(variants, calls, strict=True)):
                own = each[variant.collision]
                own.set(variant.options)
                taken[i].append(own.block(call, options.steps))
                counted[i].append(own.counts())
        for variant, times, counts in zip(variants, taken, counted, strict=True):
            numbers = {name: statistics.fmean(own[name] for own in counts) for name in counts[0]}
            rows.append(asdict(variant) | {"ms": statistics.median(times), "blocks": times} | numbers)
            print(variant.name, " ".join(f"{name} {rows[-1][name]:.3f}" for name in ("ms", *numbers)), flush=True)
        pairs = {name: int(own.sim.warp_model.nxn_geom_pair_filtered.shape[0]) for name, own in each.items()}
        print(f"pairs of geoms that may meet: {pairs}; {time.perf_counter() - start:.0f} s", flush=True)
        rows[-1]["candidates"] = pairs
        colliders_error.write(options, "speed", rows)
        for own in each.values():
            own.env.close()
    return rows


# ---- the command line


def table(rows: list[dict[str, Any]]) -> str:
    """Return the small table of `speed`: what a step's physics takes, against the first row of its cone."""
    lines = [
        f"{'colliders':<9} {'cone':<9} {'options':<32} {'ms':>7} {'faster':>7} {'rounds':>7} {'slowest':>7} {'contacts':>8}"
    ]
    for row in rows:
        first = next(other for other in rows if other["cone"] == row["cone"])
        name = Variant(row["collision"], row["cone"], row["options"]).name
        numbers = f"{row['ms']:7.2f} {first['ms'] / row['ms']:6.2f}x {row['rounds']:7.2f} {row['rounds_max']:7.1f}"
        lines.append(f"{name} {numbers} {row['contacts']:8.2f}")
    return "\n".join(lines)


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the command line's arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--task", type=Path, default=TASK)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--envs", type=int, default=8192)
    parser.add_argument("--collisions", nargs="+", default=list(COLLISIONS), choices=COLLISIONS)
    parser.add_argument("--cones", nargs="+", default=list(CONES), choices=CONES)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="of the task's document, in `speed`")
    parser.add_argument("--warm", type=int, default=60, help="control steps before anything is timed")
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--steps", type=int, default=5, help="control steps of a block")
    parser.add_argument("--limit", type=float, default=240.0, help="after so many seconds no other cone is begun [s]")
    parser.add_argument("--states", type=int, default=64, help="of `error`, `load` and `pairs`")
    parser.add_argument("--ahead", type=int, default=160, help="control steps that each of them is followed for")
    parser.add_argument("--quick", action="store_true", help="only a few options")
    parser.add_argument("--out", type=Path, help="writes OUT_PART.json")
    options = parser.parse_args(given)
    options.variants = SPEED_OPTIONS[:3] if options.quick else SPEED_OPTIONS
    options.error_variants = ERROR_OPTIONS[:3] if options.quick else ERROR_OPTIONS
    return options


def main() -> None:
    options = arguments()
    parts = {"speed": speed, "error": colliders_error.error, "load": colliders_load.load, "pairs": colliders_error.pairs}
    rows = parts[options.part](options)
    if options.part == "speed":
        print(table(rows))


if __name__ == "__main__":
    main()
