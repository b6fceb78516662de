"""Check MuJoCo Warp against a batch of MuJoCo simulations: readings, CUDA graphs, masked resets and reported overflows.

    tgdsl compile examples/every_sensor.yaml -o out/every_sensor.safetensors          # on any machine with tgdsl
    python benchmarks/warp_check.py out/every_sensor.safetensors [--device cuda] [--num-envs 64]

Errors are relative to the largest magnitude of a channel in the batch. Contact slots are summed, since their order is free.
`missed` and `residual` of `force_taxel` are small differences of large forces: they are printed without a limit.

- `modules` reads float32 states of a squeeze by the compiled float32 module on the device and by an eager float64 module on
  the CPU. 99.9 % of the readings must agree to 1e-5. Readings jump at an edge between two faces, at the threshold of a contact
  and where an anchor slips, and float32 may fall on the other side. The elastomer's limit is 3e-5: it reads displacements of
  at most some millimetres as differences of positions of some centimetres.
- `states` makes a physics step in both simulators from the same float32 positions and velocities. Poses and velocities
  must agree to 1e-5. Rounding decides whether a barely touching contact exists: all contacts must be equal in 95 % of the
  environments. There the forces, at which solvers stop, must agree to 1e-3 in 99 % and to 0.1 in all: the force of a contact
  that is about to slide or to separate jumps.
- `runs` makes 200 control steps in each simulator, with a cube at rest and squeezed; the grip differs between environments.
  It compares means over the last 50 steps: the vertical force on the hand, at rest the cube's weight; the cube's height; the
  magnitude of each reading. They must agree to 2 % and 0.1 mm. A steady grip depends little on its history, except through
  sticking contacts, and after a rounding difference some of them stick elsewhere.
- `graph`: `step_and_read` returns the readings of the same module, eager, on the resulting state; limits as in `modules`.
- `masked` captures a CUDA graph: a reading of all environments, a reset of some, a second reading of those, and a peek at the
  next reading. Replayed on new states and masks it must equal the eager module; limits as in `modules`.
- `reset`: masked environments equal the start bit for bit, and the others do not change.
- `overflow`: an error names the pool that is too small; after a reset to a state with few contacts there is no error.
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

STATE = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")
FORCES = ("contact_force", "contact_torque", "contact_netforce")
POSES = ("body_pos", "body_quat", "body_linvel", "body_angvel")
REMAINDERS = ("/missed", "/residual")
"""Readings of `force_taxel` that are small differences of large forces."""
SUBSTEPS, INSTANTS, EVERY = 5, 20, 5
"""Physics steps per control step, compared states, and the number of control steps between them."""


class Failure(Exception):
    """A failed check."""


def module(options: argparse.Namespace, device: str, dtype: torch.dtype = torch.float32) -> TactileModule:
    """Return the artefact's module."""
    return tgdsl.load(options.artefact, dtype=dtype, device=device)


def simulation(touch: TactileModule, options: argparse.Namespace, **keys: Any) -> WarpSimulation:
    """Return environments of MuJoCo Warp."""
    keys = {"keyframe": "rest", "device": options.device, **keys}
    return WarpSimulation(touch, options.num_envs, **keys)


def grips(model: mujoco.MjModel, strength: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the controls (env, actuator) of each step, from rest to a squeeze of each environment's strength."""
    rest, squeeze = (model.key(name).ctrl for name in ("rest", "squeeze"))
    return [rest + (squeeze - rest) * strength[:, None] * min(1.0, 2 * i / count) for i in range(count)]


def fields(state: SceneState, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return fields in float64; contact slots are summed."""
    values = {name: getattr(state, name) for name in names if name not in ("dt", "variant", "object_size")}
    return numbers({name: value.sum(dim=2) if value.ndim == 4 else value for name, value in values.items()})


def num_contacts(state: SceneState) -> np.ndarray:
    """Return the number of contacts of each pair, (env, pair)."""
    assert state.contact_found is not None
    return state.contact_found.cpu().numpy()


def numbers(values: dict[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: value.double().cpu().numpy() for name, value in values.items()}


Series = dict[str, list[np.ndarray]]


def append(series: Series, values: dict[str, np.ndarray]) -> None:
    for name, value in values.items():
        series.setdefault(name, []).append(value)


def errors(results: Series, expected: Series) -> dict[str, np.ndarray]:
    """Print and return the errors, relative to the channel's largest magnitude."""
    print(f"  {'':<20}{'median':>10}{'99 %':>10}{'99.9 %':>10}{'largest':>10}{'magnitude':>12}")
    relative = {}
    for name, parts in expected.items():
        want, have = np.concatenate(parts), np.concatenate(results[name])
        channels = 1 if want.ndim == 2 else want.shape[-1]
        want, have = (value.reshape(-1, channels) for value in (want, have))
        scale = np.abs(want).max(axis=0)
        relative[name] = np.abs(have - want) / np.where(scale > 0, scale, 1.0)
        quantiles = "".join(f"{np.quantile(relative[name], q):10.1e}" for q in (0.5, 0.99, 0.999, 1.0))
        print(f"  {name:<20}{quantiles}{scale.max():12.1e}")
    return relative


def require(is_met: bool, message: str) -> None:
    if not is_met:
        raise Failure(message)


def require_agreement(touch: TactileModule, error: dict[str, np.ndarray], calls: Sequence[str] = ("",)) -> None:
    """Require that 99.9 % of each reading agree in each call, except remainders."""
    for output in touch.outputs:
        if output.name.endswith(REMAINDERS):
            continue
        tolerance = 3e-5 if output.kind == "elastomer" else 1e-5
        for call in calls:
            share = np.mean(error[f"{call}{output.name}"] > tolerance)
            require(bool(share <= 1e-3), f"{call}{output.name}: {share:.2%} differ by more than {tolerance:g}")


def check_modules(options: argparse.Namespace) -> None:
    """Read the same float32 states by float32 on the device and float64 on the CPU."""
    touch, exact = module(options, options.device), module(options, "cpu", torch.float64)
    sim = simulation(touch, options, substeps=SUBSTEPS)
    read = touch if options.eager else touch.compile()
    readings: Series = {}
    expected: Series = {}
    strength = np.linspace(0.3, 1.2, options.num_envs)
    for control in grips(sim.model, strength, INSTANTS * EVERY):
        sim.step(control)
        state = sim.state()
        with torch.no_grad():
            append(readings, numbers(read(state)))
            append(expected, numbers(exact(state.to("cpu"))))
    require_agreement(touch, errors(readings, expected))


def check_states(options: argparse.Namespace) -> None:
    """Make a physics step in both simulators from the same positions and velocities."""
    touch, other = module(options, options.device), module(options, "cpu", torch.float64)
    sim = simulation(touch, options, substeps=SUBSTEPS)
    cpu = BatchSimulation(other, options.num_envs, keyframe="rest", substeps=SUBSTEPS)
    sim.warp_model.opt.tolerance.fill_(cpu.model.opt.tolerance)
    results: Series = {}
    expected: Series = {}
    shares: list[float] = []
    strength = np.linspace(0.3, 1.2, options.num_envs)
    for i, control in enumerate(grips(sim.model, strength, INSTANTS * EVERY)):
        if i % EVERY < EVERY - 1:
            sim.step(control)
            continue
        for name in STATE:
            getattr(cpu.batch, name)[...] = sim.arrays[name].cpu().numpy()
        state, reference = (next(each.substates(control)) for each in (sim, cpu))
        is_equal = (num_contacts(state) == num_contacts(reference)).all(axis=1)
        shares.append(is_equal.mean())
        for source, series in ((state, results), (reference, expected)):
            values = fields(source, touch.inputs.fields)
            append(series, {name: value[is_equal] if name in FORCES else value for name, value in values.items()})
    sim.check()
    print(f"  environments with the same contacts in both: {np.mean(shares):.2%}")
    require(float(np.mean(shares)) >= 0.95, "contacts differ in too many environments")
    for name, error in errors(results, expected).items():
        if name in POSES:
            require(error.max() <= 1e-5, f"{name} differs by {error.max():.1e}")
        elif name in FORCES:
            require(np.quantile(error, 0.99) <= 1e-3 and error.max() <= 0.1, f"{name} differs by {error.max():.1e}")


def check_runs(options: argparse.Namespace) -> None:
    """Run each simulator for 200 control steps."""
    for grip, low, high in (("at rest", 0.0, 0.1), ("squeezed", 0.8, 1.1)):
        results = []
        for is_warp in (True, False):
            touch = module(options, options.device if is_warp else "cpu")
            if is_warp:
                sim = simulation(touch, options, substeps=SUBSTEPS)
            else:
                sim = BatchSimulation(touch, options.num_envs, substeps=SUBSTEPS, keyframe="rest")
            results.append(averages(touch, sim, np.linspace(low, high, options.num_envs)))
        print(f"  {grip:<22}{'MuJoCo Warp':>14}{'MuJoCo':>14}{'difference':>14}")
        for name, expected in results[1].items():
            mean = results[0][name]
            print(f"  {name:<22}{mean:14.6g}{expected:14.6g}{mean - expected:14.2e}")
        for name, expected in results[1].items():
            if name.endswith(REMAINDERS):
                continue
            bound = 1e-4 if name == "height" else 0.02 * abs(expected) + 1e-7
            require(abs(results[0][name] - expected) <= bound, f"{grip}: {name} is {results[0][name]:g}, not {expected:g}")


def averages(touch: TactileModule, sim: WarpSimulation | BatchSimulation, strength: np.ndarray) -> dict[str, float]:
    """Return means over the last 50 of 200 control steps and all environments."""
    series: dict[str, list[float]] = {}
    cube = touch.inputs.bodies.index("cube")
    for i, control in enumerate(grips(sim.model, strength, 200)):
        sim.step(control)
        if i < 150:
            continue
        state = sim.state()
        with torch.no_grad():
            values = {name: float(value.double().abs().mean()) for name, value in touch(state).items()}
        assert state.body_pos is not None
        values["height"] = float(state.body_pos[:, cube, 2].double().mean())
        if state.contact_netforce is not None:
            values["vertical force"] = float(state.contact_netforce[..., 2].double().sum(dim=1).mean())
        for name, value in values.items():
            series.setdefault(name, []).append(value)
    return {name: float(np.mean(parts)) for name, parts in series.items()}


def check_graph(options: argparse.Namespace) -> None:
    """Compare readings in the graph of a step with readings after it."""
    touch, other = module(options, options.device), module(options, options.device)
    if not options.eager:
        touch.compile()
    sim = simulation(touch, options, substeps=SUBSTEPS)
    results: Series = {}
    expected: Series = {}
    for control in grips(sim.model, np.linspace(0.3, 1.2, options.num_envs), INSTANTS * EVERY):
        readings = sim.step_and_read(torch.from_numpy(control).to(options.device))
        with torch.no_grad():
            append(expected, numbers(other(sim.state())))
        append(results, numbers(readings))
    sim.check()
    require_agreement(touch, errors(results, expected))


def check_masked(options: argparse.Namespace) -> None:
    """Read all environments, then some again, in one graph, which is captured after three calls and replayed."""
    touch, other = module(options, options.device), module(options, options.device)
    if not options.eager:
        touch.compile()
    sim = simulation(touch, options, substeps=SUBSTEPS)
    state = copied(sim.state())
    mask = torch.zeros(options.num_envs, dtype=torch.bool, device=options.device)

    def calls(read: TactileModule) -> dict[str, Tensor]:
        readings = {f"all {name}": value for name, value in read(state).items()}
        read.reset(mask)
        readings |= {f"some {name}": value for name, value in read(state, mask).items()}
        return readings | {f"next {name}": value for name, value in read.peek(state).items()}

    results: Series = {}
    expected: Series = {}
    graph, readings = None, {}
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for i, control in enumerate(grips(sim.model, np.linspace(0.3, 1.2, options.num_envs), INSTANTS * EVERY)):
            sim.step(control)
            copied(sim.state(), state)
            mask.copy_(torch.rand(options.num_envs, generator=generator) < 0.2)
            if graph is None and i == 3 and options.device != "cpu":
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph):
                    readings = calls(touch)
            if graph is None:
                readings = calls(touch)
            else:
                graph.replay()
            append(results, numbers(readings))
            append(expected, numbers(calls(other)))
    require_agreement(touch, errors(results, expected), ("all ", "some ", "next "))


def copied(state: SceneState, into: SceneState | None = None) -> SceneState:
    """Copy a state to new tensors, or to those of another state."""
    if into is None:
        into = state.to(torch.float32, copy=True)
    for name in vars(state):
        if isinstance(value := getattr(state, name), Tensor):
            getattr(into, name).copy_(value)
    return into


def check_reset(options: argparse.Namespace) -> None:
    """Reset every other environment five times, so that captured graphs are replayed."""
    touch = module(options, options.device)
    sim = simulation(touch, options, substeps=SUBSTEPS)
    start = {name: sim.arrays[name].clone() for name in STATE}
    pose = sim.state().body_pos
    mask = torch.arange(options.num_envs, device=options.device) % 2 == 0
    for control in grips(sim.model, np.linspace(0.3, 1.2, options.num_envs), 5):
        sim.step(control)
        last, last_pose = {name: sim.arrays[name].clone() for name in STATE}, sim.state().body_pos
        sim.reset(mask)
        reset_pose = sim.state().body_pos
        for name in STATE:
            require(bool((sim.arrays[name][mask] == start[name][mask]).all()), f"{name} differs from the start")
            require(bool((sim.arrays[name][~mask] == last[name][~mask]).all()), f"{name} of other environments has changed")
        assert pose is not None and last_pose is not None and reset_pose is not None
        require(bool((reset_pose[~mask] == last_pose[~mask]).all()), "poses of other environments have changed")
        require(float((reset_pose[mask] - pose[mask]).abs().max()) < 1e-6, "poses differ from the start")
    print("  masked environments are at the start, the others have not changed")


def check_overflow(options: argparse.Namespace) -> None:
    """Squeeze with pools that are too small."""
    for keys, name in (({"njmax": 8}, "njmax=8"), ({"nconmax": 1, "njmax": 160}, "nconmax=1")):
        sim = simulation(module(options, options.device), options, substeps=SUBSTEPS, **keys)
        try:
            for control in grips(sim.model, np.ones(options.num_envs), 100):
                sim.step(control)
            sim.check()
        except SimulationError as error:
            print(f"  {str(error)[:200]}")
            require(name in str(error), f"{name} is not named")
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
    """Run all checks, whether or not some fail. Return the number of failures."""
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
        except Exception:  # the other checks still run
            failed.append(name)
            print(f"  FAILED\n{traceback.format_exc()}")
        print(f"  {time.perf_counter() - start:.1f} s", flush=True)
    print(f"\n{'failed: ' + ', '.join(failed) if failed else 'all checks passed'}")
    return len(failed)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("artefact", type=Path, help="with a body `cube` and keyframes `rest` and `squeeze`")
    parser.add_argument("--checks", nargs="+", choices=CHECKS, default=list(CHECKS))
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--eager", action="store_true", help="do not compile the module")
    sys.exit(main(parser.parse_args()))
