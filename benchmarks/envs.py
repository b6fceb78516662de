"""Time a step of a task's environments: against physics and module alone, in parts, and over a long run.

    python benchmarks/envs.py                                                    # all tasks of examples/tasks, on the CPU
    python benchmarks/envs.py --device cuda --envs 8192 --seconds 100 --out out/envs.json
    python benchmarks/envs.py examples/tasks/in_palm_rotate.yaml --cones pyramidal --set randomise.drive={}

Actions are random, and environments reset themselves. For each task and friction cone:

- `ratio`: the time of `TouchEnv.step` over that of physics and module alone (on a GPU `sim.step_and_read`, else `sim.step` and
  the module), from the same states with the same targets of the same drives; `ratio_ideal`: over that with the robot's own
  actuators instead of drives. Blocks alternate; times are medians over blocks.
- Shares of a step, in percent: `physics`, `drive`, `touch` with watched contacts, `logic` (actions, pushes, rewards,
  observations) and `reset` (starting and reading episodes). On a GPU they come from events in the CUDA graph of a step.
- `--seconds` adds a long run; it counts values that are not finite, faults and ended episodes, and measures the memory after a
  fifth of the time and at the end.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import tgdsl
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task

TASKS = Path(__file__).parents[1] / "examples" / "tasks"
WARM_STEPS = 100
"""Steps before timing: objects come to rest on the palm, and graphs are captured."""
PARTS = ("physics", "drive", "touch", "logic", "reset")


class Clock:
    """Times work: on a GPU by events, on a CPU by wall time or by the CPU time of this process."""

    def __init__(self, device: torch.device, is_cpu_time: bool = False):
        self._is_cuda = device.type == "cuda"
        self._now = time.process_time if is_cpu_time else time.perf_counter

    def seconds(self, work: Callable[[], object]) -> float:
        """Return the duration of a call [s]."""
        if not self._is_cuda:
            start = self._now()
            work()
            return self._now() - start
        first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        first.record()
        work()
        last.record()
        torch.cuda.synchronize()
        return first.elapsed_time(last) / 1e3


class Stamps:
    """Records when parts of a step begin and end: on the CPU by its clock, on a GPU by events in the captured graph."""

    def __init__(self, device: torch.device):
        self._is_cuda = device.type == "cuda"
        self._open: list[str] = []
        self.labels: list[str] = []
        self.stamps: list[Any] = []

    def begin(self) -> None:
        """Clear the record of the last step."""
        self._open, self.labels, self.stamps = [], [], []

    def _stamp(self) -> None:
        if self._is_cuda:
            event = torch.cuda.Event(enable_timing=True, external=True)
            event.record()
            self.stamps.append(event)
        else:
            self.stamps.append(time.perf_counter())
        self.labels.append(" > ".join(self._open))

    def within(self, label: str, method: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method that records when it begins and ends."""

        def stamped_method(*args: Any, **kwargs: Any) -> Any:
            self._open.append(label)
            self._stamp()
            try:
                return method(*args, **kwargs)
            finally:
                self._open.pop()
                self._stamp()

        return stamped_method

    def durations(self) -> dict[str, float]:
        """Return the time in each innermost part [s], by labels from the outside in."""
        result: dict[str, float] = {}
        for label, (first, last) in zip(self.labels, pairwise(self.stamps), strict=False):
            seconds = first.elapsed_time(last) / 1e3 if self._is_cuda else last - first
            result[label] = result.get(label, 0.0) + seconds
        return result


def actions(env: TouchEnv, seed: int = 0) -> Iterator[Tensor]:
    """Yield random actions from −1 to 1 in a cycle of 64."""
    generator = torch.Generator(env.device).manual_seed(seed)
    cycle = 2.0 * torch.rand((64, env.num_envs, env.num_actions), generator=generator, device=env.device) - 1.0
    while True:
        yield from cycle


def environments(options: argparse.Namespace, task: Path, cone: str) -> TouchEnv:
    """Return environments of a task at evenly spread steps of their episodes."""
    overrides = dict(entry.split("=", 1) for entry in options.set) | {"physics.cone": cone}
    env = TouchEnv(
        load_task(task, overrides),
        options.envs,
        device=options.device,
        threads=options.threads,
        compiled=options.compiled or None,
    )
    env.steps.copy_(torch.arange(options.envs) * env.max_steps // options.envs)
    return env


class Alone:
    """The physics and the module of environments, without their logic."""

    def __init__(self, env: TouchEnv, is_ideal: bool):
        """Take environments; `is_ideal` replaces drives by the robot's own actuators."""
        self._env, self._is_ideal = env, is_ideal or env.actuation.is_ideal
        if self._is_ideal:
            env.sim.drive = None

    def begin(self, state: dict[str, dict[str, Tensor]]) -> None:
        """Continue from the state of other environments of the same task."""
        self._env.load_state_dict(state)
        if self._is_ideal:
            self._env.sim.arrays["qfrc_applied"].zero_()

    def step(self, targets: tuple[Tensor, Tensor]) -> object:
        """Make a control step with controls or with the targets of drives."""
        env, (controls, past) = self._env, targets
        if not self._is_ideal:
            env.actuation.memory()["past"].copy_(past)
        if env.device.type == "cuda":
            return env.sim.step_and_read(controls if self._is_ideal else None)  # type: ignore[union-attr]
        with torch.no_grad():
            env.sim.step(controls if self._is_ideal else None)
            return env.touch(env.sim.state())


def compare(options: argparse.Namespace, env: TouchEnv, others: list[Alone]) -> list[list[float]]:
    """Return the time of a step in each block [s], of the environments and of physics and module alone."""
    clock, stream = Clock(env.device, options.cpu_time), actions(env)
    series: list[list[float]] = [[] for _ in range(1 + len(others))]
    for block in range(1 + options.blocks):  # graphs are captured in the first block
        state, targets, inputs = env.state_dict(), [], [next(stream) for _ in range(options.steps)]

        def whole(inputs: list[Tensor] = inputs, targets: list[Any] = targets) -> None:
            for action in inputs:
                env.step(action)
                targets.append((env.sim.ctrl.clone(), env.actuation.memory()["past"].clone()))

        times = [clock.seconds(whole)]
        for other in others:
            other.begin(state)
            times.append(clock.seconds(lambda other=other, targets=targets: [other.step(target) for target in targets]))
        for values, seconds in zip(series, times, strict=True):
            values.extend([seconds / len(inputs)] if block else [])
    return series


def share_of(label: str) -> str:
    """Return the part of a step to which a label belongs."""
    outer, inner = label.split(" > ")[0], label.split(" > ")[-1]
    if outer in ("begin", "read again"):
        return "reset"
    return inner if inner in PARTS else "logic"


@contextmanager
def stamped(env: TouchEnv) -> Iterator[Stamps]:
    """Record the parts of each step; graphs are captured again."""
    stamps, sim = Stamps(env.device), env.sim
    advance, read, begin = env._advance, sim.read, env._begin
    patches: list[tuple[Any, str, Any]] = []

    def patch(owner: Any, name: str, value: Any) -> None:
        patches.append((owner, name, getattr(owner, name)))
        setattr(owner, name, value)

    def whole() -> Any:
        stamps.begin()
        return stamps.within("rest", advance)()

    for owner, name, label in (
        (env, "_commanded", "command"),
        (env, "_now", "touch"),
        (env, "_judged", "judge"),
        (env, "_observed", "observe again"),
        (env.task, "advance", "advance"),
        (env.task, "reset", "task"),
        (sim, "step", "physics"),
        (sim, "reset", "simulator"),
        (sim.properties, "set", "properties"),
        (env, "_restarted", "drives"),
    ):
        patch(owner, name, stamps.within(label, getattr(owner, name)))
    patch(sim, "read", lambda *mask: stamps.within("read again" if mask else "touch", read)(*mask))
    patch(env, "_begin", stamps.within("begin", begin))
    if sim.drive is not None:
        patch(sim, "drive", stamps.within("drive", sim.drive))
    patch(env, "_call", sim.repeated(whole))
    try:
        yield stamps
    finally:
        for owner, name, value in reversed(patches):
            setattr(owner, name, value)


def split(env: TouchEnv, num_steps: int = 30) -> dict[str, float]:
    """Return the mean time of each part of a step [s]."""
    stream, means = actions(env, 1), dict[str, float]()
    with stamped(env) as stamps:
        for i in range(3 + num_steps):
            env.step(next(stream))
            if env.device.type == "cuda":
                torch.cuda.synchronize()
            if i >= 3:
                for label, seconds in stamps.durations().items():
                    inner = label.removeprefix("rest > ")
                    means[inner] = means.get(inner, 0.0) + seconds / num_steps
    return means


def used_memory(device: torch.device) -> float:
    """Return the memory in use [MB]: on a GPU by all processes, else the resident memory of this process."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info()
        return (total - free) / 1e6
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def long_run(env: TouchEnv, seconds: float) -> dict[str, float]:
    """Step with random actions for some time; return counts and memory."""
    stream, is_cuda = actions(env, 2), env.device.type == "cuda"
    bad = torch.zeros((), dtype=torch.int64, device=env.device)
    counts = torch.zeros(3, dtype=torch.float64, device=env.device)
    start, steps, early = time.perf_counter(), 0, 0.0
    while (now := time.perf_counter() - start) < seconds:
        if not early and now >= 0.2 * seconds:
            early = used_memory(env.device)
        result = env.step(next(stream))
        info = result.info
        with torch.no_grad():
            for value in (*result.obs.values(), *info.final_obs.values(), result.reward, info.score):
                bad += (~value.isfinite()).sum()
            counts += torch.stack([info.ended.sum(), info.faults.sum(), (info.score * info.ended).sum()])
        steps += 1
        if is_cuda and steps % 20 == 0:
            torch.cuda.synchronize()
    if is_cuda:
        torch.cuda.synchronize()
    elapsed, (ended, faults, score) = time.perf_counter() - start, counts.tolist()
    if isinstance(env.sim, tgdsl.WarpSimulation):
        env.sim.check()
    return {
        "seconds": elapsed,
        "steps": steps,
        "steps_per_s": steps * env.num_envs / elapsed,
        "not_finite": int(bad),
        "ended": ended,
        "faults": faults,
        "score_of_ended": score / max(ended, 1.0),
        "memory_early_mb": early,
        "memory_end_mb": used_memory(env.device),
    }


def times_of(options: argparse.Namespace, env: TouchEnv, task: Path, cone: str) -> dict[str, Any]:
    """Return the median times of a step, and of physics and module alone."""
    others = [environments(options, task, cone) for _ in range(2)]
    blocks = compare(options, env, [Alone(others[0], False), Alone(others[1], True)])
    for other in others:
        other.close()
    whole, *alone = (statistics.median(times) for times in blocks)
    row: dict[str, Any] = {"step_ms": 1e3 * whole, "steps_per_s": env.num_envs / whole, "blocks": blocks}
    for name, seconds in zip(("", "_ideal"), alone, strict=True):
        row |= {f"alone{name}_ms": 1e3 * seconds, f"ratio{name}": whole / seconds}
    return row


def measure(options: argparse.Namespace, task: Path, cone: str) -> dict[str, Any]:
    """Return the row of a task with a friction cone."""
    start = time.perf_counter()
    env = environments(options, task, cone)
    stream = actions(env)
    for _ in range(3):
        env.step(next(stream))
    if env.device.type == "cuda":
        torch.cuda.synchronize()
    row: dict[str, Any] = {"task": task.stem, "cone": cone, "envs": env.num_envs, "first_s": time.perf_counter() - start}
    for _ in range(options.warm):
        env.step(next(stream))
    if options.blocks:
        row |= times_of(options, env, task, cone)
        parts = split(env)
        total = sum(parts.values())
        row["parts_ms"] = {label: 1e3 * seconds for label, seconds in parts.items()}
        row |= {f"{part}_%": 100.0 * sum(t for name, t in parts.items() if share_of(name) == part) / total for part in PARTS}
    if options.seconds:
        row["long"] = long_run(env, options.seconds)
    env.close()
    return row


TIMES = ("first_s", "step_ms", "alone_ms", "alone_ideal_ms", "ratio", "ratio_ideal", "steps_per_s")
COLUMNS = ("task", "cone", "envs", *TIMES, *(f"{part}_%" for part in PARTS))


def text(row: dict[str, Any]) -> str:
    """Return a row as text."""
    cells = {name: row[name] for name in COLUMNS if name in row}
    lines = ["  ".join(f"{name} {cell:.4g}" if isinstance(cell, float) else f"{name} {cell}" for name, cell in cells.items())]
    if "parts_ms" in row:
        lines += ["  parts [ms]: " + ", ".join(f"{label} {ms:.3f}" for label, ms in row["parts_ms"].items())]
    if "long" in row:
        lines += ["  long: " + ", ".join(f"{name} {value:.6g}" for name, value in row["long"].items())]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", type=Path, help="task documents; default: all of examples/tasks")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--threads", type=int, default=2, help="of physics and torch, on the CPU")
    parser.add_argument("--torch-threads", type=int, help="of torch alone: several compete with those of physics")
    parser.add_argument("--cpu-time", action="store_true", help="measure CPU time, which other processes disturb less")
    parser.add_argument("--compiled", action="store_true", help="compile module and logic on a CPU too, alone and in the step")
    parser.add_argument("--cones", nargs="+", default=["elliptic", "pyramidal"])
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="change the documents")
    parser.add_argument("--blocks", type=int, default=20, help="0 leaves times out")
    parser.add_argument("--steps", type=int, default=20, help="control steps of a block")
    parser.add_argument("--warm", type=int, default=WARM_STEPS, help="control steps before timing")
    parser.add_argument("--seconds", type=float, default=0.0, help="duration of the long run")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(options.torch_threads or options.threads)
    tasks = options.tasks or sorted(file for file in TASKS.glob("*.yaml") if "\ntask:" in file.read_text(encoding="utf-8"))
    rows = []
    for task in tasks:
        for cone in options.cones:
            rows.append(measure(options, task, cone))
            print(text(rows[-1]), flush=True)
            if options.out:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                options.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
