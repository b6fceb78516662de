"""Compare the time of an iteration of many students with that of one student, in one process on one device.

    python benchmarks/students.py profile --out out/students.json
    python benchmarks/students.py profile --device cpu --envs 24 --seeds 3 --type-seeds 1 --iterations 2

Three parts have the same number of environments and control steps, new students and new episodes:

    one      a student of `force_torque` in all environments
    seeds    27 students of `force_torque` with one architecture: a stack
    types    three students of each of the paper's eight types, with an encoder per type

The times of a rollout (physics, touch, teacher and students acting) and of an update are medians of `--iterations` iterations
after warm-up iterations, which load kernels and capture graphs. Ratios are to `one`.

Environments are created as `tgdsl distill` creates them: with the sensor of `force_torque` alone for `one` and `seeds`, and
with the sensors of all types for `types`. There `one` is measured a second time, as `one_beside`, which separates the cost of
the sensors from that of the students.
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
"""Largest ratios to `one` that meet the goal."""
Parts = dict[str, list[StudentKey]]


def profile(options: argparse.Namespace) -> dict[str, Any]:
    """Return the report of all parts.

    Raises:
        TgdslError: If environments do not divide among the students of a part; nothing has run.
    """
    loaded = load_task(options.task, parsed_overrides(tuple(options.set)))
    place, noise = [loaded.spec.placement], [loaded.spec.noise]
    one = student_keys([ALONE], place, noise, 1)
    simulations: list[Parts] = [
        {"one": one, "seeds": student_keys([ALONE], place, noise, options.seeds)},
        {"types": student_keys(options.types, place, noise, options.type_seeds), "one_beside": one},
    ]
    for parts in simulations:
        for keys in parts.values():
            check_blocks(options.envs, len(keys), num_variants(loaded))
    teacher = Teacher(options.teacher, loaded)
    report: dict[str, Any] = {}
    for parts in simulations:
        report |= measure_parts(options, loaded, teacher, parts)
    for part in report.values():
        part["ratio"] = round(part["iteration_ms"] / report["one"]["iteration_ms"], 4)
    return {
        "device": torch.cuda.get_device_name() if options.device.startswith("cuda") else options.device,
        "torch": torch.__version__,
        "task": loaded.spec.task,
        "envs": options.envs,
        "steps": loaded.spec.distill.steps,
        "iterations": options.iterations,
        "warm": options.warm,
        "parts": report,
    }


def measure_parts(options: argparse.Namespace, loaded: LoadedTask, teacher: Teacher, parts: Parts) -> dict[str, dict[str, Any]]:
    """Measure parts in environments with the sensors of all of them."""
    start, touch = time.perf_counter(), touches([key for keys in parts.values() for key in keys], teacher.touch)
    with StatusLine() as progress:
        env = TouchEnv(loaded, options.envs, device=options.device, touches=touch, progress=progress)
    print(f"environments for {', '.join(parts)}: {time.perf_counter() - start:.0f} s", flush=True)
    try:
        results = {}
        for name, keys in parts.items():
            results[name] = measure(env, loaded, teacher, keys, options.warm, options.iterations)
            numbers = (f"{key} {value:.1f}" for key, value in results[name].items() if isinstance(value, float))
            print(f"{name}: {', '.join(numbers)}", flush=True)
        return results
    finally:
        env.close()


def measure(
    env: TouchEnv, loaded: LoadedTask, teacher: Teacher, keys: Sequence[StudentKey], warm: int, iterations: int
) -> dict[str, Any]:
    """Teach students; return median, least and greatest times of an iteration [ms], and torch's peak memory [GiB]."""
    is_cuda = env.device.type == "cuda"
    if is_cuda:
        gc.collect()  # graphs of the last part
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(env.device)
    distiller = Distiller(env, loaded, teacher.bound(env), keys, 0)
    start = time.perf_counter()
    for _ in range(warm):
        distiller.iterate()
    ready = time.perf_counter() - start
    times = [distiller.iterate() for _ in range(iterations)]
    series = {"rollout": [t.rollout for t in times], "update": [t.update for t in times]}
    series["iteration"] = [t.rollout + t.update for t in times]
    part: dict[str, Any] = {"students": len(keys), "stacks": len(distiller.rollouts)}
    part |= {f"{name}_ms": round(1e3 * statistics.median(values), 3) for name, values in series.items()}
    part |= {f"{name}_spread_ms": [round(1e3 * end(values), 3) for end in (min, max)] for name, values in series.items()}
    part["warm_s"] = round(ready, 2)
    part["memory_gib"] = torch.cuda.max_memory_reserved(env.device) / 2**30 if is_cuda else None
    return part


def run(options: argparse.Namespace) -> None:
    """Measure, print the table and write the report."""
    if options.out is not None:
        check_writable(options.out)
    report = profile(options)
    print("part | students | stacks | rollout [ms] | update [ms] | iteration [ms] | of one | goal")
    for name, part in report["parts"].items():
        times = " | ".join(f"{part[key]:.1f}" for key in ("rollout_ms", "update_ms", "iteration_ms"))
        goal = f"{GOALS[name]:.2f}" if name in GOALS else "–"
        print(f"{name} | {part['students']} | {part['stacks']} | {times} | {part['ratio']:.3f} | {goal}")
    if options.out is not None:
        atomic_write(with_folder(options.out), (json.dumps(report, indent=1) + "\n").encode())
        print(options.out)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command = parser.add_subparsers(required=True).add_parser("profile")
    command.add_argument("task", type=Path, nargs="?", default=ROOT / "examples" / "tasks" / "in_palm_rotate_cube.yaml")
    command.add_argument("--teacher", type=Path, default=ROOT / "policies" / "in_palm_rotate_cube.pt")
    command.add_argument("--device", default="cuda")
    command.add_argument("--envs", type=int, default=13824)
    command.add_argument("--seeds", type=int, default=27, help="students of one architecture")
    command.add_argument("--types", nargs="+", default=list(TYPES))
    command.add_argument("--type-seeds", type=int, default=3, help="students of each type")
    command.add_argument("--warm", type=int, default=4, help="iterations before timing; graphs are captured in three")
    command.add_argument("--iterations", type=int, default=6)
    command.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    command.add_argument("--out", type=Path)
    try:
        run(parser.parse_args(arguments))
    except TgdslError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
