"""What many students cost beside one: time of an iteration, in one process on one device.

    python benchmarks/students.py profile --out out/students.json
    python benchmarks/students.py profile --device cpu --envs 24 --seeds 3 --type-seeds 1 --iterations 2

Three parts, each with the same number of environments and control steps:

    one      a student of `force_torque` in all environments
    seeds    27 students of `force_torque`, one architecture: a stack
    types    the paper's eight types with encoders of their own, three students each

and of each rollout (physics, touch, teacher and students acting) and update, medians of `--iterations` iterations after warm
ones in which kernels are loaded and graphs captured; as ratios to `one`. Each part has new students, and begins episodes again.

Environments are made as `tgdsl distill` makes them, twice: with the sensor of `force_torque` alone for `one` and `seeds`, with
the sensors of all types for `types`. In environments made once, with all sensors, a single student would pay for seven types
that it does not feel, and both ratios would look better than they are. There `one` is measured a second time, as `one_beside`:
how much of `types` is due to the sensors, and how much to the students. With `--once` environments are made once all the same:
less start-up, and ratios of what students cost alone.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from tgdsl.commands.arguments import parsed_overrides
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write, check_writable, with_folder
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask, load_task
from tgdsl.rl.sensors import num_variants
from tgdsl.rl.students.keys import StudentKey, Teacher, check_blocks, student_keys, touches
from tgdsl.rl.students.learner import Distiller

ROOT = Path(__file__).parents[1]
ALONE = "force_torque"
TYPES = ("bool", "agg_bool", "depth", "agg_force", "force", "force_torque", "elastomer", "proximity")
"""The paper's eight types."""
GOALS = {"seeds": 1.20, "types": 1.40}
"""Ratios to `one` that are wanted, at most."""
Parts = dict[str, list[StudentKey]]


def profile(given: argparse.Namespace) -> dict[str, Any]:
    """Measure all parts, and return what was found.

    Raises:
        TgdslError: If environments do not divide among the students of a part; nothing has run.
    """
    loaded = load_task(given.task, parsed_overrides(tuple(given.set)))
    place, noise = [loaded.spec.placement], [loaded.spec.noise]
    one = student_keys([ALONE], place, noise, 1)
    simulations: list[Parts] = [
        {"one": one, "seeds": student_keys([ALONE], place, noise, given.seeds)},
        {"types": student_keys(given.types, place, noise, given.type_seeds), "one_beside": one},
    ]
    if given.once:
        simulations = [simulations[0] | {"types": simulations[1]["types"]}]
    for parts in simulations:
        for keys in parts.values():
            check_blocks(given.envs, len(keys), num_variants(loaded))
    teacher = Teacher(given.teacher, loaded)
    found: dict[str, Any] = {}
    for parts in simulations:
        found |= simulated(given, loaded, teacher, parts)
    whole = found["one"]["iteration_ms"]
    for part in found.values():
        part["ratio"] = round(part["iteration_ms"] / whole, 4)
    name = torch.cuda.get_device_name() if given.device.startswith("cuda") else given.device
    shown = {"device": name, "torch": torch.__version__, "task": loaded.spec.task, "envs": given.envs}
    return shown | {
        "steps": loaded.spec.distill.steps,
        "iterations": given.iterations,
        "warm": given.warm,
        "once": given.once,
        "parts": found,
    }


def simulated(given: argparse.Namespace, loaded: LoadedTask, teacher: Teacher, parts: Parts) -> dict[str, dict[str, Any]]:
    """Measure the parts of one simulation, which feels what any of them does."""
    start, touch = time.perf_counter(), touches([key for keys in parts.values() for key in keys], teacher.touch)
    with StatusLine() as progress:
        env = TouchEnv(loaded, given.envs, device=given.device, touches=touch, progress=progress)
    print(f"environments for {', '.join(parts)}: {time.perf_counter() - start:.0f} s", flush=True)
    try:
        found = {}
        for name, keys in parts.items():
            found[name] = measured(env, loaded, teacher, keys, given.warm, given.iterations)
            told = (f"{key} {value:.1f}" for key, value in found[name].items() if isinstance(value, float))
            print(f"{name}: {', '.join(told)}", flush=True)
        return found
    finally:
        env.close()


def measured(
    env: TouchEnv, loaded: LoadedTask, teacher: Teacher, keys: Sequence[StudentKey], warm: int, iterations: int
) -> dict[str, Any]:
    """Teach some students; return medians and extremes of what an iteration takes [ms], and most memory of torch [GiB]."""
    is_cuda = env.device.type == "cuda"
    if is_cuda:
        gc.collect()  # graphs of the part before
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(env.device)
    distiller = Distiller(env, loaded, teacher.bound(env), keys, 0)
    start = time.perf_counter()
    for _ in range(warm):
        distiller.iterate()
    ready = time.perf_counter() - start
    made = [distiller.iterate() for _ in range(iterations)]
    parts = {"rollout": [own.rollout for own in made], "update": [own.update for own in made]}
    parts["iteration"] = [own.rollout + own.update for own in made]
    found: dict[str, Any] = {"students": len(keys), "stacks": len(distiller.rollouts)}
    found |= {f"{name}_ms": round(1e3 * statistics.median(values), 3) for name, values in parts.items()}
    found |= {f"{name}_spread_ms": [round(1e3 * end(values), 3) for end in (min, max)] for name, values in parts.items()}
    found["warm_s"] = round(ready, 2)
    found["memory_gib"] = torch.cuda.max_memory_reserved(env.device) / 2**30 if is_cuda else None
    return found


def profiled(given: argparse.Namespace) -> None:
    """Measure, print a table, and write it."""
    if given.out is not None:
        check_writable(given.out)
    found = profile(given)
    print("part | students | stacks | rollout [ms] | update [ms] | iteration [ms] | of one | goal")
    for name, own in found["parts"].items():
        times = " | ".join(f"{own[key]:.1f}" for key in ("rollout_ms", "update_ms", "iteration_ms"))
        goal = f"{GOALS[name]:.2f}" if name in GOALS else "–"
        print(f"{name} | {own['students']} | {own['stacks']} | {times} | {own['ratio']:.3f} | {goal}")
    if given.out is not None:
        atomic_write(with_folder(given.out), (json.dumps(found, indent=1) + "\n").encode())
        print(given.out)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    own = kinds.add_parser("profile")
    own.add_argument("task", type=Path, nargs="?", default=ROOT / "examples" / "tasks" / "in_palm_rotate_cube.yaml")
    own.add_argument("--teacher", type=Path, default=ROOT / "policies" / "in_palm_rotate_cube.pt")
    own.add_argument("--device", default="cuda")
    own.add_argument("--envs", type=int, default=13824)
    own.add_argument("--seeds", type=int, default=27, help="students of one architecture")
    own.add_argument("--types", nargs="+", default=list(TYPES))
    own.add_argument("--type-seeds", type=int, default=3, help="students of each type")
    own.add_argument("--warm", type=int, default=4, help="iterations before those that are timed; graphs are captured in three")
    own.add_argument("--iterations", type=int, default=6)
    own.add_argument("--once", action="store_true", help="environments made once, with the sensors of all types")
    own.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    own.add_argument("--out", type=Path)
    own.set_defaults(run=profiled)
    given = parser.parse_args(arguments)
    try:
        given.run(given)
    except TgdslError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
