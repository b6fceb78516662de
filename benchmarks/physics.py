"""Measure the cost of touch in a control step: MuJoCo Warp steps thousands of environments, and a module reads them.

    python benchmarks/physics.py artefacts out/physics                                # on any machine with tgdsl
    python benchmarks/physics.py run out/physics --out out/physics.json --jobs 8      # on the machine with the GPU
    python benchmarks/physics.py run out/physics --out out/physics.json --profile --scenes hand-med --modules elastomer
    python benchmarks/physics.py plot out/physics.json --out docs/images/physics.png

Scenes: the pyramid of ten cubes (examples/pyramid.yaml) and the XHand1 with a cube (examples/xhand1_palm.yaml) at 199 and 667
taxels, with an elliptic or a pyramidal cone. `run` needs only torch, MuJoCo Warp and the dependencies of `tgdsl.load`. Each
module of a scene runs in a separate process, `--jobs` at once, and processes take turns on the GPU: see turns.py. Rows are
printed and written as processes end.

A scene is first stepped without sensors, and some states are saved. From each of them, control steps with and without touch
are timed alternately, so that physics does the same work. Times are medians by CUDA events: `plain` is the step without
sensors, `step` the same with touch in the same CUDA graph, `module` a graph of the module alone on that state, and `read` a
graph that gathers the state too. `--profile` also lists the kernels of `module`, the longest first.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import torch
import turns
from physics_scenes import MODULES, PLAIN, SCENES, Scene, artefact, make_artefacts
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.warp import WarpSimulation
from tgdsl.scene.scene import scene_model

INSTANTS = 4
"""Saved states per scene."""


@dataclass(frozen=True)
class Row:
    """A module at one number of environments; times of a control step [ms]."""

    scene: str
    module: str
    num_envs: int
    substeps: int
    num_taxels: int
    plain: float
    step: float
    module_alone: float
    read: float
    contacts: float
    fault: str = ""

    def line(self) -> str:
        """Return the row as text."""
        rate, share = 1e3 * self.num_envs / self.step, (self.step - self.plain) / self.step
        times = f"{self.plain:9.3f}{self.step:9.3f}{self.read:9.4f}{self.module_alone:9.4f}"
        shares = f"{share:8.1%}{self.module_alone / self.step:8.2%}"
        return f"  {self.num_envs:>6} {self.module:<28}{times}{rate:13,.0f}{shares}{self.contacts:10.1f}  {self.fault}"


HEAD = (
    f"  {'envs':>6} {'module':<28}{'plain':>9}{'step':>9}{'read':>9}{'module':>9}{'env-steps/s':>13}{'share':>8}{'module':>8}"
)


class Instants:
    """Saved states along a run of a scene without sensors, from which steps are timed."""

    FIELDS = ("time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl")

    def __init__(self, sim: WarpSimulation, scene: Scene):
        """Step the scene and save states: of the hand along a squeeze, of the pyramid while it settles."""
        self._states: list[dict[str, Tensor]] = []
        model, device = sim.model, sim.arrays["qpos"].device
        rest = squeeze = torch.zeros(model.nu, device=device)
        if scene.keyframe is None:
            generator = torch.Generator().manual_seed(0)
            sim.arrays["qvel"].copy_(0.02 * torch.randn(sim.arrays["qvel"].shape, generator=generator))
        else:
            rest, squeeze = (
                torch.tensor(model.key(name).ctrl, dtype=torch.float32, device=device) for name in ("rest", "squeeze")
            )
        strength = torch.linspace(0.3, 1.2, sim.num_envs, device=device)[:, None]
        steps, every = (30, 5) if scene.keyframe is None else (60, 8)
        for i in range(steps + every * INSTANTS):
            sim.step(rest + (squeeze - rest) * strength * min(1.0, i / steps))
            if i >= steps and (i - steps) % every == 0:
                self._states.append({name: sim.arrays[name].clone() for name in self.FIELDS})
        if fault := fault_of(sim):
            print(f"  {sim.num_envs} environments, while settling: {fault}")

    def restore(self, i: int, sim: WarpSimulation) -> None:
        """Put environments into a saved state."""
        for name, value in self._states[i].items():
            sim.arrays[name].copy_(value)


def interval(call: Callable[[], Any], device: torch.device) -> Callable[[], float]:
    """Start a call; return a function that returns its time [ms] once the device is idle."""
    if device.type == "cpu":
        start = time.perf_counter()
        call()
        elapsed = 1e3 * (time.perf_counter() - start)
        return lambda: elapsed
    events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
    events[0].record()
    call()
    events[1].record()
    return lambda: events[0].elapsed_time(events[1])


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def replayed(call: Callable[[], Any], device: torch.device) -> Callable[[], Any]:
    """Return the replay of a call captured in a CUDA graph; on a CPU the call."""
    if device.type == "cpu":
        return call
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    gc.collect()
    gc.disable()  # freeing one of Warp's arrays would break the capture
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            call()
    finally:
        gc.enable()
    return lambda _inputs=call: graph.replay()  # the graph reads their memory, so they must live as long


def median_of(call: Callable[[], Any], repeats: int, device: torch.device, batch: int = 10) -> float:
    """Return the median time of a call [ms] over batches of calls."""

    def calls() -> None:
        for _ in range(batch):
            call()

    calls()
    times = [interval(calls, device) for _ in range(repeats)]
    synchronize(device)
    return statistics.median(elapsed() for elapsed in times) / batch


def paired(plain: WarpSimulation, sim: WarpSimulation, instants: Instants, repeats: int) -> tuple[float, float]:
    """Return the median times [ms] of steps without and with sensors, which alternate from the same states."""
    times: tuple[list[Callable[[], float]], list[Callable[[], float]]] = ([], [])
    device = sim.arrays["qpos"].device
    for simulator, call in ((plain, plain.step), (sim, sim.step_and_read)):
        for _ in range(5):  # the first call allocates the module's memory, and the graph is captured two calls later
            instants.restore(0, simulator)
            call()
    for _ in range(repeats):
        for i in range(INSTANTS):
            for simulator, call, series in ((plain, plain.step, times[0]), (sim, sim.step_and_read, times[1])):
                instants.restore(i, simulator)
                series.append(interval(call, device))
    synchronize(device)
    first, second = (statistics.median(elapsed() for elapsed in series) for series in times)
    return first, second


def profiled(call: Callable[[], Any], device: torch.device, calls: int = 5, most: int = 30) -> str:
    """Return a table of a call's kernels: total time [ms], number of launches, and name."""
    on_gpu = device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]) as profiler:
        for _ in range(calls):
            call()
        synchronize(device)
    rows = [(e.self_device_time_total if on_gpu else e.self_cpu_time_total, e.count, e.key) for e in profiler.key_averages()]
    rows = sorted((row for row in rows if row[0] > 0), reverse=True)
    times = [f"{time / 1e3 / calls:14.4f}{count / calls:7.1f}  {name[:100]}" for time, count, name in rows[:most]]
    total = f"{sum(row[0] for row in rows) / 1e3 / calls:14.4f}{sum(row[1] for row in rows) / calls:7.1f}  in all"
    return "\n".join([total, *times])


def simulation(touch: TactileModule, scene: Scene, num_envs: int, options: argparse.Namespace) -> WarpSimulation:
    """Return environments of a scene; they do not poll for faults, which would disturb the timing: see `fault_of`."""
    model = scene_model(touch.plan.scene)
    if scene.is_pyramidal:
        model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    keys: dict[str, Any] = {"nconmax": scene.nconmax, "njmax": scene.njmax, "graph": not options.eager}
    keys |= {"substeps": scene.substeps, "keyframe": scene.keyframe, "model": model, "device": options.device}
    sim = WarpSimulation(touch, num_envs, **keys)
    sim._faults.polled = lambda: (False, [])
    return sim


def fault_of(sim: WarpSimulation) -> str:
    """Return the message of a fault so far, or nothing."""
    try:
        sim.check()
    except SimulationError as error:
        return str(error)
    return ""


def compiled_module(scene: Scene, module: str, options: argparse.Namespace) -> TactileModule:
    """Return a module compiled for the largest number of environments; this process has the turn then."""
    turn = turns.Turn(options.turn)
    turn.take()
    touch = tgdsl.load(artefact(options.folder, scene, module), device=options.device)
    if options.eager:
        return touch
    sim = simulation(touch, scene, max(options.envs), options)
    sim.step()
    state = sim.state()
    del sim
    free_memory(options)
    turn.give_back()
    turn.compile(touch)
    with torch.no_grad():
        touch(state)
    return touch


def free_memory(options: argparse.Namespace) -> None:
    """Free unused memory on the GPU for other processes."""
    gc.collect()
    if options.device != "cpu":
        torch.cuda.empty_cache()


def measure(name: str, module: str, compiled: TactileModule, num_envs: int, options: argparse.Namespace) -> Row:
    """Time a module at one number of environments."""
    scene, device = SCENES[name], torch.device(options.device)
    unread, touch = (tgdsl.load(artefact(options.folder, scene, file), device=options.device) for file in (PLAIN, module))
    plain = simulation(unread, scene, num_envs, options)
    instants = Instants(plain, scene)
    touch.calls.compiled = compiled.calls.compiled  # code for one number of environments serves all
    sim = simulation(touch, scene, num_envs, options)
    plain_step, step = paired(plain, sim, instants, options.repeats)
    fault = fault_of(sim)
    contacts = int(sim.warp_data.nacon.numpy()[0]) / sim.num_envs
    state = sim.state()
    graph = replayed(lambda: touch(state), device)
    alone = median_of(graph, options.repeats, device)
    if options.profile:
        print(profiled(graph, device), flush=True)
    read = median_of(replayed(lambda: touch(sim.state()), device), options.repeats, device)
    rows = touch.outputs[0].shape[0] if module != "link_contact" else len(touch.taxels["s0"]["link"])
    return Row(name, module, num_envs, scene.substeps, rows, plain_step, step, alone, read, contacts, fault)


def rows_of(name: str, module: str, options: argparse.Namespace) -> Iterator[Row]:
    """Time a module of a scene at each number of environments; report a failure and go on."""
    compiled = compiled_module(SCENES[name], module, options)
    for num_envs in options.envs:
        free_memory(options)
        try:
            with torch.no_grad():
                row = measure(name, module, compiled, num_envs, options)
        except Exception:  # the other numbers of environments are still worth measuring
            print(f"  {num_envs:>6} {module}: FAILED\n{traceback.format_exc()}", flush=True)
        else:
            yield row


def run(options: argparse.Namespace) -> None:
    """Time the modules of scenes and write their rows; report those for which no time is left."""
    if options.child:
        for row in rows_of(options.scenes[0], options.modules[0], options):
            print(row.line(), flush=True)
            write(options.out, [row], {})
        turns.end()
    start, last, left = time.perf_counter(), "", []
    where = torch.cuda.get_device_name() if options.device != "cpu" else "CPU"
    versions = {"torch": torch.__version__, "mujoco": mujoco.__version__, "device": where}
    print(f"torch {torch.__version__}, MuJoCo {mujoco.__version__}, {where}, medians of {options.repeats}", flush=True)
    cases = [(name, module) for name in options.scenes for module in SCENES[name].modules if module in options.modules]
    for (name, module), output, out in turns.children(options, ["--scenes", "--modules"], cases):
        if output is None:
            left.append(f"{name} {module}")
            continue
        if name != last:
            print(f"\n{name}: control steps of {SCENES[name].substeps} physics steps, times [ms], shares of the step\n{HEAD}")
        last = name
        print(output, end="", flush=True)
        if out.exists():
            write(options.out, load_rows(out), versions)
    print(f"{time.perf_counter() - start:.0f} s" + (f"; not measured: {'; '.join(left)}" if left else ""))


def load_rows(path: Path) -> list[Row]:
    return [Row(**row) for row in json.loads(path.read_text())["rows"]]


def write(path: Path, rows: list[Row], versions: dict[str, str]) -> None:
    """Write rows to a JSON file; they replace earlier rows of the same measurements."""
    keys = {(row.scene, row.module, row.num_envs) for row in rows}
    old = [row for row in load_rows(path) if (row.scene, row.module, row.num_envs) not in keys] if path.exists() else []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**versions, "rows": [asdict(row) for row in (*old, *rows)]}, indent=1))


# The plot -------------------------------------------------------------------------------------------------------------------


def plot(options: argparse.Namespace) -> None:
    """Draw throughput and the module's share of a step against environments, one column per scene."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    rows = load_rows(options.results)
    names = [name for name in SCENES if any(row.scene == name for row in rows)]
    figure = Figure(figsize=(4.6 * len(names), 8.2), layout="constrained")
    panels = figure.subplots(2, len(names), squeeze=False)
    colours = [colormaps["tab20"](i) for i in range(len(MODULES))]
    lines: dict[str, Any] = {}
    for column, name in enumerate(names):
        of_scene = [row for row in rows if row.scene == name]
        envs = sorted({row.num_envs for row in of_scene})
        plain = [statistics.median(row.plain for row in of_scene if row.num_envs == n) for n in envs]
        panels[0, column].plot(envs, [1e3 * n / ms for n, ms in zip(envs, plain, strict=True)], "k--", label="no sensors")
        for module, colour in zip(MODULES, colours, strict=True):
            curve = sorted((row for row in of_scene if row.module == module), key=lambda row: row.num_envs)
            x = [row.num_envs for row in curve]
            style = {"color": colour, "marker": "o" if MODULES[module][1] is None else "^", "markersize": 4}
            if curve:
                panels[0, column].plot(x, [1e3 * row.num_envs / row.step for row in curve], label=module, **style)
                panels[1, column].plot(x, [100 * row.module_alone / row.step for row in curve], **style)
        lines |= {line.get_label(): line for line in panels[0, column].get_lines()}
        panels[0, column].set(title=name, xscale="log", yscale="log", ylabel="environments' control steps per second")
        panels[1, column].set(xscale="log", yscale="log", xlabel="environments", ylabel="the module's time, % of the step")
        for panel in panels[:, column]:
            panel.grid(alpha=0.25, which="both")
            panel.set_xticks(envs, [f"{n:,}" for n in envs])
            panel.xaxis.minorticks_off()
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)


def parsed() -> argparse.Namespace:
    """Return the parsed command line, and in `arguments` the command that repeats it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    compiling = commands.add_parser("artefacts", help="compile all modules")
    compiling.add_argument("folder", type=Path)
    compiling.set_defaults(call=lambda options: make_artefacts(options.folder))
    running = commands.add_parser("run", help="time them")
    running.add_argument("folder", type=Path)
    running.add_argument("--out", type=Path, required=True, help="JSON file, in which rows of earlier runs stay")
    running.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    running.add_argument("--modules", nargs="+", choices=MODULES, default=list(MODULES))
    running.add_argument("--envs", nargs="+", type=int, default=[1024, 4096, 8192, 16384], help="code is compiled for the most")
    running.add_argument("--device", default="cuda")
    running.add_argument("--repeats", type=int, default=6, help="timed steps from each saved state")
    running.add_argument("--eager", action="store_true", help="neither compiled modules nor CUDA graphs")
    running.add_argument("--profile", action="store_true", help="list each module's kernels too")
    turns.add_options(running)
    running.set_defaults(call=run)
    drawing = commands.add_parser("plot", help="draw the results")
    drawing.add_argument("results", type=Path)
    drawing.add_argument("--out", type=Path, default=Path("docs/images/physics.png"))
    drawing.set_defaults(call=plot)
    return parser.parse_args(namespace=argparse.Namespace(arguments=sys.argv))


if __name__ == "__main__":
    command = parsed()
    command.call(command)
