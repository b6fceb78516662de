"""Scenes for `gpu.py`: flat pads of taxels under cubes, their artefacts and states, and the bytes that each call must move."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

import tgdsl
from tgdsl.module.memory import COUNTS
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.sensors import KINDS as TGDSL_KINDS

PITCH = 0.07
"""Distance between the centres of two pads [m]."""
TOP = 0.005
"""Height of a pad's surface above its body's origin [m]."""
HALF = 0.02
"""Half the edge of a cube [m]."""
DT = 0.01
"""Time between two calls [s]."""
ANCHORS = ("anchor_x", "anchor_y", "anchor_z", "held", "object")
"""State of an elastomer for each anchored point or taxel."""
GRIDS = {10: (2, 5), 100: (10, 10), 1_000: (25, 40), 10_000: (100, 100)}
"""Rows and columns of a pad, by its number of taxels."""
MAIN = 16_384
"""Number of environments of most limits."""
SWEPT = (MAIN, 1_024, 4_096, 65_536)
"""Numbers of environments of a sweep; code is compiled for the first."""
KINDS: dict[str, dict[str, Any]] = {
    "contact_depth": {},
    "contact": {"threshold": 5e-4, "release_threshold": 2e-4},
    "kinematic_taxel": {},
    "proximity": {"tolerance": 0.02},
    "force_taxel": {},
    "link_contact": {},
    "elastomer": {"anchors": "points", "points": 500},
    "surface_distance": {},
}
"""Fields of a sensor of each kind."""
EVERY_KNOB: dict[str, Any] = {
    "read_delay": 0.01,
    "jitter": 0.02,
    "bias": [-0.01, 0.01],
    "white_noise": 5e-3,
    "drift": 1e-4,
    "gain": [0.85, 1.15],
    "quantization": 1e-2,
    "hysteresis": {"strength": 0.5, "time_constant": 0.05},
    "dead_probability": 0.05,
    "dead_range": [0.0, 1.0],
    "crosstalk": {"strength": 0.3, "sigma": 3e-3},
    "radius_noise": 3e-4,
}
"""The full noise model; each kind takes the knobs that it supports."""
FINE = {"contact_depth": 1e-4, "contact": 1e-4, "surface_distance": 1e-4}
"""Quantization of kinds that read depths and distances [m]; the others have that of `EVERY_KNOB`."""
KNOBS: dict[str, dict[str, Any]] = {
    "radius-noise": {"radius_noise": 3e-4},
    "gain": {"gain": [0.85, 1.15]},
    "hysteresis": {"hysteresis": EVERY_KNOB["hysteresis"]},
    "crosstalk": {"crosstalk": EVERY_KNOB["crosstalk"]},
    "delay-1-call": {"read_delay": 0.01},
    "delay-3-calls": {"read_delay": 0.01, "jitter": 0.02},
    "bias": {"bias": 0.01},
    "white-noise": {"white_noise": 5e-3},
    "drift": {"drift": 1e-4},
    "quantization": {"quantization": 1e-2},
    "dead-taxels": {"dead_probability": 0.05, "dead_range": [0.0, 1.0]},
}
"""Noise terms timed separately; calls are `DT` apart."""


@dataclass(frozen=True)
class Case:
    """A document to time: sensors of one kind on flat pads, under a tower of cubes.

    Attributes:
        name: Name of the row.
        kind: Kind of the sensors.
        envs: Numbers of environments; code is compiled for the first and serves the others.
        num_taxels: Taxels of each pad.
        num_pads: Pads in a row, each with a separate sensor; each object covers all pads.
        num_objects: Stacked cubes, all felt by every sensor.
        points: Points sampled on each object; 0 for none.
        contacts: Contacts of each pad and object, in the first of eight slots; a resting cube has four.
        noise: "clean", "noisy" (the profile), "full" (`EVERY_KNOB`) or one of `KNOBS`.
        fields: Fields of the sensor that override `KINDS`.
    """

    name: str
    kind: str
    envs: tuple[int, ...] = (MAIN,)
    num_taxels: int = 100
    num_pads: int = 1
    num_objects: int = 1
    points: int = 0
    contacts: int = 4
    noise: str = "clean"
    fields: dict[str, Any] = field(default_factory=dict)

    @property
    def pads(self) -> list[str]:
        """Names of the bodies that carry taxels."""
        return [f"pad{i}" for i in range(self.num_pads)]

    @property
    def objects(self) -> list[str]:
        """Names of the bodies that the sensors feel."""
        return [f"cube{i}" for i in range(self.num_objects)]


def _kinematic(name: str, **fields: Any) -> Case:
    return Case(f"kinematic-{name}", "kinematic_taxel", **fields)


def _elastomer(points: int, *envs: int) -> Case:
    return Case(f"elastomer-{points}-points", "elastomer", envs, points=points, fields={"points": points})


def _proximity(points: int, *envs: int) -> Case:
    return Case(f"proximity-{points}-points", "proximity", envs, points=points, fields={"backend": "points", "points": points})


_LIMITED = (
    Case("depth", "contact_depth", SWEPT),
    Case("kinematic", "kinematic_taxel", SWEPT),
    _kinematic("full", envs=SWEPT, noise="full"),
    _kinematic("noisy", envs=SWEPT, noise="noisy"),
    _kinematic("10-objects", num_objects=10),
    _kinematic("5-sensors", num_pads=5),
    _kinematic("1000-taxels", envs=(MAIN, 1_024, 20_480), num_taxels=1_000),
    _kinematic("10000-taxels", envs=(1_024,), num_taxels=10_000),
    Case("proximity", "proximity", SWEPT),
    Case("force", "force_taxel", SWEPT),
    _elastomer(500, *SWEPT),
    _elastomer(1_000, MAIN, 1_024),
)
_SWEEPS = (
    Case("contact", "contact"),
    Case("distance", "surface_distance"),
    Case("link-contact", "link_contact"),
    Case("force-8-contacts", "force_taxel", contacts=8),
    *(_kinematic(f"{n}-objects", num_objects=n) for n in (2, 4, 8, 16)),
    _kinematic("10-taxels", envs=(1_024,), num_taxels=10),
    *(_kinematic(f"{n}-taxels-noisy", envs=(1_024,), num_taxels=n, noise="noisy") for n in (10, 1_000, 10_000)),
    _proximity(500, MAIN, 1_024),
    *(_proximity(n, 1_024) for n in (5_000, 100_000)),
    *(_elastomer(n, 1_024) for n in (10_000, 100_000)),
    *(Case(f"{kind}-full", kind, noise="full") for kind in KINDS if kind != "kinematic_taxel"),
    *(_kinematic(knob, noise=knob) for knob in KNOBS),
)
CASES = {case.name: case for case in (*_LIMITED, *_SWEEPS)}
"""All cases: those with limits, then the sweeps."""


# Documents ------------------------------------------------------------------------------------------------------------------


def scene(case: Case) -> str:
    """Return the MJCF of a case."""
    middle = 0.5 * PITCH * (case.num_pads - 1)
    length = middle + HALF
    bodies = [
        f'<body name="{name}" pos="{PITCH * i} 0 0"><geom type="box" size=".03 .03 {TOP}"/></body>'
        for i, name in enumerate(case.pads)
    ]
    bodies += [
        f'<body name="{name}" pos="{middle} 0 {TOP + HALF * (2 * i + 1)}"><freejoint/>'
        f'<geom type="box" size="{length} {HALF} {HALF}"/></body>'
        for i, name in enumerate(case.objects)
    ]
    return f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>"


def document(case: Case, folder: Path) -> dict[str, Any]:
    """Return the document of a case; write its scene to a folder."""
    model = folder / "scene.xml"
    model.write_text(scene(case))
    rows, columns = GRIDS[case.num_taxels]
    radius = 0.01 if case.kind == "proximity" else 0.004
    grid = {"method": "grid", "rows": rows, "columns": columns, "direction": [0, 0, -1], "radius": radius}
    sensor = {"kind": case.kind, "feels": case.objects, **KINDS[case.kind], **case.fields, **noise_of(case)}
    if sensor.get("backend") == "points":
        del sensor["tolerance"]
    return {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": {"resolutions": {"r": dict.fromkeys(case.pads, grid)}}},
        "objects": {name: {"body": name} for name in case.objects},
        "sensors": {f"on_{pad}": {"links": pad, **sensor} for pad in case.pads},
    }


def noise_of(case: Case) -> dict[str, Any]:
    """Return the `noise` field of a case's sensors; nothing if they are clean."""
    if case.noise == "clean":
        return {}
    if case.noise == "noisy":
        return {"noise": "noisy"}
    if case.noise in KNOBS:
        return {"noise": KNOBS[case.noise]}
    kind = next(kind for kind in TGDSL_KINDS if kind.name == case.kind)
    knobs = EVERY_KNOB | ({"quantization": FINE[case.kind]} if case.kind in FINE else {})
    return {"noise": {knob: value for knob, value in knobs.items() if knob in kind.knobs - kind.idle_knobs}}


def artefact(folder: Path, case: Case) -> Path:
    """Return the path of a case's artefact."""
    return folder / f"{case.name}.safetensors"


def make_artefacts(folder: Path, cases: list[Case]) -> None:
    """Compile cases to artefacts."""
    folder.mkdir(parents=True, exist_ok=True)
    for case in cases:
        path = artefact(folder, case)
        start = time.perf_counter()
        with TemporaryDirectory() as scratch:
            size = tgdsl.save(tgdsl.compile(document(case, Path(scratch))), path)
        print(f"{path.name:<44}{size / 2**20:8.2f} MiB{time.perf_counter() - start:8.1f} s", flush=True)


# States ---------------------------------------------------------------------------------------------------------------------


def state_of(touch: TactileModule, num_envs: int, seed: int, contacts: int = 4) -> SceneState:
    """Return random float32 states (env) on the module's device: the lowest cube rests on the pads, ± 0.3 mm and 1°.

    Each pair has `contacts` contacts.
    """
    state = touch.example_state(num_envs, seed=seed, dtype=torch.float32, spread=0.0003)
    assert state.body_pos is not None and state.body_quat is not None
    state.body_quat[:] = 0.02 * state.body_quat
    state.body_quat[..., 0] += 1
    state.body_quat /= state.body_quat.norm(dim=-1, keepdim=True)
    bodies = touch.inputs.bodies
    num_pads = sum(name.startswith("pad") for name in bodies)
    for b, name in enumerate(bodies):
        if name.startswith("pad"):
            state.body_pos[:, b] = torch.tensor([PITCH * int(name[3:]), 0.0, 0.0])
        else:
            height = TOP + HALF * (2 * int(name[4:]) + 1)
            state.body_pos[:, b, :2] *= 4
            state.body_pos[:, b] += torch.tensor([0.5 * PITCH * (num_pads - 1), 0.0, height])
    if state.contact_pos is not None:
        assert state.contact_force is not None and state.contact_torque is not None and state.contact_normal is not None
        state.contact_pos = _on_pads(touch, state.contact_pos, seed)
        used = torch.arange(8, device=state.contact_pos.device)[:, None] < contacts
        for vectors in (state.contact_force, state.contact_torque, state.contact_normal, state.contact_pos):
            vectors.copy_(torch.where(used, vectors[:, :, [0, 1, 3, 4, 6, 7, 0, 1]], 0.0))  # the third and sixth are empty
    return state


def _on_pads(touch: TactileModule, pos: Tensor, seed: int) -> Tensor:
    """Return contact points spread over the pads' surfaces, (env, pair, slot, 3) [m]."""
    noise = torch.randn(pos.shape, generator=torch.Generator().manual_seed(seed + 1_000)).to(pos.device)
    middle = torch.tensor([[PITCH * int(pair.link[3:]), 0.0, TOP] for pair in touch.inputs.pairs], device=pos.device)
    return middle[:, None] + noise * torch.tensor([0.012, 0.012, 0.0003], device=pos.device)


# Bytes ----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bytes:
    """Bytes per environment that a call moves and a module holds, without the constants that environments share.

    Attributes:
        inputs: Fields of the scene's state.
        outputs: Readings.
        state: Module memory without anchors and rings; it includes the clock's counts of each environment.
        anchors: Anchors of elastomers.
        ring_entry: One call in the rings of delays.
        ring_calls: Number of calls that the rings hold [1].
        num_taxels: Taxels (bodies for `link_contact`) of all sensors [1].
        num_anchors: Points or taxels that can be anchored [1].
    """

    inputs: int
    outputs: int
    state: int
    anchors: int
    ring_entry: int
    ring_calls: int
    num_taxels: int
    num_anchors: int

    @property
    def moved(self) -> int:
        """Bytes that a call must move: read inputs, write readings, read and write state; read two ring entries, write one."""
        return self.inputs + self.outputs + 2 * (self.state + self.anchors) + 3 * self.ring_entry

    @property
    def held(self) -> int:
        """Bytes of inputs, readings and the whole memory."""
        return self.inputs + self.outputs + self.state + self.anchors + self.ring_calls * self.ring_entry

    @property
    def per_taxel(self) -> float:
        """Readings and state per taxel, without rings and anchors."""
        return (self.outputs + self.state) / self.num_taxels

    @property
    def ring_per_taxel(self) -> float:
        """The ring of delays per taxel."""
        return self.ring_calls * self.ring_entry / self.num_taxels

    @property
    def per_anchor(self) -> float:
        """Bytes per anchor; 0 without anchors."""
        return self.anchors / self.num_anchors if self.num_anchors else 0.0


def bytes_of(touch: TactileModule) -> Bytes:
    """Count the bytes of a float32 module whose calls are `DT` apart, from the tensors that it reads and allocates."""
    if any(sensor.windows for sensor in touch.plan.sensors):
        raise ValueError("stacked readings are not supported here, expected sensors without `history`")
    state = touch.example_state(2, dtype=torch.float32)
    inputs = [value for name in touch.inputs.fields if isinstance(value := getattr(state, name), Tensor)]
    fresh = TactileModule(touch.plan)
    memory = fresh.memory.tensors(2, DT if "dt" in touch.inputs.fields else None, torch.float32, torch.device("cpu"))
    sizes = {"state": 0, "anchors": 0, "ring": 0}
    ring_calls = num_anchors = 0
    for path, value in memory.items():
        sensor, name = path.rsplit(":", 1) if ":" in path else ("", path)
        size = value[:1].numel() * value.element_size() if value.ndim else 0
        planned = next((s.state[name] for s in touch.plan.sensors if s.name == sensor), None)
        if planned is None:
            sizes["state"] += size if path.removeprefix("clock/") in COUNTS else 0
        elif planned.past:
            ring_calls = max(ring_calls, value.shape[1])
            sizes["ring"] += size // value.shape[1]
        else:
            sizes["anchors" if name in ANCHORS else "state"] += size
            num_anchors += math.prod(planned.shape) if name == ANCHORS[0] else 0
    return Bytes(
        inputs=sum(value[:1].numel() * value.element_size() for value in inputs),
        outputs=4 * sum(math.prod(output.shape) for output in touch.outputs),
        state=sizes["state"],
        anchors=sizes["anchors"],
        ring_entry=sizes["ring"],
        ring_calls=ring_calls,
        num_taxels=sum(sensor.readings[0].num_rows for sensor in touch.plan.sensors),
        num_anchors=num_anchors,
    )
