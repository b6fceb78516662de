"""Resets on a GPU: do they wait for nothing, can a CUDA graph capture them, and do environments with faults restart there?

    tgdsl compile examples/noisy_hand.yaml -o out/noisy_hand.safetensors          # where documents can be compiled
    python benchmarks/reset_check.py out/noisy_hand.safetensors [--num-envs 64]

- `waiting`: steps, masked resets and states with values on the GPU, faults and their counts, under torch's check that the host
  waits for nothing.
- `captured`: a reset with a mask and values in a CUDA graph of one's own; replayed with other masks and values it does what the
  same reset does without a graph (what is integrated bit for bit, what follows from it to roundings), and changes nothing of
  other environments.
- `loop`: a step, a reading and a masked reset in one CUDA graph, to 1 % of what the same calls do without.
- `faults`: environments that diverge, or are given controls or a state that is not finite, restart; the others are those of
  a simulation without any, to 1 % after six control steps: two runs on a GPU are not alike bit for bit.
- `times`: what a masked reset, and the state after it, take.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.simulators.state_values import INTEGRATED
from tgdsl.runtime.warp import WarpSimulation

SUBSTEPS, STEPS = 5, 6


def simulation(options: argparse.Namespace, **keys: str) -> tuple[TactileModule, WarpSimulation]:
    """Return a module and environments of its scene, stepped until what is captured is captured."""
    touch = tgdsl.load(options.artefact, device="cuda")
    sim = WarpSimulation(touch, options.num_envs, keyframe="rest", substeps=SUBSTEPS, **keys)  # type: ignore[arg-type]
    mask = torch.zeros(options.num_envs, dtype=torch.bool, device="cuda")
    for _ in range(4):
        sim.step(sim.ctrl.clone())
        sim.reset(mask, qpos=sim.qpos.clone())
        touch(sim.state())
    sim.reset()
    return touch, sim


@contextmanager
def no_waiting() -> Iterator[None]:
    """Have torch raise where the host would wait for the GPU."""
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def drawn(sim: WarpSimulation, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return a mask, positions and speeds."""
    generator = torch.Generator("cuda").manual_seed(seed)
    mask = torch.rand(sim.num_envs, device="cuda", generator=generator) < 0.4
    noise = torch.randn(sim.qvel.shape, device="cuda", generator=generator)
    qpos = torch.from_numpy(sim.model.key("rest").qpos).to("cuda", torch.float32).expand(sim.qpos.shape).clone()
    qpos[:, sim.joints["cube"].qpos.start + 2] += 0.01 * noise[:, 0].abs()
    return mask, qpos, 0.1 * noise


def snapshot(sim: WarpSimulation, touch: TactileModule) -> dict[str, Tensor]:
    """Return a copy of what is integrated, of the state's poses, velocities and contacts, and of what the module remembers."""
    found = {name: sim.arrays[name].clone() for name in INTEGRATED if sim.arrays[name].numel()}
    found |= {f"module {name}": value.clone() for name, value in touch.named_buffers() if value.shape[:1] == (sim.num_envs,)}
    return found | {f"state {name}": value for name, value in vars(sim.state()).items() if isinstance(value, Tensor)}


def assert_same(found: dict[str, Tensor], expected: dict[str, Tensor], where: Tensor, tolerance: float = 0.0) -> None:
    """Assert that snapshots are alike in some environments, to a share of each one's largest magnitude."""
    for name, value in expected.items():
        error = (found[name].double() - value.double())[where].abs()
        limit = tolerance * float(value.double().abs().max())
        assert not error.numel() or float(error.max()) <= limit, f"{name}: {float(error.max()):.1e}, at most {limit:.1e}"


def check_waiting(options: argparse.Namespace) -> None:
    """Step and reset without a look from the host."""
    for on_fault in ("raise", "reset"):
        touch, sim = simulation(options, on_fault=on_fault)
        mask, qpos, qvel = drawn(sim, 0)
        control = sim.ctrl.clone()
        touch(sim.state())
        with no_waiting(), torch.no_grad():
            for _ in range(4):
                sim.step(control)
                touch(sim.state())
                sim.reset(mask | sim.faults, qpos=qpos, qvel=qvel.double())
                sim.set_state(~mask, qvel=qvel)
                sim.forward(mask)
                touch(sim.state())
                sim.step_and_read(control)
                _ = sim.fault_counts
        sim.check()
    print("  nothing was waited for")


def check_captured(options: argparse.Namespace) -> None:
    """Capture a reset, and replay it with other masks and values.

    Two evaluations differ by roundings on a GPU, where sums are taken in any order.
    """
    touch, sim = simulation(options)
    other, twin = simulation(options)
    mask, qpos, qvel = drawn(sim, 1)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        sim.reset(mask, qpos=qpos, qvel=qvel)
    for step in range(STEPS):
        new = drawn(sim, 2 + step)
        for kept, value in zip((mask, qpos, qvel), new, strict=True):
            kept.copy_(value)
        before = snapshot(sim, touch)
        graph.replay()
        twin.reset(new[0], qpos=new[1], qvel=new[2])
        after, expected = snapshot(sim, touch), snapshot(twin, other)
        assert_same(after, before, ~mask)
        # What noise remembers is not wiped, but no older than its episode.
        expected = {
            name: value for name, value in expected.items() if "module" not in name or name.endswith(("age", "episode"))
        }
        assert_same(after, {name: value for name, value in expected.items() if name in INTEGRATED}, mask)
        assert_same(after, expected, mask, 1e-3)
        assert float((after["state body_pos"] - before["state body_pos"])[mask].abs().max()) > 1e-3
        for one, own in ((sim, touch), (twin, other)):
            one.step(one.ctrl.clone())
            own(one.state())
    print(f"  {STEPS} replays with other masks and values are the resets that were not captured; the others have not changed")


def check_loop(options: argparse.Namespace) -> None:
    """Capture a whole turn of a loop: step, read, reset what is over."""
    touch, sim = simulation(options, on_fault="reset")
    other, twin = simulation(options, on_fault="reset")
    mask, qpos, _ = drawn(sim, 1)
    control, is_over = sim.ctrl.clone(), torch.zeros_like(mask)
    graph = torch.cuda.CUDAGraph()
    with torch.no_grad():
        touch(sim.state())
        other(twin.state())
        with torch.cuda.graph(graph):
            sim.step(control)
            readings = touch(sim.state())
            sim.reset(is_over, qpos=qpos)
        for step in range(STEPS):
            is_over.copy_(mask if step == STEPS - 2 else torch.zeros_like(mask))
            graph.replay()
            twin.step(control)
            expected = other(twin.state())
            twin.reset(is_over, qpos=qpos)
            for name, value in expected.items():
                limit = 1e-2 * float(value.abs().max()) + 1e-6
                assert float((readings[name] - value).abs().max()) <= limit, f"{name} in step {step}"
            expected = snapshot(twin, other)
            del expected["qacc_warmstart"]
            assert_same(snapshot(sim, touch), expected, torch.ones_like(mask), 1e-2)
    sim.check()
    print(f"  {STEPS} replays of a whole turn are the calls that were not captured")


def check_faults(options: argparse.Namespace) -> None:
    """Break three environments, each in its own way."""
    touch, sim = simulation(options, on_fault="reset")
    other, twin = simulation(options)
    others = torch.ones(sim.num_envs, dtype=torch.bool, device="cuda")
    others[:3] = False
    control, bad = sim.ctrl.clone(), sim.ctrl.clone()
    bad[1] = torch.nan
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for step in range(STEPS):
            qpos = sim.qpos.clone()
            if step == 2:
                sim.qvel[0] = torch.nan
                qpos[2] = torch.nan
            sim.set_state(~others, qpos=qpos)
            sim.step(bad if step == 2 else control)
            twin.step(control)
            expected = snapshot(twin, other)
            del expected["qacc_warmstart"]
            assert_same(snapshot(sim, touch), expected, others, 1e-2)
            assert torch.equal(sim.faults, ~others) if step == 2 else not sim.faults.any(), sim.faults
            if step == 2:
                assert (sim.arrays["time"][:3] == 0).all() and torch.isfinite(sim.qpos).all()
    assert sim.fault_counts.tolist() == [1, 1, 1] + [0] * (sim.num_envs - 3), sim.fault_counts
    found = [str(entry.message) for entry in said if "restarted" in str(entry.message)]
    assert len(found) == 1 and "1 diverged, 1 had controls" in found[0], found
    for _ in range(4):
        readings = sim.step_and_read(control)
    sim.qvel[0] = torch.nan
    readings = sim.step_and_read(control)
    assert all(torch.isfinite(value).all() for value in readings.values()) and sim.faults.tolist()[:2] == [True, False]
    _, sim = simulation(options)
    sim.reset(~others, qpos=torch.full_like(sim.qpos, torch.nan))
    said_of_state = ""
    try:
        sim.check()
    except SimulationError as error:
        said_of_state = str(error)
    assert said_of_state.startswith("values given for the state of environments 0, 1, 2 are not finite"), said_of_state
    print("  three environments restarted, the others are those of a simulation without faults")


def check_times(options: argparse.Namespace) -> None:
    """Time a control step, with and without a masked reset and the state after it."""
    for on_fault in ("raise", "reset"):
        touch, sim = simulation(options, on_fault=on_fault)
        mask, qpos, qvel = drawn(sim, 0)

        def plain(sim: WarpSimulation = sim, touch: TactileModule = touch) -> None:
            sim.step()
            touch(sim.state())

        def with_reset(
            sim: WarpSimulation = sim, touch: TactileModule = touch, values: tuple[Tensor, ...] = (mask, qpos, qvel)
        ) -> None:
            sim.step()
            sim.reset(values[0], qpos=values[1], qvel=values[2])
            touch(sim.state())

        took = []
        for call in (plain, with_reset):
            for _ in range(5):
                call()
            torch.cuda.synchronize()
            start = time.perf_counter()
            for _ in range(20):
                call()
            torch.cuda.synchronize()
            took.append((time.perf_counter() - start) / 20 * 1e3)
        print(f"  {on_fault:<6} step and state {took[0]:.2f} ms, with a masked reset {took[1]:.2f} ms")


CHECKS: dict[str, Callable[[argparse.Namespace], None]] = {
    "waiting": check_waiting,
    "captured": check_captured,
    "loop": check_loop,
    "faults": check_faults,
    "times": check_times,
}


def main() -> int:
    """Make the checks; return how many failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("artefact", type=Path, help="of a hand and a free joint `cube`, with a keyframe `rest`")
    parser.add_argument("--checks", nargs="+", choices=CHECKS, default=list(CHECKS))
    parser.add_argument("--num-envs", type=int, default=64)
    options = parser.parse_args()
    print(f"torch {torch.__version__}, {torch.cuda.get_device_name()}, {options.artefact.name}, {options.num_envs} envs")
    failed = 0
    for name in options.checks:
        print(f"\n{name}", flush=True)
        try:
            CHECKS[name](options)
        except Exception:  # of one check: the others are wanted all the same
            failed += 1
            print(f"  FAILED\n{traceback.format_exc()}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
