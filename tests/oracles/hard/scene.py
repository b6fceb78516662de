"""A scene with objects of every primitive, and each kind as a sensor in it, with its float64 reference."""

import functools
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch

from oracles.setups.scenes import folder
from tgdsl.compiler.pipeline import compile_document
from tgdsl.errors import UnfeltWarning
from tgdsl.module.accuracy.reference import ReferenceModule, row_errors
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.plan.plan import Plan
from tgdsl.schema.load import load
from tgdsl.sensors import KINDS
from tgdsl.testing.reference import KnownReference

LINKS = ("palm", "tip")
OBJECTS = ("item", "tool", "floor")
STRUCK: Mapping[str, Any] = {
    "modes": [{"frequency": 310.0, "decay": 12.0, "gain": 2.0}, {"frequency": 845.0, "decay": 40.0, "gain": -1.0}],
    "timestep": 0.002,
    "samples": 32,
    "scrape": 0.0,
}
"""A sounding body without noise, because float64 noise is computed by series."""
SENSORS: Mapping[str, Mapping[str, Any]] = {
    "elastomer": {"standoff": 0.003, "friction": 0.6},
    "proximity": {"tolerance": 0.04},
    "temperature_grid": {"cells": [3, 2, 2], "material": "copper", "emissivity": 0.5, "convection": 20.0},
    "kinematic_taxel": {"friction_cone": 0.5, "balance": "solver", "slots": 2},
    "link_contact": {"outputs": ["contact", "force", "normal_force"]},
    "contact_audio": STRUCK,
    "actuation_audio": {"joints": ["wheel"], "samples": 8, "friction": 0.0},
    "microphone": {"body": "palm", "pos": [0.01, 0.0, 0.02], "speed": 100.0, "reach": 5.0, "nearest": 0.02},
}
"""Fields of kinds that differ from the defaults or are required."""
READ: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "microphone": {"struck": {"kind": "contact_audio", "links": list(LINKS), "feels": list(OBJECTS), **STRUCK}}
}
"""Sensors that kinds read."""
HEAT: Mapping[str, Mapping[str, Any]] = {
    "item": {"material": "aluminium", "temperature": 45.0},
    "tool": {"material": "rubber", "temperature": -5.0},
    "floor": {"material": "wood"},
}
"""Materials of objects, for kinds that conduct heat."""
SCENE = """
<mujoco model="hard">
  <worldbody>
    <body name="palm"><freejoint/>{inertia}<geom name="palm" type="box" size="{s30} {s20} {s10}"/></body>
    <body name="tip"><freejoint/>{inertia}<geom name="tip" type="sphere" size="{s12}"/></body>
    <body name="item"><freejoint/>{inertia}
      <geom type="box" size="{s20} {s15} {s25}"/>
      <geom type="sphere" size="{s15}" pos="{s20} {s10} {s30}"/>
      <geom type="capsule" size="{s8} {s20}" pos="-{s20} 0 -{s20}" euler="40 10 0"/>
    </body>
    <body name="tool"><freejoint/>{inertia}
      <geom type="cylinder" size="{s12} {s30}"/>
      <geom type="ellipsoid" size="{s20} {s12} {s16}" pos="0 0 {s35}" euler="0 25 70"/>
    </body>
    <body name="wheel" pos="0 0 1">{inertia}<joint name="wheel" type="hinge"/></body>
    <body name="floor" pos="0 0 -{s20}"><geom type="plane" size="1 1 .1"/></body>
  </worldbody>
  <actuator><motor joint="wheel"/></actuator>
</mujoco>
"""
INERTIA = '<inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>'
"""Mass of every body, whatever its size."""
MILLIMETRES = (8, 10, 12, 15, 16, 20, 25, 30, 35)


class Pair(NamedTuple):
    """A module with one sensor, `s`, and its reference.

    Attributes:
        module: The module.
        reference: The module by the kind's float64 definition.
    """

    module: TactileModule
    reference: ReferenceModule


@contextmanager
def quiet() -> Iterator[None]:
    """Ignore warnings that hard cases provoke: unreachable taxels, more contacts than slots, non-finite poses."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfeltWarning)
        warnings.filterwarnings("ignore", "contacts of ")
        warnings.filterwarnings("ignore", ".* usually at ")
        warnings.filterwarnings("ignore", "poses of bodies are not finite")
        yield


def taxels(num: int, seed: int, scale: float = 1.0) -> list[dict[str, Any]]:
    """Return taxels all over a link-sized ball, some inactive; lengths are multiplied by a scale."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(num, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    sizes = scale * 0.02 * rng.uniform(0.2, 1, num)
    return [
        {"pos": (size * way).tolist(), "normal": way.tolist(), "radius": 0.0 if i % 7 == 3 else scale * 0.004}
        for i, (size, way) in enumerate(zip(sizes, ways, strict=True))
    ]


def fields_of(kind: str) -> dict[str, Any]:
    """Return a kind's sensor."""
    spec = next(known for known in KINDS if known.name == kind).spec
    where = {"links": list(LINKS), "feels": list(OBJECTS)}
    fields = {name: value for name, value in where.items() if name in spec.model_fields}
    return {"kind": kind, **fields, **SENSORS.get(kind, {})}


@functools.lru_cache(maxsize=64)
def _planned(kind: str, scale: float) -> tuple[Plan, Mapping[str, Any]]:
    """Return a kind's plan, and the specs of its sensors."""
    sizes = {f"s{n}": f"{1e-3 * scale * n:.17g}" for n in MILLIMETRES}
    with folder() as where, quiet():
        path = where / "scene.xml"
        path.write_text(SCENE.format(inertia=INERTIA, **sizes), encoding="utf-8")
        layout = {
            "palm": {"method": "points", "points": taxels(12, 1, scale)},
            "tip": {"method": "points", "points": taxels(6, 2, scale)},
        }
        made_of = HEAT if kind == "temperature_grid" else {}
        document = {
            "tgdsl": 1,
            "robot": {"model": str(path), "layout": {"resolutions": {"r": layout}}},
            "objects": {name: {"body": name, **made_of.get(name, {})} for name in OBJECTS},
            "sensors": {"s": fields_of(kind), **READ.get(kind, {})},
        }
        return compile_document(document).plan, load(document).spec.sensors


def pair_of(kind: str, dtype: torch.dtype, scale: float = 1.0) -> Pair:
    """Return a kind's module and its reference at the start of an episode; all lengths are multiplied by a scale."""
    plan, specs = _planned(kind, scale)
    kinds = {known.name: known for known in KINDS}
    read = {name: (kinds[fields["kind"]], specs[name]) for name, fields in READ.get(kind, {}).items()}
    answers = _answers_of(kind, scale)
    return Pair(TactileModule(plan, KINDS, dtype), KnownReference(answers, plan, kinds[kind], specs["s"], read, "s"))


@functools.lru_cache(maxsize=64)
def _answers_of(kind: str, scale: float) -> dict[bytes, Any]:
    """Return the cache of the reference's answers, which both precisions share."""
    return {}


def worst_of(pair: Pair, state: SceneState, truth: SceneState | None = None, enough: float = 0.0) -> float:
    """Return the largest error of a reading over full scale; infinite if only the reading is not finite.

    The reference reads `truth`, or the same state. Errors up to `enough` need no check of the other sides of ties.
    """
    with quiet():
        errors = row_errors(pair.module(state)["s"], pair.reference, truth or state, enough)
    return float(np.where(np.isnan(errors), np.inf, errors).max())
