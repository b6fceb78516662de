"""Measure `temperature_grid`: time, error and conserved energy of a call on a GPU; conduction on a CPU.

    python benchmarks/heat.py artefacts out/heat                            # on any machine with tgdsl
    python benchmarks/heat.py run out/heat --out out/heat.json --jobs 8     # on the machine with the GPU
    python benchmarks/heat.py table out/heat.json                           # for docs/background/performance.md
    python benchmarks/heat.py conduction --out out/heat_conduction.json     # on a CPU, one thread

`run` needs only torch and the dependencies of `tgdsl.load`; `--device cpu --eager --envs 4 --repeats 1 --steps 80` tries it.
Each part, a case with a measurement, runs in a separate process, and processes take turns on the GPU: see turns.py.

- `kernel`, `definition`: the error of three successive calls, plain and compiled, against a float64 module; the time of a
  replayed CUDA graph of calls on enough sets of inputs and state to exceed the GPU's L2 cache; and the times of its kernels.
  The step is the Triton kernel or its definition in torch.
- `energy`: replayed calls with changing contacts; stored heat minus the reported exchange, summed in float64, over the total
  exchange.
- `sweep`: the kernel alone, by pairs per program and numbers per warp.

There are five links of 2 × 2 × 2 or 10 × 10 × 10 cells. Unless a case leaves them out there are a source, radiation,
convection, a lag, and contact: each link touches one object at a random point. `conduction` compares a step of `exact` with the
paper's: mirror the cells, transform, divide, transform back, crop.
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
from heat_cases import artefact, exchanged, gained, make_artefacts, state_of, stored

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
"""The parts of `run`: case and measurement, in order."""
SWEPT = ((16, 128), (32, 128), (32, 256), (64, 256), (64, 512), (128, 256), (128, 512))
"""Pairs (of an environment and a row) per program, and numbers per warp."""
CHECKED, PROFILED, ENERGY_ENVS, LARGE = 64, 3, 1_024, 1e9
"""Environments whose readings are compared; profiled calls; environments of `energy`; bytes of state above which calls from
Python are not timed."""
LISTED = 12
"""Kernels that are listed."""
CYCLE = 8
"""States in the cycle of `energy`."""


# Times ----------------------------------------------------------------------------------------------------------------------


def bench_of(options: argparse.Namespace, name: str) -> Bench:
    """Return a case, whose code is compiled at its first call, which takes the turn."""
    plan, turn = load_plan(artefact(options.folder, name)), turns.Turn(options.turn)
    return Bench.of(Case(name, "temperature_grid"), plan, turn, options)


def kernels(call: Callable[[], Any], device: torch.device) -> dict[str, tuple[float, float]]:
    """Return the number of launches and the total time [ms] of each kernel of a call, by name; nothing on a CPU."""
    if device.type != "cuda":
        return {}
    from torch.profiler import ProfilerActivity, profile

    call()
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(PROFILED):
            call()
        torch.cuda.synchronize()
    result: dict[str, tuple[float, float]] = {}
    for event in profiler.events() or ():
        if event.device_time_total > 0:
            count, ms = result.get(event.name, (0.0, 0.0))
            result[event.name] = count + 1 / PROFILED, ms + event.device_time_total / (1e3 * PROFILED)
    return dict(sorted(result.items(), key=lambda item: -item[1][1]))


def errors(bench: Bench, touch: TactileModule) -> list[float]:
    """Return the 99.9 % quantile and the largest error of successive calls, against a float64 module on the CPU."""
    exact = TactileModule(bench.plan, dtype=torch.float64)
    states = [state_of(exact, CHECKED, seed, share=0.7) for seed in range(100, 100 + CALLS)]
    expected = readings_of(exact, [state.to("cpu", torch.float64) for state in states])
    readings = readings_of(touch, [state.to(bench.device) for state in states])
    error = full_scale_errors(exact.outputs, readings, expected)
    return [float(np.quantile(error, 0.999, method="higher")), float(error.max())]


def run_time(options: argparse.Namespace, name: str) -> Iterator[dict[str, Any]]:
    """Check and time a case; yield the row after each step, so that a failure loses nothing before it."""
    start, bench = time.perf_counter(), bench_of(options, name)
    plain = TactileModule(bench.plan).to(bench.device)
    row: dict[str, Any] = {"takes_kernel": step_takes_kernel(bench), "plain_error": errors(bench, plain)}
    yield row
    touch, size, device, num = bench.module(), bytes_of(TactileModule(bench.plan)), bench.device, options.envs
    states = [state_of(touch, num, seed).to(device) for seed in range(3)]
    for state in states:
        touch(state)
    row |= {"error": errors(bench, bench.module()), "ready": time.perf_counter() - start, "mb": num * size.moved / 1e6}
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
    """Return whether a plain call launches the kernel of a step."""
    results, original = [], HEAT_STEP.takes_kernel
    object.__setattr__(HEAT_STEP, "takes_kernel", lambda *inputs: results.append(original(*inputs)) or results[-1])
    try:
        touch = TactileModule(bench.plan).to(bench.device)
        touch(state_of(touch, 2, 0).to(bench.device))
    finally:
        object.__delattr__(HEAT_STEP, "takes_kernel")
    return any(results)


def run_sweep(options: argparse.Namespace, name: str) -> Iterator[dict[str, Any]]:
    """Time the kernel of a step alone, by pairs per program and numbers per warp."""
    from tgdsl.sensors.temperature_grid import step_kernel

    bench, calls = bench_of(options, name), []
    touch, original = TactileModule(bench.plan).to(bench.device), step_kernel.heat_step
    step_kernel.heat_step = lambda *arguments: calls.append(arguments) or original(*arguments)
    for seed in range(2):
        touch(state_of(touch, options.envs, seed).to(bench.device))
    step_kernel.heat_step, times = original, {}
    turn = turns.Turn(options.turn)
    for pairs, numbers in SWEPT:
        step_kernel.MAX_PAIRS, step_kernel.OF_WARP = pairs, numbers
        turn.give_back()
        step_kernel.launch(step_kernel.step_kernel, *calls[-1])
        turn.take()
        call = captured(lambda: [step_kernel.launch(step_kernel.step_kernel, *calls[-1]) for _ in range(8)], bench.device)
        times[f"{pairs} pairs a program, {numbers} numbers a warp"] = median_ms(call, options.repeats, bench.device) / 8
        yield {"sweep": times}


# Energy ---------------------------------------------------------------------------------------------------------------------


def run_energy(options: argparse.Namespace, name: str) -> Iterator[dict[str, Any]]:
    """Replay calls with changing contacts; return the stored heat that the reports do not explain."""
    bench, num_envs = bench_of(options, name), min(options.envs, ENERGY_ENVS)
    touch = bench.module()
    states = [state_of(touch, num_envs, seed, share=0.5).to(options.device) for seed in range(CYCLE)]
    start_heat = stored(touch(states[0]))
    sets = [
        (tensors, touch.memory.tensors(num_envs, DT, torch.float32, bench.device))
        for tensors, _ in rotating(bench, touch, states, CYCLE)
    ]
    gain, exchange, heat = (torch.zeros_like(start_heat) for _ in range(3))

    def cycle() -> None:
        for one in sets:
            readings = bench.core(*one)
            gain.add_(gained(readings))
            exchange.add_(exchanged(readings))
        heat.copy_(stored(readings))  # pyright: ignore[reportPossiblyUnboundVariable]

    replay = captured(cycle, bench.device)
    replay()
    synchronize(bench.device)
    start_heat = heat.clone()
    gain.zero_()
    exchange.zero_()
    start = time.perf_counter()
    for _ in range(options.steps // CYCLE):
        replay()
    synchronize(bench.device)
    unexplained = (heat - start_heat - gain).abs()
    error = (unexplained / exchange).cpu()
    yield {
        "envs": num_envs,
        "steps": options.steps // CYCLE * CYCLE,
        "seconds": time.perf_counter() - start,
        "largest": float(error.max()),
        "median": float(error.median()),
        "whole": float(unexplained.sum() / exchange.sum()),
        "exchanged_joules": float(exchange.mean()),
        "stored_joules": float(heat.mean()),
        "is_finite": bool(error.isfinite().all()),
    }


# Results --------------------------------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> None:
    """Measure all parts; report a failure and go on."""
    if options.child:
        return child(options)
    start, rows = time.perf_counter(), []
    for (part,), output, out in turns.children(options, ["--part"], [(f"{name}/{how}",) for name, how in PARTS]):
        print(f"{part}: not measured\n" if output is None else output, end="", flush=True)
        rows += json.loads(out.read_text())["rows"] if out.exists() else []
        write(options, {"seconds": time.perf_counter() - start, "rows": rows})
    print("\n".join(table_of(rows)))
    print(f"{time.perf_counter() - start:.0f} s")
    return None


def child(options: argparse.Namespace) -> None:
    """Measure a part, and write its row after each step."""
    name, how = options.part.split("/")
    if how == "definition":
        object.__setattr__(HEAT_STEP, "condition", lambda *_: False)
    measurement, row = {"energy": run_energy, "sweep": run_sweep}.get(how, run_time), {"case": name, "how": how}
    row["envs"] = options.envs
    try:
        with torch.no_grad():
            for numbers in measurement(options, name):
                row |= numbers
                write(options, {"rows": [row]})
    except Exception:  # the numbers so far are still worth reporting
        print(f"{options.part}: FAILED\n{traceback.format_exc()[-3000:]}", flush=True)
    print(f"{options.part}: {text(row)}", flush=True)
    turns.end()


def text(row: dict[str, Any]) -> str:
    """Return a row in one line, and its kernels below."""
    numbers = {key: value for key, value in row.items() if key not in ("case", "how", "kernels")}
    lines = [
        "  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in numbers.items())
    ]
    for name, (count, ms) in list(row.get("kernels", {}).items())[:LISTED]:
        lines.append(f"    {ms:.4f} ms  {count:.0f} ×  {name[:140]}")
    return "\n".join(lines)


def table_of(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of the docs' table."""
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


def write(options: argparse.Namespace, results: dict[str, Any]) -> None:
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        where = torch.cuda.get_device_name() if getattr(options, "device", "cpu") != "cpu" else "CPU"
        options.out.write_text(json.dumps({"device": where, "torch": torch.__version__, **results}, indent=1) + "\n")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("artefacts")
    command.set_defaults(call=make_artefacts)
    command.add_argument("folder", type=Path)
    command = commands.add_parser("run")
    command.set_defaults(call=run)
    command.add_argument("folder", type=Path)
    command.add_argument("--device", default="cuda")
    command.add_argument("--eager", action="store_true", help="leave the modules uncompiled")
    command.add_argument("--envs", type=int, default=16_384)
    command.add_argument("--out", type=Path)
    command.add_argument("--part", help="case/measurement of a process with `--child`")
    command.add_argument("--repeats", type=int, default=30)
    command.add_argument("--steps", type=int, default=100_000, help="calls of `energy`")
    command.add_argument("--sets", type=int, help="sets of buffers, instead of enough to exceed the L2")
    turns.add_options(command)
    command = commands.add_parser("table")
    command.set_defaults(call=run_table)
    command.add_argument("file", type=Path)
    command = commands.add_parser("conduction")
    command.set_defaults(call=run_conduction)
    command.add_argument("--cells", nargs="+", type=int, default=[2, 3, 4, 6, 8, 10])
    command.add_argument("--envs", type=int, default=256)
    command.add_argument("--repeats", type=int, default=20)
    command.add_argument("--out", type=Path)
    options = parser.parse_args(namespace=argparse.Namespace(arguments=[__file__, *sys.argv[1:]]))
    options.call(options)


if __name__ == "__main__":
    main()
