"""MuJoCo Warp against MuJoCo's batch: do they read the same, does a graph do what its calls do, and is what goes wrong noticed?

    tgdsl compile examples/every_sensor.yaml -o out/every_sensor.safetensors          # where documents can be compiled
    python benchmarks/warp_check.py out/every_sensor.safetensors [--device cuda] [--num-envs 64]

Errors are over the largest magnitude of that channel in the batch; slots of contacts, whose order is free, are summed. What
`force_taxel` could not share out, `missed` and `residual`, are small differences of large forces: printed, and not judged.

- `modules`: float32 states of a squeeze, given to the compiled float32 module where physics is and to an eager float64 one on
  the CPU. 99.9 % of the readings must agree to 1e-5: at an edge between two faces, at the threshold of a contact or where an
  anchor lets go a reading jumps, and float32 may fall on the other side. For the elastomer it is 3e-5: it reads how far the
  skin is dragged, at most some millimetres, as a difference of places of some centimetres.
- `states`: float32 positions and speeds given to both simulators. Poses and velocities must agree to 1e-5. A contact that
  touches by less than a rounding is there in one simulator and not in the other: in 95 % of the environments all contacts must
  be in both. Of these the forces, which are what solvers stop at, must agree to 1e-3 in 99 % and to 0.1 in all: a contact that
  is about to slide or to part has a force that jumps.
- `runs`: 200 control steps of each simulator on its own, a cube at rest and squeezed, each environment with its own grip. Of
  the last 50: the solver's vertical force on the hand, which at rest is the cube's weight; the cube's height; each reading's
  mean magnitude. Means over environments must agree to 2 % and 0.1 mm: a steady grip depends little on how it came about, but
  contacts that stick do remember it, and where two runs differ by a rounding some of them stick elsewhere.
- `graph`: readings of `step_and_read` are those of the same module, eager, on the state that it left, as `modules`.
- `masked`: a CUDA graph of a reading of all environments, a reset of some, a second reading of these alone and a look at what
  the next call would read, replayed on new states and masks: what the eager module reads in the same order, as `modules`.
- `reset`: environments of a mask are bit for bit at the start, the others where they were.
- `overflow`: a pool that is too small is reported by name, and no more after a reset to a state with few contacts.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.warp import WarpSimulation

HANDED_OVER = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")
FORCES = ("contact_force", "contact_torque", "contact_netforce")
POSES = ("body_pos", "body_quat", "body_linvel", "body_angvel")
REMAINDERS = ("/missed", "/residual")
"""Of the forces that `force_taxel` shares out: small differences of large numbers."""
SUBSTEPS, EVERY = 5, 5


class Failure(Exception):
    """A check that did not hold."""


def module(options: argparse.Namespace, device: str, dtype: torch.dtype = torch.float32) -> TactileModule:
    """Return the artefact's module."""
    return tgdsl.load(options.artefact, dtype=dtype, device=device)


def simulation(touch: TactileModule, options: argparse.Namespace, **keys: Any) -> WarpSimulation:
    """Return environments of MuJoCo Warp."""
    given: dict[str, Any] = {"keyframe": "rest", "device": options.device, **keys}
    return WarpSimulation(touch, options.num_envs, **given)


def grips(model: mujoco.MjModel, strength: np.ndarray, count: int) -> list[np.ndarray]:
    """Return controls (env, actuator) of each step, from rest to a squeeze of a strength of its own in each environment."""
    rest, squeeze = (model.key(name).ctrl for name in ("rest", "squeeze"))
    return [rest + (squeeze - rest) * strength[:, None] * min(1.0, 2 * i / count) for i in range(count)]


def fields(state: SceneState, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return fields in float64, slots summed."""
    found = {name: getattr(state, name) for name in names if name not in ("dt", "variant", "object_size")}
    return numbers({name: value.sum(dim=2) if value.ndim == 4 else value for name, value in found.items()})


def num_contacts(state: SceneState) -> np.ndarray:
    """Return how many contacts each pair has, (env, pair)."""
    assert state.contact_found is not None
    return state.contact_found.cpu().numpy()


def numbers(values: dict[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: value.double().cpu().numpy() for name, value in values.items()}


Kept = dict[str, list[np.ndarray]]


def keep(values: dict[str, np.ndarray], kept: Kept) -> None:
    for name, value in values.items():
        kept.setdefault(name, []).append(value)


def errors(found: Kept, expected: Kept) -> dict[str, np.ndarray]:
    """Print how much values differ, and return their errors over the channel's largest magnitude."""
    print(f"  {'':<20}{'median':>10}{'99 %':>10}{'99.9 %':>10}{'largest':>10}{'magnitude':>12}")
    result = {}
    for name, parts in expected.items():
        want, have = np.concatenate(parts), np.concatenate(found[name])
        channels = 1 if want.ndim == 2 else want.shape[-1]
        want, have = (value.reshape(-1, channels) for value in (want, have))
        scale = np.abs(want).max(axis=0)
        result[name] = np.abs(have - want) / np.where(scale > 0, scale, 1.0)
        quantiles = "".join(f"{np.quantile(result[name], q):10.1e}" for q in (0.5, 0.99, 0.999, 1.0))
        print(f"  {name:<20}{quantiles}{scale.max():12.1e}")
    return result


def demand(is_met: bool, what: str) -> None:
    """Say whether a condition holds.

    Raises:
        Failure: If it does not.
    """
    if not is_met:
        raise Failure(what)


def judge(touch: TactileModule, error: dict[str, np.ndarray], calls: Sequence[str] = ("",)) -> None:
    """Demand of 99.9 % of each reading but remainders that they agree, in each of some calls.

    Raises:
        Failure: If they do not.
    """
    for output in touch.outputs:
        if output.name.endswith(REMAINDERS):
            continue
        tolerance = 3e-5 if output.kind == "elastomer" else 1e-5
        for call in calls:
            share = np.mean(error[f"{call}{output.name}"] > tolerance)
            demand(bool(share <= 1e-3), f"{call}{output.name}: {share:.2%} differ by more than {tolerance:g}")


def check_modules(options: argparse.Namespace) -> None:
    """Read the same float32 states twice."""
    touch, exact = module(options, options.device), module(options, "cpu", torch.float64)
    sim = simulation(touch, options, substeps=SUBSTEPS)
    read = touch if options.eager else touch.compile()
    found: Kept = {}
    expected: Kept = {}
    strength = np.linspace(0.3, 1.2, options.num_envs)
    for control in grips(sim.model, strength, options.instants * EVERY):
        sim.step(control)
        state = sim.state()
        with torch.no_grad():
            keep(numbers(read(state)), found)
            keep(numbers(exact(state.to("cpu"))), expected)
    judge(touch, errors(found, expected))


def check_states(options: argparse.Namespace) -> None:
    """Give positions and speeds to both simulators and compare what follows."""
    touch, other = module(options, options.device), module(options, "cpu", torch.float64)
    sim = simulation(touch, options)
    cpu = BatchSimulation(other, options.num_envs, keyframe="rest")
    sim.warp_model.opt.tolerance.fill_(cpu.model.opt.tolerance)
    found: Kept = {}
    expected: Kept = {}
    shares: list[float] = []
    strength = np.linspace(0.3, 1.2, options.num_envs)
    for i, control in enumerate(grips(sim.model, strength, options.instants * EVERY * SUBSTEPS)):
        is_compared = i % (EVERY * SUBSTEPS) == EVERY * SUBSTEPS - 1
        if is_compared:
            for name in HANDED_OVER:
                getattr(cpu.batch, name)[...] = sim.arrays[name].cpu().numpy()
            cpu.step(control)
        sim.step(control)
        if is_compared:
            own, others = sim.state(), cpu.state()
            is_alike = (num_contacts(own) == num_contacts(others)).all(axis=1)
            shares.append(is_alike.mean())
            for state, kept in ((own, found), (others, expected)):
                values = fields(state, touch.inputs.fields)
                keep({name: value[is_alike] if name in FORCES else value for name, value in values.items()}, kept)
    sim.check()
    print(f"  environments with the same contacts in both: {np.mean(shares):.2%}")
    demand(float(np.mean(shares)) >= 0.95, "contacts differ in too many environments")
    for name, error in errors(found, expected).items():
        if name in POSES:
            demand(error.max() <= 1e-5, f"{name} differs by {error.max():.1e}")
        elif name in FORCES:
            demand(np.quantile(error, 0.99) <= 1e-3 and error.max() <= 0.1, f"{name} differs by {error.max():.1e}")


def check_runs(options: argparse.Namespace) -> None:
    """Let both simulators go their own way for 200 control steps."""
    for what, low, high in (("at rest", 0.0, 0.1), ("squeezed", 0.8, 1.1)):
        results = []
        for is_warp in (True, False):
            touch = module(options, options.device if is_warp else "cpu")
            if is_warp:
                sim = simulation(touch, options, substeps=SUBSTEPS)
            else:
                sim = BatchSimulation(touch, options.num_envs, substeps=SUBSTEPS, keyframe="rest")
            results.append(averages(touch, sim, np.linspace(low, high, options.num_envs)))
        print(f"  {what:<22}{'MuJoCo Warp':>14}{'MuJoCo':>14}{'difference':>14}")
        for name, expected in results[1].items():
            found = results[0][name]
            print(f"  {name:<22}{found:14.6g}{expected:14.6g}{found - expected:14.2e}")
        for name, expected in results[1].items():
            if name.endswith(REMAINDERS):
                continue
            bound = 1e-4 if name == "height" else 0.02 * abs(expected) + 1e-7
            demand(abs(results[0][name] - expected) <= bound, f"{what}: {name} is {results[0][name]:g}, not {expected:g}")


def averages(touch: TactileModule, sim: WarpSimulation | BatchSimulation, strength: np.ndarray) -> dict[str, float]:
    """Return means over the last 50 of 200 control steps and all environments."""
    kept: dict[str, list[float]] = {}
    cube = touch.inputs.bodies.index("cube")
    for i, control in enumerate(grips(sim.model, strength, 200)):
        sim.step(control)
        if i < 150:
            continue
        state = sim.state()
        with torch.no_grad():
            found = {name: float(value.double().abs().mean()) for name, value in touch(state).items()}
        assert state.body_pos is not None
        found["height"] = float(state.body_pos[:, cube, 2].double().mean())
        if state.contact_netforce is not None:
            found["vertical force"] = float(state.contact_netforce[..., 2].double().sum(dim=1).mean())
        for name, value in found.items():
            kept.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in kept.items()}


def check_graph(options: argparse.Namespace) -> None:
    """Read in the graph of a step, and again after it."""
    touch, other = module(options, options.device), module(options, options.device)
    if not options.eager:
        touch.compile()
    sim = simulation(touch, options, substeps=SUBSTEPS)
    found: Kept = {}
    expected: Kept = {}
    for control in grips(sim.model, np.linspace(0.3, 1.2, options.num_envs), options.instants * EVERY):
        readings = sim.step_and_read(torch.from_numpy(control).to(options.device))
        with torch.no_grad():
            keep(numbers(other(sim.state())), expected)
        keep(numbers(readings), found)
    sim.check()
    judge(touch, errors(found, expected))


def check_masked(options: argparse.Namespace) -> None:
    """Read all, then some again, in one graph: captured after three calls, and replayed."""
    touch, other = module(options, options.device), module(options, options.device)
    if not options.eager:
        touch.compile()
    sim = simulation(touch, options, substeps=SUBSTEPS)
    state = copied(sim.state())
    mask = torch.zeros(options.num_envs, dtype=torch.bool, device=options.device)

    def calls(read: TactileModule) -> dict[str, Tensor]:
        found = {f"all {name}": value for name, value in read(state).items()}
        read.reset(mask)
        found |= {f"some {name}": value for name, value in read(state, mask).items()}
        return found | {f"next {name}": value for name, value in read.peek(state).items()}

    found: Kept = {}
    expected: Kept = {}
    graph, made = None, {}
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for i, control in enumerate(grips(sim.model, np.linspace(0.3, 1.2, options.num_envs), options.instants * EVERY)):
            sim.step(control)
            copied(sim.state(), state)
            mask.copy_(torch.rand(options.num_envs, generator=generator) < 0.2)
            if graph is None and i == 3 and options.device != "cpu":
                graph, made = torch.cuda.CUDAGraph(), {}
                with torch.cuda.graph(graph):
                    made = calls(touch)
            if graph is None:
                made = calls(touch)
            else:
                graph.replay()
            keep(numbers(made), found)
            keep(numbers(calls(other)), expected)
    judge(touch, errors(found, expected), ("all ", "some ", "next "))


def copied(state: SceneState, into: SceneState | None = None) -> SceneState:
    """Return a state in tensors of its own, or write it into those of another one."""
    if into is None:
        into = state.to(torch.float32, copy=True)
    for name in vars(state):
        if isinstance(value := getattr(state, name), Tensor):
            getattr(into, name).copy_(value)
    return into


def check_reset(options: argparse.Namespace) -> None:
    """Start every other environment again, five times, so that what is captured is replayed."""
    touch = module(options, options.device)
    sim = simulation(touch, options, substeps=SUBSTEPS)
    start = {name: sim.arrays[name].clone() for name in HANDED_OVER}
    pose = sim.state().body_pos
    mask = torch.arange(options.num_envs, device=options.device) % 2 == 0
    for control in grips(sim.model, np.linspace(0.3, 1.2, options.num_envs), 5):
        sim.step(control)
        before, seen = {name: sim.arrays[name].clone() for name in HANDED_OVER}, sim.state().body_pos
        sim.reset(mask)
        after = sim.state().body_pos
        for name in HANDED_OVER:
            demand(bool((sim.arrays[name][mask] == start[name][mask]).all()), f"{name} is not that of the start")
            demand(bool((sim.arrays[name][~mask] == before[name][~mask]).all()), f"{name} of others has changed")
        assert pose is not None and seen is not None and after is not None
        demand(bool((after[~mask] == seen[~mask]).all()), "poses of others have changed")
        demand(float((after[mask] - pose[mask]).abs().max()) < 1e-6, "poses are not those of the start")
    print("  environments of the mask are at the start, the others where they were")


def check_overflow(options: argparse.Namespace) -> None:
    """Squeeze with too little room."""
    for keys, name in (({"njmax": 8}, "njmax=8"), ({"nconmax": 1, "njmax": 160}, "nconmax=1")):
        sim = simulation(module(options, options.device), options, substeps=SUBSTEPS, **keys)
        try:
            for control in grips(sim.model, np.ones(options.num_envs), 100):
                sim.step(control)
            sim.check()
        except SimulationError as error:
            print(f"  {str(error)[:200]}")
            demand(name in str(error), f"{name} is not named")
        else:
            raise Failure(f"{name} was not reported")
        sim.reset()
        sim.check()


CHECKS: dict[str, Callable[[argparse.Namespace], None]] = {
    "modules": check_modules,
    "states": check_states,
    "runs": check_runs,
    "graph": check_graph,
    "masked": check_masked,
    "reset": check_reset,
    "overflow": check_overflow,
}


def main(options: argparse.Namespace) -> int:
    """Make the checks; one that fails does not keep the others from being made. Return how many failed."""
    where = torch.cuda.get_device_name() if options.device != "cpu" else "CPU"
    print(f"torch {torch.__version__}, MuJoCo {mujoco.__version__}, {where}, {options.artefact.name}, {options.num_envs} envs")
    failed = []
    for name in options.checks:
        print(f"\n{name}", flush=True)
        start = time.perf_counter()
        try:
            CHECKS[name](options)
        except Failure as failure:
            failed.append(name)
            print(f"  FAILED: {failure}")
        except Exception:  # of one check: the others are wanted all the same
            failed.append(name)
            print(f"  FAILED\n{traceback.format_exc()}")
        print(f"  {time.perf_counter() - start:.1f} s", flush=True)
    print(f"\n{'failed: ' + ', '.join(failed) if failed else 'all checks hold'}")
    return len(failed)


def parsed() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("artefact", type=Path, help="with a body `cube` and keyframes `rest` and `squeeze`")
    parser.add_argument("--checks", nargs="+", choices=CHECKS, default=list(CHECKS))
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--instants", type=int, default=20, help="states that are compared, five control steps apart")
    parser.add_argument("--eager", action="store_true", help="do not compile the module")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main(parsed()))
