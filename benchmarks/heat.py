"""Temperatures: a call on a GPU, whether it reads what float64 does and keeps heat; conduction on a CPU.

    python benchmarks/heat.py artefacts out/heat                            # where documents can be compiled
    python benchmarks/heat.py run out/heat --out out/heat.json --jobs 8     # on the machine with the GPU
    python benchmarks/heat.py table out/heat.json                           # for docs/background/performance.md
    python benchmarks/heat.py conduction --out out/heat_conduction.json     # on a CPU, one thread

`run` needs torch and what `tgdsl.load` needs, no more; `--device cpu --eager --envs 4 --repeats 1 --steps 80` tries it out.
Each part has a process of its own, and they take turns on the GPU: see turns.py. Parts are a case and what is done with it:

- `kernel`, `definition`: three calls in a row against a float64 module, plain and compiled; then the time of a replayed CUDA
  graph of calls on so many sets of inputs and state that they exceed the GPU's L2 cache, and what its kernels take, once with
  the kernel of a step and once with its definition in torch;
- `energy`: replayed calls whose contacts come and go: what all store, against what the reports say came in, summed in float64,
  over the heat that was exchanged;
- `sweep`: the kernel alone, by how many pairs a program has, and numbers a warp.

Five links of 2 × 2 × 2 cells or 10 × 10 × 10; unless a case leaves it out there are a source, radiation, convection, a lag, and
contact: each link touches one object at a random point. `conduction` sets a step of `exact` beside the paper's: mirror the
cells, transform, divide, transform back, crop.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import heat_conduction
import numpy as np
import torch
import turns
from gpu import (
    CALLS,
    DT,
    Bench,
    captured,
    full_scale_errors,
    median_ms,
    num_sets,
    plain_ms,
    readings_of,
    replaying,
    rotating,
    synchronize,
)
from gpu_scenes import Case, bytes_of
from heat_cases import CASES, artefact, exchanged, gained, make_artefacts, state_of, stored

from tgdsl.module.artifact import load_plan
from tgdsl.module.module import TactileModule
from tgdsl.sensors.temperature_grid.step import HEAT_STEP

PARTS = (
    ("one object", "kernel"),
    ("all", "kernel"),
    ("five sensors", "kernel"),
    ("one object", "energy"),
    ("one object", "definition"),
    ("one object, 10 × 10 × 10", "definition"),
    ("conduction alone, 10 × 10 × 10", "definition"),
    ("all", "energy"),
    ("one object", "sweep"),
    ("all, 10 × 10 × 10", "definition"),
    ("all", "definition"),
    ("contact alone", "kernel"),
    ("all", "sweep"),
)
"""What `run` does, in this order."""
SWEPT = ((16, 128), (32, 128), (32, 256), (64, 256), (64, 512), (128, 256), (128, 512))
"""Pairs of an environment and a row in a program, and numbers of each of its warps."""
CHECKED, PROFILED, ENERGY_ENVS, LARGE = 64, 3, 1_024, 1e9
"""Environments whose readings are compared; calls that are profiled; environments of `energy`; bytes of state from which on
calls from Python are not timed."""
HOW, SHOWN = ("kernel", "definition", "energy", "sweep"), 12
"""Kinds of parts; kernels that are listed."""
CYCLE = 8
"""States that `energy` goes through again and again."""


# Times ----------------------------------------------------------------------------------------------------------------------


def benches(options: argparse.Namespace, name: str) -> Bench:
    """Return a case with its code, compiled at its first call, which takes the turn."""
    plan, turn = load_plan(artefact(options.folder, name)), turns.Turn(options.turn)
    return Bench.of(Case(name, "temperature_grid"), plan, turn, options)


def kernels(call: Callable[[], Any], device: torch.device) -> dict[str, tuple[float, float]]:
    """Return of each kernel of a call how often it runs and how long in all [ms], by name; nothing on a CPU."""
    if device.type != "cuda":
        return {}
    from torch.profiler import ProfilerActivity, profile

    call()
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        for _ in range(PROFILED):
            call()
        torch.cuda.synchronize()
    found: dict[str, tuple[float, float]] = {}
    for event in seen.events() or ():
        if event.device_time_total > 0:
            count, ms = found.get(event.name, (0.0, 0.0))
            found[event.name] = count + 1 / PROFILED, ms + event.device_time_total / (1e3 * PROFILED)
    return dict(sorted(found.items(), key=lambda item: -item[1][1]))


def errors(bench: Bench, core: bool) -> list[float]:
    """Return the 99.9 % quantile and the largest of the errors of calls in a row, against a float64 module on the CPU.

    Args:
        bench: The case.
        core: Whether its compiled code is called; otherwise the module as it is.
    """
    exact, plain = TactileModule(bench.plan, dtype=torch.float64), TactileModule(bench.plan).to(bench.device)
    states = [state_of(exact, CHECKED, seed, share=0.7) for seed in range(100, 100 + CALLS)]
    want = readings_of(exact, [state.to("cpu", torch.float64) for state in states])
    found = readings_of(bench.module() if core else plain, [state.to(bench.device) for state in states])
    error = full_scale_errors(exact.outputs, found, want)
    return [float(np.quantile(error, 0.999, method="higher")), float(error.max())]


def run_time(options: argparse.Namespace, name: str) -> Iterator[dict[str, Any]]:
    """Check and time a case; what is known is handed out after each step, so that a failure keeps what was before it."""
    start, bench = time.perf_counter(), benches(options, name)
    row: dict[str, Any] = {"takes_kernel": step_takes_kernel(bench), "plain_error": errors(bench, False)}
    yield row
    touch, size, device, num = bench.module(), bytes_of(TactileModule(bench.plan)), bench.device, options.envs
    states = [state_of(touch, num, seed).to(device) for seed in range(3)]
    for state in states:
        touch(state)
    row |= {"error": errors(bench, True), "ready": time.perf_counter() - start, "mb": num * size.moved / 1e6}
    yield row
    sets = rotating(bench, touch, states, options.sets or num_sets(num * size.held))
    replay = captured(lambda: [bench.core(*one) for one in sets], device)
    row |= {"sets": len(sets), "ms": median_ms(replay, options.repeats, device, batch=3) / len(sets)}
    yield row
    row |= {"kernels": kernels(lambda: bench.core(*sets[0]), device)}
    yield row
    if num * size.held < LARGE:
        row |= {"replayed": plain_ms(replaying(bench, states), states, options.repeats, device)}
        yield row


def step_takes_kernel(bench: Bench) -> bool:
    """Return whether a step of a plain call launches the kernel."""
    seen, own = [], HEAT_STEP.takes_kernel
    object.__setattr__(HEAT_STEP, "takes_kernel", lambda *of: seen.append(own(*of)) or seen[-1])
    try:
        touch = TactileModule(bench.plan).to(bench.device)
        touch(state_of(touch, 2, 0).to(bench.device))
    finally:
        object.__delattr__(HEAT_STEP, "takes_kernel")
    return any(seen)


def run_sweep(options: argparse.Namespace, name: str) -> Iterator[dict[str, Any]]:
    """Time the kernel of a step alone, by numbers in a program and in a warp."""
    from tgdsl.sensors.temperature_grid import step_kernel

    bench, given = benches(options, name), []
    touch, own = TactileModule(bench.plan).to(bench.device), step_kernel.heat_step
    step_kernel.heat_step = lambda *arguments: given.append(arguments) or own(*arguments)
    for seed in range(2):
        touch(state_of(touch, options.envs, seed).to(bench.device))
    step_kernel.heat_step, found = own, {}
    turn = turns.Turn(options.turn)
    for pairs, of_warp in SWEPT:
        step_kernel.MAX_PAIRS, step_kernel.OF_WARP = pairs, of_warp
        turn.give_back()
        step_kernel.launch(step_kernel.step_kernel, *given[-1])
        turn.take()
        call = captured(lambda: [step_kernel.launch(step_kernel.step_kernel, *given[-1]) for _ in range(8)], bench.device)
        found[f"{pairs} pairs a program, {of_warp} numbers a warp"] = median_ms(call, options.repeats, bench.device) / 8
        yield {"sweep": found}


# Energy ---------------------------------------------------------------------------------------------------------------------


def run_energy(options: argparse.Namespace, name: str) -> Iterator[dict[str, Any]]:
    """Replay calls whose contacts come and go; return what the reports do not explain of what is stored."""
    bench, num_envs = benches(options, name), min(options.envs, ENERGY_ENVS)
    touch = bench.module()
    states = [state_of(touch, num_envs, seed, share=0.5).to(options.device) for seed in range(CYCLE)]
    begun = stored(touch(states[0]))
    sets = [
        (tensors, touch.memory.tensors(num_envs, DT, torch.float32, bench.device))
        for tensors, _ in rotating(bench, touch, states, CYCLE)
    ]
    came, moved, last = (torch.zeros_like(begun) for _ in range(3))

    def cycle() -> None:
        for one in sets:
            readings = bench.core(*one)
            came.add_(gained(readings))
            moved.add_(exchanged(readings))
        last.copy_(stored(readings))  # pyright: ignore[reportPossiblyUnboundVariable]

    replay = captured(cycle, bench.device)
    replay()
    synchronize(bench.device)
    begun = last.clone()
    came.zero_()
    moved.zero_()
    start = time.perf_counter()
    for _ in range(options.steps // CYCLE):
        replay()
    synchronize(bench.device)
    error = ((last - begun - came).abs() / moved).cpu()
    yield {
        "envs": num_envs,
        "steps": options.steps // CYCLE * CYCLE,
        "seconds": time.perf_counter() - start,
        "largest": float(error.max()),
        "median": float(error.median()),
        "whole": float((last - begun - came).abs().sum() / moved.sum()),
        "exchanged_joules": float(moved.mean()),
        "stored_joules": float(last.mean()),
        "is_finite": bool(error.isfinite().all()),
    }


# Results --------------------------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> None:
    """Do all parts; one that fails is reported, and the others go on."""
    if options.child:
        return child(options)
    start, rows = time.perf_counter(), []
    for part, said, out in turns.children(options, ["--part"], [(f"{name}/{how}",) for name, how in chosen(options)]):
        print(f"{part[0]}: not begun" if said is None else said, end="\n" if said is None else "", flush=True)
        rows += json.loads(out.read_text())["rows"] if out.exists() else []
        write(options, {"seconds": time.perf_counter() - start, "rows": rows})
    print("\n".join(table_of(rows)))
    print(f"{time.perf_counter() - start:.0f} s")
    return None


def chosen(options: argparse.Namespace) -> list[tuple[str, str]]:
    """Return the parts that are wanted."""
    return [(name, how) for name, how in PARTS if how in options.how and (not options.cases or name in options.cases)]


def child(options: argparse.Namespace) -> None:
    """Do one part, and write down what is known after each of its steps."""
    name, how = options.part.split("/")
    if how == "definition":
        object.__setattr__(HEAT_STEP, "condition", lambda *_: False)
    made, row = {"energy": run_energy, "sweep": run_sweep}.get(how, run_time), {"case": name, "how": how, "envs": options.envs}
    try:
        with torch.no_grad():
            for found in made(options, name):
                row |= found
                write(options, {"rows": [row]})
    except Exception:  # of one part: what it has found so far is wanted all the same
        print(f"{options.part}: FAILED\n{traceback.format_exc()[-3000:]}", flush=True)
    print(f"{options.part}: {told(row)}", flush=True)
    turns.end()


def told(row: dict[str, Any]) -> str:
    """Return a row in a line, and its kernels in some more."""
    numbers = {key: value for key, value in row.items() if key not in ("case", "how", "kernels")}
    lines = [
        "  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in numbers.items())
    ]
    for name, (count, ms) in list(row.get("kernels", {}).items())[:SHOWN]:
        lines.append(f"    {ms:.4f} ms  {count:.0f} ×  {name[:140]}")
    return "\n".join(lines)


def table_of(rows: list[dict[str, Any]]) -> list[str]:
    """Return the docs' table."""
    lines = ["| case | step by | error (largest) | call [ms] | replayed [ms] | must move [MB] | kernels | sum [ms] |"]
    lines.append("|---" * 8 + "|")
    for row in rows:
        if row["how"] in ("kernel", "definition"):
            parts = list(row.get("kernels", {}).values())
            errors = "{:.0e} ({:.0e})".format(*row["error"]) if "error" in row else "–"
            of_kernels = f"{sum(n for n, _ in parts):.0f} | {sum(ms for _, ms in parts):.4f}"
            ms, replayed = (f"{row[key]:.4f}" if key in row else "–" for key in ("ms", "replayed"))
            lines.append(
                f"| {row['case']} | {row['how']} | {errors} | {ms} | {replayed} | {row.get('mb', 0):.0f} | {of_kernels} |"
            )
    return lines


def run_table(options: argparse.Namespace) -> None:
    """Print the docs' table."""
    print("\n".join(table_of(json.loads(options.file.read_text())["rows"])))


def run_conduction(options: argparse.Namespace) -> None:
    """Time conduction on a CPU."""
    write(options, {"rows": heat_conduction.timed(options.cells, options.envs, options.repeats)})


def write(options: argparse.Namespace, found: dict[str, Any]) -> None:
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        where = torch.cuda.get_device_name() if getattr(options, "device", "cpu") != "cpu" else "CPU"
        options.out.write_text(json.dumps({"device": where, "torch": torch.__version__, **found}, indent=1) + "\n")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    own = commands.add_parser("artefacts")
    own.set_defaults(call=make_artefacts)
    own.add_argument("folder", type=Path)
    own = commands.add_parser("run")
    own.set_defaults(call=run)
    own.add_argument("folder", type=Path)
    own.add_argument("--device", default="cuda")
    own.add_argument("--eager", action="store_true", help="leave the modules uncompiled")
    own.add_argument("--envs", type=int, default=16_384)
    own.add_argument("--out", type=Path)
    own.add_argument("--cases", nargs="+", choices=CASES, help="these alone")
    own.add_argument("--how", nargs="+", choices=HOW, default=HOW, help="these parts alone")
    own.add_argument("--part", help="case/part: what a process of its own does")
    own.add_argument("--repeats", type=int, default=30)
    own.add_argument("--steps", type=int, default=100_000, help="calls of `energy`")
    own.add_argument("--sets", type=int, help="sets of buffers at most")
    turns.add_options(own)
    own = commands.add_parser("table")
    own.set_defaults(call=run_table)
    own.add_argument("file", type=Path)
    own = commands.add_parser("conduction")
    own.set_defaults(call=run_conduction)
    own.add_argument("--cells", nargs="+", type=int, default=[2, 3, 4, 6, 8, 10])
    own.add_argument("--envs", type=int, default=256)
    own.add_argument("--repeats", type=int, default=20)
    own.add_argument("--out", type=Path)
    options = parser.parse_args(namespace=argparse.Namespace(arguments=[__file__, *sys.argv[1:]]))
    options.call(options)


if __name__ == "__main__":
    main()
