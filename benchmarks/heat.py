"""Temperatures: a call on a GPU, conduction on a CPU against Fourier transforms, and whether heat is kept.

    python benchmarks/heat.py artefacts out/heat              # where documents can be compiled
    python benchmarks/heat.py time out/heat --out out/heat.json
    python benchmarks/heat.py table --out out/heat_table.json               # the docs' table, where documents can be compiled
    python benchmarks/heat.py energy out/heat --out out/heat_energy.json
    python benchmarks/heat.py conduction --out out/heat_conduction.json     # on a CPU, one thread

`time` and `energy` need torch and what `tgdsl.load` needs, no more; `--device cpu --eager` tries them out. Five links of
`CELLS` cells; unless a case leaves it out there are a source, radiation, convection, a lag, and contact with five objects of
one temperature that all links feel, of which each link touches one, at random points. `time` replays calls as CUDA graphs, on
so many sets of state that they exceed the GPU's L2 cache, cases in turn; medians. `energy` replays calls whose contacts come
and go, and compares what all store with what the reports say came in, summed in float64, over the heat that was exchanged.
`conduction` sets a step of `exact` beside the paper's: mirror the cells, transform, divide, transform back, crop.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import heat_conduction
import torch
from gpu import DT, Bench, captured, median_ms, num_sets, rotating, synchronize
from gpu_scenes import Case, bytes_of
from torch import Tensor

import tgdsl
from tgdsl.module.artifact import load_plan
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.sensors.temperature_grid.step import HEAT_STEP

LINKS = 5
SIDE = 0.02
"""Edge of a link's and an object's box [m]."""
EXCHANGE: dict[str, Any] = {"source": {"power": 0.5}, "emissivity": "material", "convection": 10.0}
LAG = {"lag": 0.05}
CASES: dict[str, tuple[int, int, dict[str, Any]]] = {
    "all": (2, 5, EXCHANGE | LAG),
    "one object": (2, 1, EXCHANGE | LAG),
    "five sensors": (2, -5, EXCHANGE | LAG),
    "no objects": (2, 0, EXCHANGE | LAG),
    "no lag": (2, 5, EXCHANGE),
    "contact alone": (2, 5, {}),
    "conduction alone": (2, 0, {}),
    "all, 10 × 10 × 10": (10, 5, EXCHANGE | LAG),
    "one object, 10 × 10 × 10": (10, 1, EXCHANGE | LAG),
    "conduction alone, 10 × 10 × 10": (10, 0, {}),
}
"""Cells along each axis, objects (negative: each felt by one link, by a sensor of its own), and what the sensor is given."""
TABLE = ("one object", "five sensors", "all", "one object, 10 × 10 × 10", "conduction alone, 10 × 10 × 10")
"""The cases of `table`."""
CYCLE = 8
"""States that `energy` goes through again and again."""


def document(name: str, folder: Path) -> dict[str, Any]:
    """Return the document of a case, whose scene is written to a folder."""
    cells, num_objects, given = CASES[name]
    links, objects = [f"link{i}" for i in range(LINKS)], [f"object{i}" for i in range(abs(num_objects))]
    box = f'<freejoint/><geom type="box" size="{0.5 * SIDE} {0.5 * SIDE} {0.5 * SIDE}"/>'
    bodies = "".join(f'<body name="{body}">{box}</body>' for body in [*links, *objects])
    model = folder / "scene.xml"
    model.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    sensor = {"kind": "temperature_grid", "cells": [cells] * 3, "material": "silicone", "temperature": 30.0, **given}
    sensors = {"heat": {**sensor, "links": links, "feels": objects}}
    if num_objects < 0:
        pairs = zip(links, objects, strict=True)
        sensors = {f"heat{i}": {**sensor, "links": link, "feels": [own]} for i, (link, own) in enumerate(pairs)}
    return {
        "tgdsl": 1,
        "robot": {"model": str(model)},
        "objects": {own: {"body": own, "material": "steel", "temperature": 60.0} for own in objects},
        "sensors": sensors,
    }


def artefact(folder: Path, name: str) -> Path:
    """Return the file of a case."""
    return folder / f"heat_{name.replace(',', '').replace(' × ', 'x').replace(' ', '_')}.safetensors"


def make_artefacts(options: argparse.Namespace) -> None:
    """Compile all cases."""
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in CASES:
        with TemporaryDirectory() as scratch:
            tgdsl.save(tgdsl.compile(document(name, Path(scratch))), artefact(options.folder, name))


def state_of(touch: TactileModule, num_envs: int, seed: int, share: float = 1.0) -> SceneState:
    """Return a random float32 state on the CPU: each link touches one object, its own if there are five, or none.

    Args:
        touch: The module.
        num_envs: Environments.
        seed: What it follows from.
        share: With which probability a link touches.
    """
    state = touch.example_state(num_envs, seed=seed, dtype=torch.float32, spread=0.4 * SIDE).to("cpu")
    if state.contact_found is None:
        return state
    pairs = touch.inputs.pairs
    few = len({pair.object for pair in pairs}) < LINKS
    meets = torch.tensor([few or pair.link[4:] == pair.object[6:] for pair in pairs])
    touches = torch.rand(num_envs, len(pairs), generator=torch.Generator().manual_seed(seed)) < share
    found = meets & touches
    for name in ("contact_found", "contact_netforce", "contact_force", "contact_torque", "contact_normal", "contact_pos"):
        value = getattr(state, name)
        value.copy_(value * found.reshape(*found.shape, *[1] * (value.ndim - 2)))
    return state


# Times ----------------------------------------------------------------------------------------------------------------------


def benches(options: argparse.Namespace, name: str) -> Bench:
    """Return a case with its compiled code."""
    plan = load_plan(artefact(options.folder, name))
    touch = TactileModule(plan).to(options.device)
    if options.eager:
        return Bench(Case(name, "temperature_grid"), plan, touch.advance, touch.device)
    touch.compile()
    return Bench(Case(name, "temperature_grid"), plan, touch.calls.of(touch.advance), touch.device)


def kernels(call: Callable[[], Any], device: torch.device) -> dict[str, float]:
    """Return what each kernel of a call takes [ms], by name; nothing on a CPU."""
    if device.type != "cuda":
        return {}
    from torch.profiler import ProfilerActivity, profile

    call()
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        for _ in range(3):
            call()
        torch.cuda.synchronize()
    found: dict[str, float] = {}
    for event in seen.events() or ():
        found[event.name] = found.get(event.name, 0.0) + event.device_time_total / 3e3
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def timed_case(options: argparse.Namespace, name: str, num_envs: int) -> tuple[dict[str, Any], Callable[[], None]]:
    """Return what is known of a case, and what replays calls on all of its sets once."""
    bench = benches(options, name)
    touch, size = bench.module(), bytes_of(TactileModule(bench.plan))
    states = [state_of(touch, num_envs, seed).to(options.device) for seed in range(3)]
    for state in states:
        touch(state)
    sets = rotating(bench, touch, states, min(options.sets or 64, num_sets(num_envs * size.held)))
    row = {"case": name, "envs": num_envs, "sets": len(sets), "mb": num_envs * size.moved / 1e6}
    row["kernels"] = kernels(lambda: bench.core(*sets[0]), bench.device)
    return row, captured(lambda: [bench.core(*one) for one in sets], bench.device)


def run_time(options: argparse.Namespace) -> None:
    """Time all cases in turn, and print medians."""
    device, made = torch.device(options.device), []
    with torch.no_grad():
        for name in options.cases or CASES:
            start = time.perf_counter()
            try:
                made.append(timed_case(options, name, options.envs))
            except Exception as error:  # of one case: the others are wanted all the same
                print(f"{name}: {type(error).__name__}: {error}", flush=True)
            else:
                print(f"{name}: ready after {time.perf_counter() - start:.0f} s", flush=True)
        times: list[list[float]] = [[] for _ in made]
        for _ in range(options.repeats):
            for own, (row, replay) in zip(times, made, strict=True):
                own.append(median_ms(replay, 1, device, batch=3) / row["sets"])
    rows = [row | {"ms": statistics.median(own), "times": own} for own, (row, _) in zip(times, made, strict=True)]
    for row in rows:
        of_kernels = row["kernels"]
        print(f"{row['case']:<32}{row['envs']:>7}{row['ms']:>9.4f} ms{row['mb']:>9.1f} MB{len(of_kernels):>4} kernels")
        for name, ms in list(of_kernels.items())[: options.show]:
            print(f"    {ms:.4f} ms  {name[:150]}")
    write(options, {"rows": rows})


def run_table(options: argparse.Namespace) -> None:
    """Time the cases of the docs' table, one after the other, with the kernel of a step and by its definition."""
    device, rows = torch.device(options.device), []
    with torch.no_grad():
        for name in options.cases or TABLE:
            for how in ("kernel", "definition"):
                with chosen(how), TemporaryDirectory() as scratch:
                    options.folder = Path(scratch)
                    tgdsl.save(tgdsl.compile(document(name, options.folder)), artefact(options.folder, name))
                    torch.compiler.reset()
                    start = time.perf_counter()
                    row, replay = timed_case(options, name, options.envs)
                    ready = time.perf_counter() - start
                times = [median_ms(replay, 1, device, batch=3) / row["sets"] for _ in range(options.repeats)]
                of_kernels = {own: ms for own, ms in row["kernels"].items() if ms > 0}
                rows.append(row | {"how": how, "ms": statistics.median(times), "times": times, "kernels": of_kernels})
                told = f"{len(of_kernels):>4} kernels {sum(of_kernels.values()):.4f} ms  ready after {ready:.0f} s"
                print(f"{name:<32}{how:<12}{rows[-1]['ms']:>9.4f} ms{row['mb']:>9.1f} MB{told}", flush=True)
                write(options, {"rows": rows})


@contextmanager
def chosen(how: str) -> Iterator[None]:
    """Have a step take its kernel where it can, or its definition always."""
    condition = HEAT_STEP.condition
    if how == "definition":
        object.__setattr__(HEAT_STEP, "condition", lambda *_: False)
    try:
        yield
    finally:
        object.__setattr__(HEAT_STEP, "condition", condition)


# Energy ---------------------------------------------------------------------------------------------------------------------


def run_energy(options: argparse.Namespace) -> None:
    """Replay calls whose contacts come and go; print what the reports do not explain of what is stored."""
    bench = benches(options, options.case)
    touch, num_envs = bench.module(), options.envs
    states = [state_of(touch, num_envs, seed, share=0.5).to(options.device) for seed in range(CYCLE)]
    with torch.no_grad():
        first = touch(states[0])
        begun = stored(first)
        sets = [
            (tensors, touch.memory.tensors(num_envs, DT, torch.float32, bench.device))
            for tensors, _ in rotating(bench, touch, states, CYCLE)
        ]
        came, moved = torch.zeros_like(begun), torch.zeros_like(begun)

        def cycle() -> Tensor:
            for one in sets:
                readings = bench.core(*one)
                came.add_(gained(readings))
                moved.add_(exchanged(readings))
            return stored(readings)  # pyright: ignore[reportPossiblyUnboundVariable]

        replay, end = replayed(cycle, bench.device)
        came.zero_()
        moved.zero_()
        begun = end().clone()
        start = time.perf_counter()
        for _ in range(options.steps // CYCLE):
            replay()
        synchronize(bench.device)
        took = time.perf_counter() - start
        error = ((end() - begun - came).abs() / moved).cpu()
    whole = float((end() - begun - came).abs().sum() / moved.sum())
    steps = options.steps // CYCLE * CYCLE
    found = {
        "case": options.case,
        "envs": num_envs,
        "steps": steps,
        "seconds": took,
        "largest": float(error.max()),
        "median": float(error.median()),
        "whole": whole,
        "exchanged_joules": float(moved.mean()),
        "stored_joules": float(end().mean()),
        "is_finite": bool(error.isfinite().all()),
    }
    print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in found.items()))
    write(options, found)


def replayed(cycle: Callable[[], Tensor], device: torch.device) -> tuple[Callable[[], Any], Callable[[], Tensor]]:
    """Return what makes a cycle, and what returns what the last one has returned; it was made a few times already."""
    kept: list[Tensor] = []

    def plain() -> None:
        kept[:] = [cycle()]

    if device.type != "cuda":
        plain()
        return plain, lambda: kept[0]
    again = captured(plain, device)
    again()
    return again, lambda: kept[0]


def reports(readings: dict[str, Tensor], name: str) -> list[Tensor]:
    """Return a report of all sensors (env, row, channel), in float64."""
    return [value.double() for key, value in readings.items() if key.endswith(f"/{name}")]


def stored(readings: dict[str, Tensor]) -> Tensor:
    """Return what links and objects store (env,) [J]."""
    links, objects = reports(readings, "heat"), reports(readings, "objects")
    return sum((part[..., 0].sum(dim=1) for part in links), start=torch.zeros(())) + sum(
        part[..., 1].sum(dim=1) for part in objects
    )


def gained(readings: dict[str, Tensor]) -> Tensor:
    """Return what links and objects got from source, radiation and convection (env,) [J]."""
    links, objects = reports(readings, "heat"), reports(readings, "objects")
    own = sum((part[..., 1:4].sum(dim=(1, 2)) for part in links), start=torch.zeros(()))
    return own + sum(part[..., 2:4].sum(dim=(1, 2)) for part in objects)


def exchanged(readings: dict[str, Tensor]) -> Tensor:
    """Return the sum of the magnitudes of all that links and objects got, contact included (env,) [J]."""
    links, objects = reports(readings, "heat"), reports(readings, "objects")
    own = sum((part[..., 1:].abs().sum(dim=(1, 2)) for part in links), start=torch.zeros(()))
    return own + sum(part[..., 2:].abs().sum(dim=(1, 2)) for part in objects)


# Results --------------------------------------------------------------------------------------------------------------------


def run_conduction(options: argparse.Namespace) -> None:
    """Time conduction on a CPU."""
    write(options, {"rows": heat_conduction.timed(options.cells, options.envs, options.repeats)})


def write(options: argparse.Namespace, found: dict[str, Any]) -> None:
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        device = getattr(options, "device", "cpu")
        where = torch.cuda.get_device_name() if device != "cpu" else "CPU"
        options.out.write_text(json.dumps({"device": where, "torch": torch.__version__, **found}, indent=1) + "\n")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    own = commands.add_parser("artefacts")
    own.set_defaults(call=make_artefacts)
    own.add_argument("folder", type=Path)
    for name, call in (("time", run_time), ("energy", run_energy)):
        own = commands.add_parser(name)
        own.set_defaults(call=call)
        own.add_argument("folder", type=Path)
        own.add_argument("--device", default="cuda")
        own.add_argument("--eager", action="store_true", help="leave the modules uncompiled")
        own.add_argument("--envs", type=int, default=16_384 if name == "time" else 1_024)
        own.add_argument("--out", type=Path)
    own.add_argument("--case", choices=CASES, default="all")
    own.add_argument("--steps", type=int, default=100_000)
    own = commands.choices["time"]
    own.add_argument("--cases", nargs="+", choices=CASES)
    own.add_argument("--repeats", type=int, default=30)
    own.add_argument("--sets", type=int, help="sets of buffers at most")
    own.add_argument("--show", type=int, default=6, help="kernels that are listed")
    own = commands.add_parser("table")
    own.set_defaults(call=run_table)
    own.add_argument("--device", default="cuda")
    own.add_argument("--eager", action="store_true", help="leave the modules uncompiled")
    own.add_argument("--envs", type=int, default=16_384)
    own.add_argument("--cases", nargs="+", choices=CASES)
    own.add_argument("--repeats", type=int, default=10)
    own.add_argument("--sets", type=int, help="sets of buffers at most")
    own.add_argument("--out", type=Path)
    own = commands.add_parser("conduction")
    own.set_defaults(call=run_conduction)
    own.add_argument("--cells", nargs="+", type=int, default=[2, 3, 4, 6, 8, 10])
    own.add_argument("--envs", type=int, default=256)
    own.add_argument("--repeats", type=int, default=20)
    own.add_argument("--out", type=Path)
    options = parser.parse_args()
    options.call(options)


if __name__ == "__main__":
    main()
