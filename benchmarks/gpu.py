"""Measure the module alone on a GPU: time, error and bytes of every kind, by environments, taxels, objects, points and noise.

    python benchmarks/gpu.py artefacts out/gpu                              # on any machine with tgdsl
    python benchmarks/gpu.py run out/gpu --out out/gpu.json --jobs 8        # on the machine with the GPU
    python benchmarks/gpu.py guard out/gpu --jobs 8                         # rows with a limit, against recorded ratios
    python benchmarks/gpu.py table out/gpu.json                             # for docs/background/performance.md
    python benchmarks/gpu.py plot out/gpu.json --out docs/images
    python benchmarks/gpu.py bytes out/gpu                                  # memory of every case, without a GPU

`run` needs only torch and the dependencies of `tgdsl.load`; `--device cpu --eager` tries it without a GPU. Each case runs in a
separate process, `--jobs` at once, and processes take turns on the GPU: see turns.py. Rows are printed and written as processes
end.

The error compares three successive float32 calls on the device with a float64 module on the CPU, relative to the largest
magnitude of each channel. Times are medians: of a replayed CUDA graph of calls on enough sets of inputs, state and readings to
exceed the GPU's L2 cache; and of a call from Python, plain or replaying a graph, on rotating inputs. `copy` is the time to copy
the bytes that a call must move, in the same way, by the faster of two kernels.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import statistics
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gpu_plots
import numpy as np
import torch
import turns
from gpu_plots import HEAD, TARGETS, Row, load_rows
from gpu_scenes import CASES, DT, Case, artefact, bytes_of, make_artefacts, state_of
from torch import Tensor

from tgdsl.module.artifact import load_plan
from tgdsl.module.calls import Graphed
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.module.state import SceneState
from tgdsl.plan.plan import Plan

ROTATED = 160e6
"""Total bytes of the sets of buffers: the L2 of an H200 holds 60 MB."""
MOST_SETS = 256
LONG = 1_000.0
"""Total time after which repeating stops [ms]."""
SLOWER = 0.1
"""Relative excess of a row's ratio to the copy over the recorded one that `guard` accepts."""
KEPT = Path(__file__).parents[1] / "docs" / "measured" / "gpu_guard.json"
CALLS = 3
"""Successive calls whose readings are compared."""
Tensors = dict[str, Tensor]
Core = Callable[[Tensors, Tensors], Tensors]
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Bench:
    """A case's plan, and code that serves every number of environments."""

    case: Case
    plan: Plan
    core: Core
    device: torch.device

    @classmethod
    def of(cls, case: Case, plan: Plan, turn: turns.Turn, options: argparse.Namespace) -> Bench:
        """Prepare a case; its code is compiled at the first call, and takes the turn before it runs."""
        touch = TactileModule(plan).to(options.device)
        if options.eager:
            return cls(case, plan, touch.advance, touch.device)
        turn.compile(touch)
        return cls(case, plan, touch.calls.of(touch.advance), touch.device)

    def module(self, graph: bool = False) -> TactileModule:
        """Return a module without memory, with the case's code."""
        touch = TactileModule(self.plan).to(self.device)
        touch.calls.compiled = {"advance": self.core}
        touch.calls.graphed = {"advance": Graphed(self.core)} if graph and self.device.type == "cuda" else {}
        return touch


def states_of(case: Case, plan: Plan, num_envs: int, count: int, seed: int = 0) -> list[SceneState]:
    """Return random states on the CPU."""
    return [state_of(TactileModule(plan), num_envs, seed + i, case.contacts) for i in range(count)]


# Correctness ----------------------------------------------------------------------------------------------------------------


def readings_of(touch: TactileModule, states: Sequence[SceneState]) -> Arrays:
    """Return the readings of successive calls of a module, (call, env, …)."""
    calls = [{name: value.double().cpu().numpy() for name, value in touch(state).items()} for state in states]
    return {name: np.stack([call[name] for call in calls]) for name in calls[0]}


def full_scale_errors(outputs: Sequence[Output], readings: Arrays, expected: Arrays) -> np.ndarray:
    """Return |readings − expected| of all channels over the largest |expected| of each channel, flat.

    A sensor's secondary readings, such as `missed`, are differences that may be near 0. Their scale is at least that of the
    sensor's other channels with the same unit. The error is infinite where all expected values are 0 and a reading is not.

    Raises:
        ValueError: If an error is not finite.
    """
    largest = {name: np.abs(value).reshape(-1, value.shape[-1]).max(axis=0) for name, value in expected.items()}
    errors = []
    for output in outputs:
        error = np.abs(readings[output.name] - expected[output.name])
        if not np.isfinite(error).all():
            raise ValueError(f"{output.name} is not finite, expected numbers")
        scale = largest[output.name].copy()
        if output.name != output.sensor:
            for other in outputs:
                if other.sensor == output.sensor and other is not output:
                    for unit, size in zip(other.units, largest[other.name], strict=True):
                        scale = np.where(np.array(output.units) == unit, np.maximum(scale, size), scale)
        scale = np.broadcast_to(scale, error.shape)
        errors.append(np.divide(error, scale, out=np.where(error > 0, np.inf, 0.0), where=scale > 0).reshape(-1))
    return np.concatenate(errors)


# Times ----------------------------------------------------------------------------------------------------------------------


def num_sets(num_bytes: float) -> int:
    """Return the number of sets of buffers of a size to rotate."""
    return min(max(2, math.ceil(ROTATED / num_bytes)), MOST_SETS)


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def captured(call: Callable[[], Any], device: torch.device) -> Callable[[], None]:
    """Return the replay of a call captured in a CUDA graph, which keeps the outputs; on a CPU the call."""
    if device.type != "cuda":
        return call
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(2):
            call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        outputs = call()

    def replay(_memory: Any = (call, outputs)) -> None:  # the graph reads and writes their memory, so they must live as long
        graph.replay()

    return replay


def median_ms(call: Callable[[], Any], repeats: int, device: torch.device, batch: int = 5) -> float:
    """Return the median time of a call [ms] over batches of calls; on a GPU between CUDA events."""

    def batch_ms() -> float:
        if device.type != "cuda":
            start = time.perf_counter()
            for _ in range(batch):
                call()
            return 1e3 * (time.perf_counter() - start)
        events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
        events[0].record()
        for _ in range(batch):
            call()
        events[1].record()
        torch.cuda.synchronize()
        return events[0].elapsed_time(events[1])

    return median_of(batch_ms, repeats) / batch


def plain_ms(touch: TactileModule, states: list[SceneState], repeats: int, device: torch.device, batch: int = 20) -> float:
    """Return the median time of a call of the module [ms], host and device, over batches that end with the device idle."""
    recent = deque(maxlen=8)  # readings stay alive, so that the next call cannot reuse their memory

    def batch_ms() -> float:
        synchronize(device)
        start = time.perf_counter()
        for i in range(batch):
            recent.append(touch(states[i % len(states)]))
        synchronize(device)
        return 1e3 * (time.perf_counter() - start)

    return median_of(batch_ms, repeats) / batch


def median_of(measured: Callable[[], float], repeats: int) -> float:
    """Return the median of measured times [ms] after a warm-up; once they exceed `LONG` in total, three are enough."""
    measured()
    times: list[float] = []
    while len(times) < repeats and not (sum(times) > LONG and len(times) >= 3):
        times.append(measured())
    return statistics.median(times)


def replaying(bench: Bench, states: list[SceneState]) -> TactileModule:
    """Return a module whose calls replay a graph.

    Raises:
        ValueError: If replayed readings differ from those of plain calls.
    """
    touch, plain = bench.module(graph=True), bench.module()
    for state in states[:CALLS]:
        readings, expected = touch(state), plain(state)
        if names := [name for name in expected if not torch.equal(readings[name], expected[name])]:
            raise ValueError(f"replayed readings of {', '.join(names)} differ from those of a plain call")
    return bench.module(graph=True)


def copy_ms(num_bytes: int, repeats: int, device: torch.device) -> float:
    """Return the median time [ms] to read and write that many bytes in total, by the faster of two kernels."""
    pairs = [torch.rand(2, max(num_bytes // 8, 1), device=device).unbind(0) for _ in range(num_sets(num_bytes))]
    copies = (lambda: [to.copy_(of) for of, to in pairs], lambda: [torch.neg(of, out=to) for of, to in pairs])
    return min(median_ms(captured(copy, device), repeats, device) for copy in copies) / len(pairs)


def rotating(bench: Bench, touch: TactileModule, states: list[SceneState], count: int) -> list[tuple[Tensors, Tensors]]:
    """Return sets of inputs and module memory, each in separate buffers."""
    num_envs = next(value for value in vars(states[0]).values() if isinstance(value, Tensor)).shape[0]
    dt = DT if "dt" in bench.plan.inputs.fields else None
    sets = []
    for i in range(count):
        tensors = states[i % len(states)].checked(bench.plan.inputs, bench.device)
        tensors = {name: value.roll(97 * (i // len(states)), 0) for name, value in tensors.items()}
        if dt is not None:
            tensors["dt"] = torch.tensor(dt, dtype=torch.float32, device=bench.device)
        memory = touch.memory.tensors(num_envs, dt, torch.float32, bench.device)
        sets.append((tensors, {name: value.clone() for name, value in memory.items()}))
    return sets


def transient_bytes(touch: TactileModule, state: SceneState, device: torch.device) -> int | None:
    """Return the peak memory of a plain call, readings included; None on a CPU."""
    if device.type != "cuda":
        return None
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    allocated = torch.cuda.memory_allocated()
    touch(state)
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() - allocated


def measure(bench: Bench, num_envs: int, error: np.ndarray, options: argparse.Namespace) -> Row:
    """Time a case at one number of environments."""
    start = time.perf_counter()
    case, device = bench.case, bench.device
    size = bytes_of(TactileModule(bench.plan))
    states = [state.to(device) for state in states_of(case, bench.plan, num_envs, 4)]
    touch = bench.module()
    readings = [touch(state) for state in states][-1]
    active = next(iter(readings.values()))
    sets = rotating(bench, touch, states, options.sets or num_sets(num_envs * size.held))
    graph = median_ms(captured(lambda: [bench.core(*one) for one in sets], device), options.repeats, device) / len(sets)
    return Row(
        case=case.name,
        kind=case.kind,
        noise=case.noise,
        num_envs=num_envs,
        num_taxels=size.num_taxels,
        num_objects=case.num_objects,
        points=case.points,
        in_contact=float((active != 0).any(dim=-1).double().mean()),
        error=float(np.quantile(error, 0.999, method="higher")),
        error_largest=float(error.max()),
        graph=graph,
        plain=plain_ms(touch, states, options.repeats, device),
        replayed=plain_ms(replaying(bench, states), states, options.repeats, device),
        copy=copy_ms(num_envs * size.moved, options.repeats, device),
        sets=len(sets),
        moved=num_envs * size.moved,
        per_taxel=size.per_taxel,
        ring_per_taxel=size.ring_per_taxel,
        anchors_per_taxel=size.anchors / size.num_taxels,
        per_anchor=size.per_anchor,
        transient=transient_bytes(touch, states[0], device),
        seconds=time.perf_counter() - start,
    )


# Runs -----------------------------------------------------------------------------------------------------------------------


def nums_of_envs(case: Case, options: argparse.Namespace) -> Sequence[int]:
    """Return the numbers of environments at which to time a case: `--envs`, else the limited ones for `guard`, else all."""
    limited = [num_envs for name, num_envs in TARGETS if name == case.name]
    return options.envs or (limited if options.limited else case.envs)


def rows_of(case: Case, options: argparse.Namespace) -> Iterator[Row]:
    """Measure a case at each number of environments; report a failure and go on."""
    plan, turn = load_plan(artefact(options.folder, case)), turns.Turn(options.turn)
    first = states_of(case, plan, nums_of_envs(case, options)[0], 1)[0]
    checked = states_of(case, plan, options.check_envs, CALLS, seed=100)
    turn.take()
    bench, exact = Bench.of(case, plan, turn, options), TactileModule(plan, dtype=torch.float64)
    touch, first = bench.module(), first.to(bench.device)
    if not options.eager:
        turn.give_back()
    with torch.no_grad():  # code is compiled for many environments, then checked on few
        expected = readings_of(exact, [state.to("cpu", torch.float64) for state in checked])
        touch(first)
        readings = readings_of(bench.module(), [state.to(bench.device) for state in checked])
        error = full_scale_errors(exact.outputs, readings, expected)
    for num_envs in nums_of_envs(case, options):
        try:
            with torch.no_grad():
                row = measure(bench, num_envs, error, options)
        except Exception:  # the other numbers of environments are still worth measuring
            print(f"{case.name} × {num_envs}: FAILED\n{traceback.format_exc()}", flush=True)
        else:
            yield row
        gc.collect()
        if bench.device.type == "cuda":
            torch.cuda.empty_cache()


def run(options: argparse.Namespace) -> None:
    """Measure cases and write their rows; report those for which no time is left."""
    if options.child:
        for row in rows_of(CASES[options.rows[0]], options):
            print(row.line(), flush=True)
            write(options.out, row, {})
        turns.end()
    start, left = time.perf_counter(), []
    where = torch.cuda.get_device_name() if options.device != "cpu" else "CPU"
    versions = {"device": where, "torch": torch.__version__, "repeats": options.repeats}
    print(f"torch {torch.__version__}, {where}, float32, medians of up to {options.repeats}; times [ms]\n{HEAD}", flush=True)
    for (name,), output, out in turns.children(options, ["--rows"], [(name,) for name in options.rows]):
        if output is None:
            left.append(name)
            continue
        print(output, end="", flush=True)
        for row in load_rows([out]) if out.exists() else []:
            write(options.out, row, versions)
    print(f"{time.perf_counter() - start:.0f} s" + (f"; not measured: {' '.join(left)}" if left else ""))


def guard(options: argparse.Namespace) -> None:
    """Time the rows that have a limit; exit 1 if a ratio to the copy exceeds the recorded one by more than a tenth."""
    options.limited = True
    if options.child:
        run(options)
    options.out.unlink(missing_ok=True)
    run(options)
    card = json.loads(options.out.read_text())["device"]
    records = json.loads(options.kept.read_text()) if options.kept.exists() else {}
    ratios = {f"{row.case} × {row.num_envs:,}": round(row.graph / row.copy, 3) for row in load_rows([options.out])}
    if options.keep:
        options.kept.write_text(json.dumps({**records, card: ratios}, indent=1, ensure_ascii=False) + "\n")
    lines, is_met = compared(ratios, records.get(card, {}))
    print(f"{card}\n" + "\n".join(lines))
    raise SystemExit(0 if is_met or options.keep else 1)


def compared(ratios: Mapping[str, float], recorded: Mapping[str, float]) -> tuple[list[str], bool]:
    """Compare ratios to the copy with recorded ones, by row.

    Returns:
        A line per row, and whether every recorded row was timed and none is slower by more than `SLOWER`.
    """
    lines, is_met = [], bool(recorded)
    for name in {**recorded, **ratios}:
        ratio, old = ratios.get(name), recorded.get(name)
        is_slower = old is not None and (ratio is None or ratio > (1 + SLOWER) * old)
        is_met &= not is_slower
        change = "not timed" if ratio is None else "not recorded" if old is None else f"{ratio / old - 1:+.0%}"
        lines.append(f"{name:<34}{ratio or math.nan:8.3f}{old or math.nan:8.3f}  {change}{'  SLOWER' if is_slower else ''}")
    return lines, is_met


def write(path: Path, row: Row, versions: dict[str, Any]) -> None:
    """Add a row to a JSON file; it replaces an earlier row of the same measurement."""
    rows = [other for other in load_rows([path]) if other.key != row.key] if path.exists() else []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**versions, "rows": [asdict(other) for other in (*rows, row)]}, indent=1))


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """Return the parsed command line, and in `arguments` the command that repeats it."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    compiling = commands.add_parser("artefacts", help="compile all documents")
    compiling.add_argument("folder", type=Path)
    compiling.add_argument("--rows", nargs="+", choices=CASES, default=list(CASES))
    compiling.set_defaults(call=lambda options: make_artefacts(options.folder, [CASES[name] for name in options.rows]))
    for name, call in (("run", run), ("guard", guard)):
        running = commands.add_parser(name, help=str(call.__doc__).partition(";")[0])
        running.add_argument("folder", type=Path, help="artefacts")
        running.add_argument("--rows", nargs="+", choices=CASES, default=list(CASES))
        running.add_argument("--envs", nargs="+", type=int, help="numbers of environments, instead of each case's")
        running.add_argument("--device", default="cuda")
        running.add_argument("--eager", action="store_true", help="leave the modules uncompiled")
        running.add_argument("--repeats", type=int, default=30)
        running.add_argument("--sets", type=int, help="sets of buffers, instead of enough to exceed the L2")
        running.add_argument("--check-envs", type=int, default=64, help="environments whose readings are compared")
        turns.add_options(running)
        running.set_defaults(call=call, limited=False)
        if name == "run":
            running.add_argument("--out", type=Path, required=True, help="JSON file, in which rows of earlier runs stay")
        else:
            running.add_argument("--out", type=Path, default=Path("out/gpu_guard.json"), help="JSON file of the rows")
            running.add_argument("--kept", type=Path, default=KEPT, help="JSON file of recorded ratios, by card and row")
            running.add_argument("--keep", action="store_true", help="record the ratios of this run")
            running.set_defaults(rows=list(dict.fromkeys(case for case, _ in TARGETS)))
    gpu_plots.add_commands(commands)
    return parser.parse_args(arguments, argparse.Namespace(arguments=[__file__, *arguments]))


if __name__ == "__main__":
    command = parsed()
    command.call(command)
