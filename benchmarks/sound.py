"""Time `contact_audio`: a block of samples as one matrix against a loop over samples, on a CPU; a whole call on a GPU.

    python benchmarks/sound.py cpu                                    # one thread
    python benchmarks/sound.py artefacts out/sound                    # on any machine with tgdsl
    python benchmarks/sound.py gpu out/sound --out out/sound.json     # needs only torch and the dependencies of tgdsl.load

There are `LINKS` links with `MODES` modes each, `SAMPLES` samples per physics step, and one object that links may touch.

`cpu` compares calls that update their state in place, eager and compiled. Calls alternate, in CPU time of the thread.

- `block` computes the samples of `contact_audio` from loads, without noise.
- `loop` computes equal samples (checked first) one by one, for all environments, links and modes: each mode is a phasor, which
  each sample rotates.
- `two poles` is the loop with a two-pole resonator per mode, as printed by Chung et al., excited by the same impulses. It is
  cheaper, but its response differs and float32 does not resolve it.
- `products` is a lower bound on this machine: the fewest multiply-adds of a block, at the rate of large matrix products.
- `module` is a whole call with contacts and noise, with mean gains and with gains at the contact.

`gpu` times the whole call, compiled and replayed as a CUDA graph.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from gpu import captured, median_ms
from torch import Tensor

import tgdsl
from tgdsl.module.artifact import load_plan
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contacts import Loads, PairLoads
from tgdsl.quantities.kinematics import Places
from tgdsl.sensors.base import Context
from tgdsl.sensors.contact_audio.kind import CONTACT_AUDIO, impulses

LINKS, MODES, SAMPLES, STEP = 5, 8, 20, 0.001
CASES: dict[str, dict[str, Any]] = {
    "one step": {},
    "without noise": {"scrape": 0.0},
    "bands": {"outputs": "bands"},
    "five steps": {"substeps": 5},
    "at contacts": {
        "modes": {"material": {"like": "steel", "youngs_modulus": 1e9}, "count": MODES},
        "gains": "contact",
    },
}
"""Fields of the sensor."""


def document(folder: Path, **fields: Any) -> dict[str, Any]:
    """Return a document; write its scene to a folder."""
    links = [f"link{i}" for i in range(LINKS)]
    box = '<freejoint/><geom type="box" size=".02 .02 .005"/>'
    bodies = "".join(f'<body name="{body}">{box}</body>' for body in [*links, "item"])
    model = folder / "scene.xml"
    model.write_text(f'<mujoco><option timestep="{STEP}"/><worldbody>{bodies}</worldbody></mujoco>')
    modes = [{"frequency": 300.0 * 1.45**i, "decay": 5.0 + 8.0 * i, "gain": 1.0 / (i + 1)} for i in range(MODES)]
    sensor = {"kind": "contact_audio", "links": links, "feels": ["item"], "modes": modes, "samples": SAMPLES, **fields}
    return {"tgdsl": 1, "robot": {"model": str(model)}, "objects": {"item": {"body": "item"}}, "sensors": {"s": sensor}}


def artefact(folder: Path, name: str) -> Path:
    """Return the path of a case's artefact."""
    return folder / f"sound_{name.replace(' ', '_')}.safetensors"


def write_artefacts(options: argparse.Namespace) -> None:
    """Compile all cases."""
    options.folder.mkdir(parents=True, exist_ok=True)
    for name, fields in CASES.items():
        with TemporaryDirectory() as scratch:
            tgdsl.save(tgdsl.compile(document(Path(scratch), **fields)), artefact(options.folder, name))


# On a CPU -------------------------------------------------------------------------------------------------------------------


class Loop:
    """Modes as phasors, which each sample rotates; `parts` are their real and imaginary parts (env, row, mode)."""

    def __init__(self, constants: dict[str, Tensor], num_envs: int):
        """Start at rest."""
        self._constants, self._gain = constants, constants["gain"]
        rate = torch.complex(-constants["decay"].double(), 2 * math.pi * constants["frequency"].double())
        turn = torch.exp(rate * (STEP / SAMPLES))
        self._real, self._imag = turn.real.float(), turn.imag.float()
        self.state = {"steady": torch.zeros(num_envs, LINKS, 1), "pending": torch.zeros(num_envs, LINKS, 1)}
        self.parts = tuple(torch.zeros(num_envs, LINKS, MODES) for _ in range(2))

    def samples(self, impulse: Tensor, real: Tensor, imag: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Return samples (env, row) each, and both parts of the new state, after impulses (env, row, 1) [N·s]."""
        real, signal = real + impulse, []
        for _ in range(SAMPLES):
            real, imag = self._real * real - self._imag * imag, self._imag * real + self._real * imag
            signal.append((self._gain * imag).sum(dim=-1))
        return signal, real, imag

    def advance(self, force: Tensor) -> Tensor:
        """Advance by a physics step; return samples (env, sample, row)."""
        impulse, state = impulses(force, self._constants, self.state)
        signal, *parts = self.samples(impulse.sum(dim=2)[..., None], *self.parts)
        for old, new in (*zip(self.parts, parts, strict=True), *((self.state[name], state[name]) for name in self.state)):
            old.copy_(new)
        return torch.stack(signal, dim=1)


class TwoPoles(Loop):
    """Two-pole resonators; `parts` are their last two values."""

    def __init__(self, constants: dict[str, Tensor], num_envs: int):
        """Start at rest."""
        super().__init__(constants, num_envs)
        self._first, self._second = 2 * self._real, self._real**2 + self._imag**2
        self._gain = constants["gain"] * torch.sin(2 * math.pi * constants["frequency"] * STEP / SAMPLES)

    def samples(self, impulse: Tensor, real: Tensor, imag: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Return samples, and the last and second last value."""
        (last, second_last), signal = (real, imag), []
        for k in range(SAMPLES):
            now = self._first * last - self._second * second_last
            now = now + impulse if k == 0 else now
            signal.append((self._gain * now).sum(dim=-1))
            last, second_last = now, last
        return signal, last, second_last


def block(force: Tensor, context: Context, constants: dict[str, Tensor], state: dict[str, Tensor]) -> tuple[Tensor, dict]:
    """Return the samples of `contact_audio` and its new state."""
    still = torch.zeros(1, LINKS)
    gathered = Gathered({Loads: PairLoads(force, force, None), Places: (still, still, still)})
    readings, new_state = CONTACT_AUDIO.forward(gathered, context, constants, state)
    return readings["signal"], dict(new_state)


def run_cpu(options: argparse.Namespace) -> None:
    """Time a block, loops over samples, and a whole call."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as scratch:
        silent = tgdsl.compile(document(Path(scratch), scrape=0.0))
        whole, placed = (tgdsl.compile(document(Path(scratch), **CASES[name])) for name in ("one step", "at contacts"))
    constants = {
        name: value.to(torch.float32) if value.is_floating_point() else value
        for name, value in ((key, silent.constants[f"sensors/s/{key}"]) for key in silent.plan.sensors[0].constants)
    }
    n = options.envs
    step = torch.zeros(n, 1, dtype=torch.int64)
    context = Context(torch.tensor(STEP), step, 0, torch.ones(n, 1), torch.zeros(n, 1, dtype=torch.bool))
    force, loop, poles = torch.rand(n, LINKS, 1), Loop(constants, n), TwoPoles(constants, n)
    state = {name: torch.zeros(n, *part.shape) for name, part in silent.plan.sensors[0].state.items()}
    states = [whole.example_state(n, seed=seed, dtype=torch.float32) for seed in range(3)]

    def advance(force: Tensor) -> Tensor:
        signal, new = block(force, context, constants, state)
        for name, value in new.items():
            state[name].copy_(value)
        return signal

    with torch.no_grad():
        check(advance, loop, n)
    compiled: list[Any] = [torch.compile(one, fullgraph=True) for one in (advance, loop.advance, poles.advance)]
    large = torch.rand(512, 512)
    calls: dict[str, Callable[[], Any]] = {
        "block": lambda: advance(force),
        "loop": lambda: loop.advance(force),
        "two poles": lambda: poles.advance(force),
        "block, compiled": lambda: compiled[0](force),
        "loop, compiled": lambda: compiled[1](force),
        "two poles, compiled": lambda: compiled[2](force),
        "products": lambda: large @ large,
        "module": lambda: [whole(one) for one in states],
        "module, at contacts": lambda: [placed(one) for one in states],
    }
    with torch.no_grad():
        times = timed(calls, options.repeats, options.calls)
    times |= {name: [t / len(states) for t in times[name]] for name in ("module", "module, at contacts")}
    times["products"] = [t * n * LINKS * 2 * MODES * (SAMPLES + 2) / 512**3 for t in times["products"]]
    for name, series in times.items():
        print(f"{name:<20}{1e3 * statistics.median(series):9.3f} ms")
    for loop_name in ("loop", "two poles"):
        for slow, fast in (("", ""), (", compiled", ", compiled"), ("", ", compiled")):
            ratio = [a / b for a, b in zip(times[f"{loop_name}{slow}"], times[f"block{fast}"], strict=True)]
            print(f"{loop_name}{slow} / block{fast}: {statistics.median(ratio):.1f} ({min(ratio):.1f} to {max(ratio):.1f})")
    write(options, {"envs": n, "seconds": times})


def check(advance: Callable[[Tensor], Tensor], loop: Loop, num_envs: int) -> None:
    """Assert that block and loop return equal samples in twenty steps of random loads."""
    largest = worst = 0.0
    for _ in range(20):
        force = torch.rand(num_envs, LINKS, 1)
        signal, expected = advance(force).squeeze(2), loop.advance(force)
        largest, worst = max(largest, float(expected.abs().max())), max(worst, float((signal - expected).abs().max()))
    print(f"block and loop differ by {worst / largest:.1e} of the largest sample")
    assert worst <= 1e-5 * largest and largest > 0


def timed(calls: dict[str, Callable[[], Any]], repeats: int, count: int) -> dict[str, list[float]]:
    """Return the CPU times of alternating calls [s]."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(repeats + 1):
        for name, call in calls.items():
            start = time.thread_time()
            for _ in range(count if i else 2):
                call()
            if i:
                times[name].append((time.thread_time() - start) / count)
    return times


# On a GPU -------------------------------------------------------------------------------------------------------------------


def state_of(touch: TactileModule, num_envs: int, device: torch.device) -> SceneState:
    """Return a state in which half of the links touch the object."""
    state = touch.example_state(num_envs, dtype=torch.float32).to(device)
    for part in (state, *state.substeps):
        assert part.contact_netforce is not None
        is_contact = torch.rand(part.contact_netforce.shape[:2], device=device) < 0.5
        for name in ("contact_netforce", "contact_force", "contact_normal"):
            value = getattr(part, name)
            value.mul_(is_contact.reshape(*is_contact.shape, *[1] * (value.ndim - 2)))
    return state


def run_gpu(options: argparse.Namespace) -> None:
    """Time whole calls, compiled and replayed as CUDA graphs."""
    device, rows = torch.device(options.device), []
    for name in CASES:
        touch = TactileModule(load_plan(artefact(options.folder, name))).to(device)
        if not options.eager:
            touch.compile()
        state = state_of(touch, options.envs, device)
        with torch.no_grad():
            start = time.perf_counter()
            touch(state)
            tensors = touch.incoming.tensors(state, torch.float32, device)
            memory = touch.memory.tensors(options.envs, state.dt, torch.float32, device)
            core = touch.calls.of(touch.advance)
            replay = captured(lambda core=core, tensors=tensors, memory=memory: core(tensors, memory), device)
            ready, ms = time.perf_counter() - start, median_ms(replay, options.repeats, device, batch=20)
        signal = next(iter(core(tensors, memory).values()))
        # Loads are steady, so without scrape noise there is no sound.
        assert bool(signal.isfinite().all()) and bool(signal.any()) == ("scrape" not in CASES[name]), name
        rows.append({"case": name, "envs": options.envs, "ms": ms, "ready_s": ready})
        print(f"{name:<16}{options.envs:>8}{ms:9.4f} ms   (ready after {ready:.0f} s)", flush=True)
    write(options, {"device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu", "rows": rows})


def write(options: argparse.Namespace, results: dict[str, Any]) -> None:
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(results, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, envs in (("cpu", 1024), ("artefacts", 0), ("gpu", 16384)):
        command = commands.add_parser(name)
        if name != "cpu":
            command.add_argument("folder", type=Path)
        command.add_argument("--envs", type=int, default=envs)
        command.add_argument("--repeats", type=int, default=15)
        command.add_argument("--calls", type=int, default=20)
        command.add_argument("--device", default="cuda")
        command.add_argument("--eager", action="store_true")
        command.add_argument("--out", type=Path)
    options = parser.parse_args()
    {"cpu": run_cpu, "artefacts": write_artefacts, "gpu": run_gpu}[options.command](options)


if __name__ == "__main__":
    main()
