"""Physics and touch end to end: MuJoCo Warp steps thousands of environments, the module reads them; what does touch cost?

    python benchmarks/physics.py artefacts out/physics                                # where documents can be compiled
    python benchmarks/physics.py run out/physics --out out/physics.json --jobs 8      # on the machine with the GPU
    python benchmarks/physics.py run out/physics --out out/physics.json --profile --scenes hand-med --modules elastomer
    python benchmarks/physics.py plot out/physics.json --out docs/images/physics.png

Scenes: the pyramid of ten cubes (examples/pyramid.yaml) and the XHand1 with a cube (examples/xhand1_palm.yaml) at 199 and 667
taxels, with its own elliptic cone or a pyramidal one. `run` needs torch, MuJoCo Warp and what `tgdsl.load` needs, no more. Each
module of a scene has a process of its own, `--jobs` of them at once, and they take turns on the GPU: see turns.py. Rows are
printed and written as processes end.

A scene is first stepped without sensors, and some instants are kept. From each of them the module's control step is timed again
and again, alternately with one without sensors: physics does the same work each time. Times are medians by CUDA events:
`plain` is the step without sensors, `step` the same with touch in the same CUDA graph, `module` a graph of the module alone, on
that state, and `read` one that gathers the state too. `--profile` lists the kernels of `module` as well, the longest first.
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

# What is timed --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One module at one number of environments; times [ms] of one control step, None where it could not be measured."""

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
    """States of a scene without sensors along a run, from which steps are timed."""

    KEPT = ("time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl")

    def __init__(self, sim: WarpSimulation, scene: Scene, count: int):
        """Step the scene and keep instants: of the hand along a squeeze, of the pyramid while it settles."""
        self._kept: list[dict[str, Tensor]] = []
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
        for i in range(steps + every * count):
            sim.step(rest + (squeeze - rest) * strength * min(1.0, i / steps))
            if i >= steps and (i - steps) % every == 0:
                self._kept.append({name: sim.arrays[name].clone() for name in self.KEPT})
        if fault := fault_of(sim):
            print(f"  {sim.num_envs} environments, while they settle: {fault}")

    def __len__(self) -> int:
        return len(self._kept)

    def restore(self, i: int, sim: WarpSimulation) -> None:
        """Put environments where they were."""
        for name, value in self._kept[i].items():
            sim.arrays[name].copy_(value)


def interval(call: Callable[[], Any], device: torch.device) -> Callable[[], float]:
    """Start a call; return what gives its time [ms] when all is done."""
    if device.type == "cpu":
        start = time.perf_counter()
        call()
        taken = 1e3 * (time.perf_counter() - start)
        return lambda: taken
    events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
    events[0].record()
    call()
    events[1].record()
    return lambda: events[0].elapsed_time(events[1])


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def replayed(call: Callable[[], Any], device: torch.device) -> Callable[[], Any]:
    """Return a call as a CUDA graph; on a CPU as it is."""
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
    gc.disable()  # to free one of Warp's arrays would break the capture
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            call()
    finally:
        gc.enable()
    return lambda _inputs=call: graph.replay()  # the graph reads their memory, so they must live as long


def median_of(call: Callable[[], Any], repeats: int, device: torch.device, batch: int = 10) -> float:
    """Return the median time of a call [ms], of batches of them."""

    def calls() -> None:
        for _ in range(batch):
            call()

    calls()
    times = [interval(calls, device) for _ in range(repeats)]
    synchronize(device)
    return statistics.median(taken() for taken in times) / batch


def paired(plain: WarpSimulation, sim: WarpSimulation, instants: Instants, repeats: int) -> tuple[float, float]:
    """Return the median times [ms] of a step without sensors and of one with them, taken in turn from the same instants."""
    times: tuple[list[Callable[[], float]], list[Callable[[], float]]] = ([], [])
    device = sim.arrays["qpos"].device
    for own, call in ((plain, plain.step), (sim, sim.step_and_read)):
        for _ in range(5):  # what the module remembers is made at the first, and the graph is captured two calls after that
            instants.restore(0, own)
            call()
    for _ in range(repeats):
        for i in range(len(instants)):
            for own, call, kept in ((plain, plain.step, times[0]), (sim, sim.step_and_read, times[1])):
                instants.restore(i, own)
                kept.append(interval(call, device))
    synchronize(device)
    first, second = (statistics.median(taken() for taken in own) for own in times)
    return first, second


def profiled(call: Callable[[], Any], device: torch.device, calls: int = 5, most: int = 30) -> str:
    """Return the kernels of a call as text: time of each in a call [ms], how often it runs, and its name."""
    on_gpu = device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]) as found:
        for _ in range(calls):
            call()
        synchronize(device)
    rows = [(e.self_device_time_total if on_gpu else e.self_cpu_time_total, e.count, e.key) for e in found.key_averages()]
    rows = sorted((row for row in rows if row[0] > 0), reverse=True)
    times = [f"{time / 1e3 / calls:14.4f}{count / calls:7.1f}  {name[:100]}" for time, count, name in rows[:most]]
    total = f"{sum(row[0] for row in rows) / 1e3 / calls:14.4f}{sum(row[1] for row in rows) / calls:7.1f}  in all"
    return "\n".join([total, *times])


def simulation(touch: TactileModule, scene: Scene, num_envs: int, options: argparse.Namespace) -> WarpSimulation:
    """Return environments of a scene; what goes wrong is asked for in the end, so that it does not disturb the timing."""
    model = scene_model(touch.plan.scene)
    if scene.is_pyramidal:
        model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    keys: dict[str, Any] = {"nconmax": scene.nconmax, "njmax": scene.njmax, "graph": not options.eager}
    keys |= {"substeps": scene.substeps, "keyframe": scene.keyframe, "model": model, "device": options.device}
    sim = WarpSimulation(touch, num_envs, **keys)
    if options.native_ccd:
        sim.warp_model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    sim._faults.polled = lambda: (False, [])
    return sim


def fault_of(sim: WarpSimulation) -> str:
    """Return what has gone wrong, in words."""
    try:
        sim.check()
    except SimulationError as error:
        return str(error)
    return ""


def compiled_module(scene: Scene, module: str, options: argparse.Namespace) -> TactileModule:
    """Return a module whose code is compiled, for the most environments, and which has the turn."""
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
    """Free what nothing refers to: others need the memory."""
    gc.collect()
    if options.device != "cpu":
        torch.cuda.empty_cache()


def measure(name: str, module: str, compiled: TactileModule, num_envs: int, options: argparse.Namespace) -> Row:
    """Time one module on so many environments."""
    scene, device = SCENES[name], torch.device(options.device)
    nothing, touch = (tgdsl.load(artefact(options.folder, scene, own), device=options.device) for own in (PLAIN, module))
    plain = simulation(nothing, scene, num_envs, options)
    instants = Instants(plain, scene, options.instants)
    touch.calls.compiled = compiled.calls.compiled  # code for one number of environments serves for all
    sim = simulation(touch, scene, num_envs, options)
    before, step = paired(plain, sim, instants, options.repeats)
    fault = fault_of(sim)
    contacts = int(sim.warp_data.nacon.numpy()[0]) / sim.num_envs
    state = sim.state()
    graph = replayed(lambda: touch(state), device)
    alone = median_of(graph, options.repeats, device)
    if options.profile:
        print(profiled(graph, device), flush=True)
    read = median_of(replayed(lambda: touch(sim.state()), device), options.repeats, device)
    rows = touch.outputs[0].shape[0] if module != "link_contact" else len(touch.taxels["s0"]["link"])
    return Row(name, module, num_envs, scene.substeps, rows, before, step, alone, read, contacts, fault)


def rows_of(name: str, module: str, options: argparse.Namespace) -> Iterator[Row]:
    """Time one module of a scene at each number of environments; one that fails is reported, and the others go on."""
    compiled = compiled_module(SCENES[name], module, options)
    for num_envs in options.envs:
        free_memory(options)
        try:
            with torch.no_grad():
                row = measure(name, module, compiled, num_envs, options)
        except Exception:  # of one number: the others are wanted all the same
            print(f"  {num_envs:>6} {module}: FAILED\n{traceback.format_exc()}", flush=True)
        else:
            yield row


def run(options: argparse.Namespace) -> None:
    """Time scenes' modules and write what was measured; stop in time and say what is left."""
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
    for (name, module), said, out in turns.children(options, ["--scenes", "--modules"], cases):
        if said is None:
            left.append(f"{name} {module}")
            continue
        if name != last:
            print(f"\n{name}: control steps of {SCENES[name].substeps} physics steps, times [ms], shares of the step\n{HEAD}")
        last = name
        print(said, end="", flush=True)
        if out.exists():
            write(options.out, load_rows(out), versions)
    print(f"{time.perf_counter() - start:.0f} s" + (f"; not measured: {'; '.join(left)}" if left else ""))


def load_rows(path: Path) -> list[Row]:
    return [Row(**row) for row in json.loads(path.read_text())["rows"]]


def write(path: Path, rows: list[Row], versions: dict[str, str]) -> None:
    """Write rows to a JSON file, in the place of those of the same measurements that it holds."""
    done = {(row.scene, row.module, row.num_envs) for row in rows}
    kept = [row for row in load_rows(path) if (row.scene, row.module, row.num_envs) not in done] if path.exists() else []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**versions, "rows": [asdict(row) for row in (*kept, *rows)]}, indent=1))


# The plot -------------------------------------------------------------------------------------------------------------------


def plot(options: argparse.Namespace) -> None:
    """Draw throughput against environments, and what touch adds to a step, one column per scene."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    rows = load_rows(options.results)
    names = [name for name in SCENES if any(row.scene == name for row in rows)]
    figure = Figure(figsize=(4.6 * len(names), 8.2), layout="constrained")
    panels = figure.subplots(2, len(names), squeeze=False)
    colours = [colormaps["tab20"](i) for i in range(len(MODULES))]
    lines: dict[str, Any] = {}
    for column, name in enumerate(names):
        own = [row for row in rows if row.scene == name]
        envs = sorted({row.num_envs for row in own})
        plain = [statistics.median(row.plain for row in own if row.num_envs == n) for n in envs]
        panels[0, column].plot(envs, [1e3 * n / ms for n, ms in zip(envs, plain, strict=True)], "k--", label="no sensors")
        for module, colour in zip(MODULES, colours, strict=True):
            found = sorted((row for row in own if row.module == module), key=lambda row: row.num_envs)
            if not found:
                continue
            at = [row.num_envs for row in found]
            style = {"color": colour, "marker": "o" if MODULES[module][1] is None else "^", "markersize": 4}
            panels[0, column].plot(at, [1e3 * row.num_envs / row.step for row in found], label=module, **style)
            panels[1, column].plot(at, [100 * row.module_alone / row.step for row in found], **style)
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
    """Return the command line, and in `arguments` what begins it again."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("artefacts", help="compile all modules")
    making.add_argument("folder", type=Path)
    making.set_defaults(call=lambda options: make_artefacts(options.folder))
    running = commands.add_parser("run", help="time them")
    running.add_argument("folder", type=Path)
    running.add_argument("--out", type=Path, required=True, help="JSON file; rows of an earlier run are kept")
    running.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    running.add_argument("--modules", nargs="+", choices=MODULES, default=list(MODULES))
    running.add_argument("--envs", nargs="+", type=int, default=[1024, 4096, 8192, 16384], help="code is for the most")
    running.add_argument("--device", default="cuda")
    running.add_argument("--repeats", type=int, default=6, help="timed steps from each instant")
    running.add_argument("--instants", type=int, default=4)
    running.add_argument("--eager", action="store_true", help="neither compiled modules nor CUDA graphs")
    running.add_argument("--native-ccd", action="store_true", help="boxes meet by MuJoCo Warp's own way, not by MuJoCo's")
    running.add_argument("--profile", action="store_true", help="list each module's kernels too")
    turns.add_options(running)
    running.set_defaults(call=run)
    drawing = commands.add_parser("plot", help="draw what was measured")
    drawing.add_argument("results", type=Path)
    drawing.add_argument("--out", type=Path, default=Path("docs/images/physics.png"))
    drawing.set_defaults(call=plot)
    return parser.parse_args(namespace=argparse.Namespace(arguments=sys.argv))


if __name__ == "__main__":
    chosen = parsed()
    chosen.call(chosen)
