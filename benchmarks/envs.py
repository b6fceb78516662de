"""What a step of a task's environments takes: against physics and module alone, its parts, and whether it goes on for long.

    python benchmarks/envs.py                                                    # all tasks of examples/tasks, on the CPU
    python benchmarks/envs.py --device cuda --envs 8192 --seconds 100 --out out/envs
    python benchmarks/envs.py examples/tasks/in_palm_rotate.yaml --cones pyramidal --set randomise.drive={}

Actions are random, episodes begin again as they end. Of each task and friction cone:

- `ratio`: `TouchEnv.step` over the same physics and the same module alone (on a GPU `sim.step_and_read`, else `sim.step` and
  the module), from the same states and with the same targets of the same drives; `ratio_ideal`: without drives, with the
  robot's own actuators. Blocks alternate; medians of all blocks.
- shares of a step, in percent: physics with the `drive`s, `touch` with what is watched, `logic` (actions, pushes, rewards,
  observations), `reset` (what begins episodes and reads them). On a GPU from events within its CUDA graph.
- `--seconds`: goes on that long; counts what is no number, faults, ended episodes, and the memory after a fifth and at the end.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import tgdsl
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task

TASKS = Path(__file__).parents[1] / "examples" / "tasks"
WARM_STEPS = 100
"""Steps before anything is timed: objects have come to rest on the palm, graphs are captured."""
PARTS = ("physics", "drive", "touch", "logic", "reset")


class Clock:
    """Times work on the CPU, by the wall or what all threads of this process take, or on a GPU by events."""

    def __init__(self, device: torch.device, is_cpu_time: bool = False):
        self._is_cuda = device.type == "cuda"
        self._now = time.process_time if is_cpu_time else time.perf_counter

    def seconds(self, work: Callable[[], object]) -> float:
        """Return what work takes [s]."""
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
    """Notes when parts of a step begin and end: on the CPU by its clock, on a GPU by events in the captured graph."""

    def __init__(self, device: torch.device):
        self._is_cuda = device.type == "cuda"
        self._open: list[str] = []
        self.labels: list[str] = []
        self.stamps: list[Any] = []

    def begin(self) -> None:
        """Forget the last step."""
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
        """Return a method that notes when it begins and ends."""

        def noted(*args: Any, **kwargs: Any) -> Any:
            self._open.append(label)
            self._stamp()
            try:
                return method(*args, **kwargs)
            finally:
                self._open.pop()
                self._stamp()

        return noted

    def durations(self) -> dict[str, float]:
        """Return how long the innermost parts have taken [s], by labels from the outside in."""
        found: dict[str, float] = {}
        pairs = zip(self.stamps, self.stamps[1:], strict=False)
        for label, (first, last) in zip(self.labels, pairs, strict=False):
            took = first.elapsed_time(last) / 1e3 if self._is_cuda else last - first
            found[label] = found.get(label, 0.0) + took
        return found


def actions(env: TouchEnv, seed: int = 0) -> Iterator[Tensor]:
    """Yield random actions, from −1 to 1, the same 64 over and over."""
    generator = torch.Generator(env.device).manual_seed(seed)
    made = 2.0 * torch.rand((64, env.num_envs, env.num_actions), generator=generator, device=env.device) - 1.0
    while True:
        yield from made


def make(options: argparse.Namespace, task: Path, cone: str, **overrides: Any) -> TouchEnv:
    """Return environments of a task, in the midst of their episodes."""
    given = dict(entry.split("=", 1) for entry in options.set) | {"physics.cone": cone} | overrides
    made = TouchEnv(
        load_task(task, given),
        options.envs,
        device=options.device,
        seed=options.seed,
        threads=options.threads,
        simulator=options.simulator,
        compiled=options.compiled or None,
    )
    made.steps.copy_(torch.arange(options.envs) * made.max_steps // options.envs)
    return made


class Alone:
    """The physics and the module of environments, with nothing else of them."""

    def __init__(self, env: TouchEnv, is_ideal: bool):
        """Take environments; `is_ideal`: the robot's own actuators are to do all."""
        self._env, self._is_ideal = env, is_ideal or env.actuation.is_ideal
        if self._is_ideal:
            env.sim.drive = None

    def begin(self, state: dict[str, dict[str, Tensor]]) -> None:
        """Go on from the state of other environments of the same task."""
        self._env.load_state_dict(state)
        if self._is_ideal:
            self._env.sim.arrays["qfrc_applied"].zero_()

    def step(self, targets: tuple[Tensor, Tensor]) -> object:
        """Make a control step with controls or, where there are drives, their targets."""
        env, (controls, past) = self._env, targets
        if not self._is_ideal:
            env.actuation.memory()["past"].copy_(past)
        if env.device.type == "cuda":
            return env.sim.step_and_read(controls if self._is_ideal else None)  # type: ignore[union-attr]
        with torch.no_grad():
            env.sim.step(controls if self._is_ideal else None)
            return env.touch(env.sim.state())


def compare(options: argparse.Namespace, env: TouchEnv, others: list[Alone]) -> list[list[float]]:
    """Return what a step takes in each block, of the environments, and of physics and module alone [s]."""
    clock, given, length = Clock(env.device, options.cpu_time), actions(env), options.steps
    taken: list[list[float]] = [[] for _ in range(1 + len(others))]
    for block in range(1 + options.blocks):  # in the first of them all is captured
        state, targets, chosen = env.state_dict(), [], [next(given) for _ in range(max(length, 3))]

        def whole(chosen: list[Tensor] = chosen, targets: list[Any] = targets) -> None:
            for action in chosen:
                env.step(action)
                targets.append((env.sim.ctrl.clone(), env.actuation.memory()["past"].clone()))

        times = [clock.seconds(whole)]
        for other in others:
            other.begin(state)
            times.append(clock.seconds(lambda other=other, targets=targets: [other.step(target) for target in targets]))
        for own, took in zip(taken, times, strict=True):
            own.extend([took / len(chosen)] if block else [])
    return taken


def share_of(label: str) -> str:
    """Return the part of a step that a label's duration counts for."""
    outer, inner = label.split(" > ")[0], label.split(" > ")[-1]
    if outer in ("begin", "read again"):
        return "reset"
    return inner if inner in PARTS else "logic"


@contextmanager
def stamped(env: TouchEnv) -> Iterator[Stamps]:
    """Have a step note its parts; what was captured is captured again."""
    stamps, sim = Stamps(env.device), env.sim
    advance, read, began = env._advance, sim.read, env._begin
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
    patch(env, "_begin", stamps.within("begin", began))
    if sim.drive is not None:
        patch(sim, "drive", stamps.within("drive", sim.drive))
    patch(env, "_call", sim.repeated(whole))
    try:
        yield stamps
    finally:
        for owner, name, value in reversed(patches):
            setattr(owner, name, value)


def split(env: TouchEnv, num_steps: int = 30) -> dict[str, float]:
    """Return how long each part of a step takes [s], the mean of some steps."""
    given, sums = actions(env, 1), dict[str, float]()
    with stamped(env) as stamps:
        for i in range(3 + num_steps):
            env.step(next(given))
            if env.device.type == "cuda":
                torch.cuda.synchronize()
            if i >= 3:
                for label, took in stamps.durations().items():
                    inner = label.removeprefix("rest > ")
                    sums[inner] = sums.get(inner, 0.0) + took / num_steps
    return sums


def used_memory(device: torch.device) -> float:
    """Return what memory is used [MB]: on a GPU by all its processes, else by this one."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info()
        return (total - free) / 1e6
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def go_on(env: TouchEnv, seconds: float) -> dict[str, float]:
    """Step for some time with random actions, and return what was counted."""
    given, is_cuda = actions(env, 2), env.device.type == "cuda"
    bad = torch.zeros((), dtype=torch.int64, device=env.device)
    counts = torch.zeros(3, dtype=torch.float64, device=env.device)
    start, steps, early = time.perf_counter(), 0, 0.0
    while (now := time.perf_counter() - start) < seconds:
        if not early and now >= 0.2 * seconds:
            early = used_memory(env.device)
        made = env.step(next(given))
        with torch.no_grad():
            for value in (*made.obs.values(), *made.info.final_obs.values(), made.reward, made.info.score):
                bad += (~value.isfinite()).sum()
            counts += torch.stack([made.info.ended.sum(), made.info.faults.sum(), (made.info.score * made.info.ended).sum()])
        steps += 1
        if is_cuda and steps % 20 == 0:
            torch.cuda.synchronize()
    if is_cuda:
        torch.cuda.synchronize()
    took, (ended, faults, score) = time.perf_counter() - start, counts.tolist()
    if isinstance(env.sim, tgdsl.WarpSimulation):
        env.sim.check()
    return {
        "seconds": took,
        "steps": steps,
        "steps_per_s": steps * env.num_envs / took,
        "not_finite": int(bad),
        "ended": ended,
        "faults": faults,
        "score_of_ended": score / max(ended, 1.0),
        "memory_early_mb": early,
        "memory_end_mb": used_memory(env.device),
    }


def times_of(options: argparse.Namespace, env: TouchEnv, task: Path, cone: str) -> dict[str, Any]:
    """Return the medians of what a step takes, with and without what is not physics and module."""
    plain = [make(options, task, cone) for _ in range(2 if options.alone else 0)]
    others = [Alone(own, is_ideal) for own, is_ideal in zip(plain, (False, True), strict=False)]
    blocks = compare(options, env, others)
    for own in plain:
        own.close()
    whole, *alone = (statistics.median(times) for times in blocks)
    found: dict[str, Any] = {"step_ms": 1e3 * whole, "steps_per_s": env.num_envs / whole, "blocks": blocks}
    for name, took in zip(("", "_ideal"), alone, strict=False):
        found |= {f"alone{name}_ms": 1e3 * took, f"ratio{name}": whole / took}
    return found


def measure(options: argparse.Namespace, task: Path, cone: str) -> dict[str, Any]:
    """Return all that is measured of a task with a friction cone."""
    start = time.perf_counter()
    env = make(options, task, cone)
    given = actions(env)
    for _ in range(3):
        env.step(next(given))
    Clock(env.device).seconds(lambda: None)
    row: dict[str, Any] = {"task": task.stem, "cone": cone, "envs": env.num_envs, "first_s": time.perf_counter() - start}
    for _ in range(options.warm):
        env.step(next(given))
    if options.blocks:
        row |= times_of(options, env, task, cone)
        parts = split(env)
        total = sum(parts.values())
        row["parts_ms"] = {label: 1e3 * took for label, took in parts.items()}
        row |= {f"{part}_%": 100.0 * sum(t for name, t in parts.items() if share_of(name) == part) / total for part in PARTS}
    if options.seconds:
        row["long"] = go_on(env, options.seconds)
    env.close()
    return row


TIMES = ("first_s", "step_ms", "alone_ms", "alone_ideal_ms", "ratio", "ratio_ideal", "steps_per_s")
COLUMNS = ("task", "cone", "envs", *TIMES, *(f"{part}_%" for part in PARTS))


def told(row: dict[str, Any]) -> str:
    """Return a row as text."""
    known = {name: row[name] for name in COLUMNS if name in row}
    lines = ["  ".join(f"{name} {cell:.4g}" if isinstance(cell, float) else f"{name} {cell}" for name, cell in known.items())]
    if "parts_ms" in row:
        lines += ["  parts [ms]: " + ", ".join(f"{label} {took:.3f}" for label, took in row["parts_ms"].items())]
    if "long" in row:
        lines += ["  long: " + ", ".join(f"{name} {value:.6g}" for name, value in row["long"].items())]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", type=Path, help="documents of tasks; default: all of examples/tasks")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--simulator", choices=("mujoco", "warp"))
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--threads", type=int, default=2, help="of physics and torch, on the CPU")
    parser.add_argument("--torch-threads", type=int, help="of torch alone: more than one are in the way of physics")
    parser.add_argument("--cpu-time", action="store_true", help="of this process, which others disturb less")
    parser.add_argument("--compiled", action="store_true", help="compile module and logic on a CPU too, alone and in the step")
    parser.add_argument("--cones", nargs="+", default=["elliptic", "pyramidal"])
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="of the documents")
    parser.add_argument("--blocks", type=int, default=20, help="0: time nothing")
    parser.add_argument("--alone", action=argparse.BooleanOptionalAction, default=True, help="time physics and module alone")
    parser.add_argument("--steps", type=int, default=20, help="control steps of a block")
    parser.add_argument("--warm", type=int, default=WARM_STEPS, help="control steps before anything is timed")
    parser.add_argument("--seconds", type=float, default=0.0, help="how long to go on afterwards")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="writes OUT.json and OUT.csv")
    options = parser.parse_args()
    torch.set_num_threads(options.torch_threads or options.threads)
    tasks = options.tasks or sorted(file for file in TASKS.glob("*.yaml") if "\ntask:" in file.read_text(encoding="utf-8"))
    rows = []
    for task in tasks:
        for cone in options.cones:
            rows.append(measure(options, task, cone))
            print(told(rows[-1]), flush=True)
            if options.out:
                write(options.out, rows)


def write(out: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows beside a name: everything as JSON, the table as CSV."""
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    with out.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
