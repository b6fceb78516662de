"""Scenes and modules for `physics.py`, and their artefacts."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tgdsl
from tgdsl.sensors import KINDS as TGDSL_KINDS

EXAMPLES = Path(__file__).parent.parent / "examples"
KINDS: dict[str, dict[str, Any]] = {
    "contact_depth": {"kind": "contact_depth"},
    "contact": {"kind": "contact", "threshold": 5e-4, "release_threshold": 2e-4},
    "kinematic_taxel": {"kind": "kinematic_taxel"},
    "proximity": {"kind": "proximity", "tolerance": 0.05},
    "proximity, 500 points": {"kind": "proximity", "backend": "points", "points": 500},
    "force_taxel": {"kind": "force_taxel"},
    "link_contact": {"kind": "link_contact"},
    "elastomer": {"kind": "elastomer", "anchors": "points", "points": 500},
    "surface_distance": {"kind": "surface_distance"},
}
"""Every kind of sensor. 500 points as in the paper's speed tests; the field is as accurate as 5,000 points."""
FIVE = ("contact_depth", "contact", "kinematic_taxel", "proximity", "elastomer")
"""The paper's kinds."""
CONTACT_KINDS = ("contact_depth", "contact", "kinematic_taxel", "force_taxel", "link_contact", "elastomer")
"""The kinds that read contact."""
EVERY_KNOB: dict[str, Any] = {
    "read_delay": 0.01,
    "jitter": 0.02,
    "bias": [-0.01, 0.01],
    "white_noise": [2e-3, 8e-3],
    "drift": 1e-4,
    "gain": [0.85, 1.15],
    "quantization": 1e-4,
    "hysteresis": {"strength": 0.5, "time_constant": 0.05},
    "dead_probability": 0.05,
    "dead_range": [0.0, 1.0],
    "crosstalk": {"strength": 0.3, "sigma": 3e-3},
    "radius_noise": 3e-4,
}
"""All knobs of noise; each kind takes those that it supports."""
MODULES: dict[str, tuple[tuple[str, ...], Any]] = {
    **{name: ((name,), None) for name in KINDS},
    "five kinds": (FIVE, None),
    "kinematic_taxel, noisy": (("kinematic_taxel",), "noisy"),
    "kinematic_taxel, every knob": (("kinematic_taxel",), EVERY_KNOB),
    "five kinds, noisy": (FIVE, "noisy"),
    "contact kinds, every knob": (CONTACT_KINDS, EVERY_KNOB),
}
"""Sensors and noise of each module."""
PLAIN = "surface_distance"
"""A module that needs no contacts: its simulator, stepped without reading, is the step without sensors."""


@dataclass(frozen=True)
class Scene:
    """A document, and the settings of its simulation."""

    document: str
    resolution: str
    links: str
    feels: tuple[str, ...]
    keyframe: str | None
    substeps: int
    nconmax: int
    njmax: int
    is_pyramidal: bool = False
    left_out: tuple[str, ...] = ()

    @property
    def modules(self) -> list[str]:
        """Modules to time on the scene."""
        return [name for name in MODULES if name not in self.left_out]


_HAND = Scene("xhand1_palm.yaml", "med", "hand", ("cube",), "rest", 5, 40, 160)
_FINE = replace(_HAND, resolution="high", left_out=("five kinds, noisy",))  # radius noise needs 100 MiB of fields
SCENES = {
    "pyramid": Scene("pyramid.yaml", "grid", "sensor", ("left", "right"), None, 1, 96, 384),
    "hand-med": _HAND,
    "hand-high": _FINE,
    "hand-med-pyramidal": replace(_HAND, is_pyramidal=True),
    "hand-high-pyramidal": replace(_FINE, is_pyramidal=True),
}


def artefact(folder: Path, scene: Scene, module: str) -> Path:
    """Return the path of a module's artefact; scenes that differ only in the cone share it."""
    name = "".join(c if c.isalnum() else "_" for c in module)
    return folder / f"{scene.document.removesuffix('.yaml')}-{scene.resolution}-{name}.safetensors"


def sensors(scene: Scene, module: str) -> dict[str, Any]:
    """Return the `sensors` of a module's document."""
    names, noise = MODULES[module]
    result = {}
    for i, name in enumerate(names):
        sensor = {**KINDS[name], "links": scene.links, "feels": list(scene.feels)}
        if isinstance(noise, dict):
            kind = next(kind for kind in TGDSL_KINDS if kind.name == sensor["kind"])
            sensor["noise"] = {knob: value for knob, value in noise.items() if knob in kind.knobs - kind.idle_knobs}
        elif noise is not None:
            sensor["noise"] = noise
        result[f"s{i}"] = sensor
    return result


def make_artefacts(folder: Path) -> None:
    """Compile every module of every scene that has no artefact yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for scene in SCENES.values():
        for module in scene.modules:
            path = artefact(folder, scene, module)
            if path.exists():
                continue
            start = time.perf_counter()
            changes = {"sensors": json.dumps(sensors(scene, module)), "observations": "{}"}
            touch = tgdsl.compile(EXAMPLES / scene.document, resolution=scene.resolution, overrides=changes)
            size = tgdsl.save(touch, path)
            print(f"{path.name:<70}{size / 2**20:8.2f} MiB{time.perf_counter() - start:8.1f} s", flush=True)
