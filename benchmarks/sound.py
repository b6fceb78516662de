"""Sound: a block of samples as one matrix against a loop over samples, on a CPU; a call on a GPU, replayed as a CUDA graph.

    python benchmarks/sound.py cpu                                    # one thread
    python benchmarks/sound.py artefacts out/sound                    # where documents can be compiled
    python benchmarks/sound.py gpu out/sound --out out/sound.json     # needs torch and what tgdsl.load needs, no more

`LINKS` links of `MODES` modes each, `SAMPLES` samples per physics step, each link touching the one object or not.

`cpu`: `block` is what `contact_audio` does from loads to samples, without noise; `loop` does the same sample by sample, all
environments, links and modes at once: a phasor per mode, turned from one sample to the next, which gives the same samples (this
is checked first). `two poles` is the loop with a two-pole resonator per mode, as printed by Chung et al., struck by the same
impulses: cheaper, but another response, which float32 does not hold. All write their state in place, once eager and once
compiled; in turn, in CPU time of the thread. `products` are the fewest multiply-adds that a block takes, as part of a product
of large matrices: its bound on this machine. `module` is a whole call, contacts and noise included, with mean gains and with
those at the contact. `gpu` times the whole call, compiled.
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
"""What the sensor is given."""


def document(folder: Path, **given: Any) -> dict[str, Any]:
    """Return a document whose scene is written to a folder."""
    links = [f"link{i}" for i in range(LINKS)]
    box = '<freejoint/><geom type="box" size=".02 .02 .005"/>'
    bodies = "".join(f'<body name="{body}">{box}</body>' for body in [*links, "item"])
    model = folder / "scene.xml"
    model.write_text(f'<mujoco><option timestep="{STEP}"/><worldbody>{bodies}</worldbody></mujoco>')
    modes = [{"frequency": 300.0 * 1.45**i, "decay": 5.0 + 8.0 * i, "gain": 1.0 / (i + 1)} for i in range(MODES)]
    sensor = {"kind": "contact_audio", "links": links, "feels": ["item"], "modes": modes, "samples": SAMPLES, **given}
    return {"tgdsl": 1, "robot": {"model": str(model)}, "objects": {"item": {"body": "item"}}, "sensors": {"s": sensor}}


def artefact(folder: Path, name: str) -> Path:
    """Return the file of a case."""
    return folder / f"sound_{name.replace(' ', '_')}.safetensors"


def write_artefacts(options: argparse.Namespace) -> None:
    """Compile all cases."""
    options.folder.mkdir(parents=True, exist_ok=True)
    for name, given in CASES.items():
        with TemporaryDirectory() as scratch:
            tgdsl.save(tgdsl.compile(document(Path(scratch), **given)), artefact(options.folder, name))


# On a CPU -------------------------------------------------------------------------------------------------------------------


class Loop:
    """Modes as phasors, turned from one sample to the next; `parts` are their real and imaginary parts (env, row, mode)."""

    def __init__(self, constants: dict[str, Tensor], num_envs: int):
        """Be at rest."""
        self._constants, self._gain = constants, constants["gain"]
        rate = torch.complex(-constants["decay"].double(), 2 * math.pi * constants["frequency"].double())
        turn = torch.exp(rate * (STEP / SAMPLES))
        self._real, self._imag = turn.real.float(), turn.imag.float()
        self.state = {"steady": torch.zeros(num_envs, LINKS, 1), "pending": torch.zeros(num_envs, LINKS, 1)}
        self.parts = tuple(torch.zeros(num_envs, LINKS, MODES) for _ in range(2))

    def samples(self, struck: Tensor, real: Tensor, imag: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Return samples (env, row) each, and both parts of what is kept, after impulses (env, row, 1) [N·s]."""
        real, found = real + struck, []
        for _ in range(SAMPLES):
            real, imag = self._real * real - self._imag * imag, self._imag * real + self._real * imag
            found.append((self._gain * imag).sum(dim=-1))
        return found, real, imag

    def advance(self, force: Tensor) -> Tensor:
        """Advance by a physics step: return samples (env, sample, row)."""
        impulse, new = impulses(force, self._constants, self.state)
        found, *parts = self.samples(impulse.sum(dim=2)[..., None], *self.parts)
        for old, made in (*zip(self.parts, parts, strict=True), *((self.state[name], new[name]) for name in self.state)):
            old.copy_(made)
        return torch.stack(found, dim=1)


class TwoPoles(Loop):
    """Two-pole resonators; `parts` are their last two values."""

    def __init__(self, constants: dict[str, Tensor], num_envs: int):
        """Be at rest."""
        super().__init__(constants, num_envs)
        self._first, self._second = 2 * self._real, self._real**2 + self._imag**2
        self._gain = constants["gain"] * torch.sin(2 * math.pi * constants["frequency"] * STEP / SAMPLES)

    def samples(self, struck: Tensor, real: Tensor, imag: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Return the same; the last value, then the one before."""
        (last, before), found = (real, imag), []
        for k in range(SAMPLES):
            now = self._first * last - self._second * before
            now = now + struck if k == 0 else now
            found.append((self._gain * now).sum(dim=-1))
            last, before = now, last
        return found, last, before


def block(force: Tensor, context: Context, constants: dict[str, Tensor], state: dict[str, Tensor]) -> tuple[Tensor, dict]:
    """Return the samples of `contact_audio` and its new state."""
    still = torch.zeros(1, LINKS)
    gathered = Gathered({Loads: PairLoads(force, force, None), Places: (still, still, still)})
    found, new = CONTACT_AUDIO.forward(gathered, context, constants, state)
    return found["signal"], dict(new)


def run_cpu(options: argparse.Namespace) -> None:
    """Time a block against a loop, and a whole call."""
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
        found, new = block(force, context, constants, state)
        for name, value in new.items():
            state[name].copy_(value)
        return found

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
        taken = timed(calls, options.repeats, options.calls)
    taken |= {name: [own / len(states) for own in taken[name]] for name in ("module", "module, at contacts")}
    taken["products"] = [own * n * LINKS * 2 * MODES * (SAMPLES + 2) / 512**3 for own in taken["products"]]
    for name, own in taken.items():
        print(f"{name:<20}{1e3 * statistics.median(own):9.3f} ms")
    for one in ("loop", "two poles"):
        for slow, fast in (("", ""), (", compiled", ", compiled"), ("", ", compiled")):
            ratio = [own / least for own, least in zip(taken[f"{one}{slow}"], taken[f"block{fast}"], strict=True)]
            print(f"{one}{slow} / block{fast}: {statistics.median(ratio):.1f} ({min(ratio):.1f} to {max(ratio):.1f})")
    write(options, {"envs": n, "seconds": taken})


def check(advance: Callable[[Tensor], Tensor], loop: Loop, num_envs: int) -> None:
    """See that block and loop give the same samples, struck at random for twenty steps."""
    largest = worst = 0.0
    for _ in range(20):
        force = torch.rand(num_envs, LINKS, 1)
        one, other = advance(force).squeeze(2), loop.advance(force)
        largest, worst = max(largest, float(other.abs().max())), max(worst, float((one - other).abs().max()))
    print(f"block and loop differ by {worst / largest:.1e} of the largest sample")
    assert worst <= 1e-5 * largest and largest > 0


def timed(calls: dict[str, Callable[[], Any]], repeats: int, count: int) -> dict[str, list[float]]:
    """Return CPU seconds of the thread that each call takes, in turn."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(repeats + 1):
        for name, call in calls.items():
            start = time.thread_time()
            for _ in range(count if i else 2):
                call()
            if i:
                taken[name].append((time.thread_time() - start) / count)
    return taken


# On a GPU -------------------------------------------------------------------------------------------------------------------


def state_of(touch: TactileModule, num_envs: int, device: torch.device) -> SceneState:
    """Return a state in which half of the links touch the object."""
    state = touch.example_state(num_envs, dtype=torch.float32).to(device)
    for part in (state, *state.substeps):
        assert part.contact_netforce is not None
        meets = torch.rand(part.contact_netforce.shape[:2], device=device) < 0.5
        for name in ("contact_netforce", "contact_force", "contact_normal"):
            value = getattr(part, name)
            value.mul_(meets.reshape(*meets.shape, *[1] * (value.ndim - 2)))
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
            replay = captured(lambda core=core, of=tensors, into=memory: core(of, into), device)
            ready, ms = time.perf_counter() - start, median_ms(replay, options.repeats, device, batch=20)
        heard = next(iter(core(tensors, memory).values()))
        assert bool(heard.isfinite().all()) and bool(heard.any()) == ("scrape" not in CASES[name]), name  # loads are steady
        rows.append({"case": name, "envs": options.envs, "ms": ms, "ready_s": ready})
        print(f"{name:<16}{options.envs:>8}{ms:9.4f} ms   (ready after {ready:.0f} s)", flush=True)
    write(options, {"device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu", "rows": rows})


def write(options: argparse.Namespace, found: dict[str, Any]) -> None:
    """Write what was found, if it is wanted."""
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(found, indent=1) + "\n")


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, envs in (("cpu", 1024), ("artefacts", 0), ("gpu", 16384)):
        own = commands.add_parser(name)
        if name != "cpu":
            own.add_argument("folder", type=Path)
        own.add_argument("--envs", type=int, default=envs)
        own.add_argument("--repeats", type=int, default=15)
        own.add_argument("--calls", type=int, default=20)
        own.add_argument("--device", default="cuda")
        own.add_argument("--eager", action="store_true")
        own.add_argument("--out", type=Path)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    given = parsed()
    {"cpu": run_cpu, "artefacts": write_artefacts, "gpu": run_gpu}[given.command](given)
