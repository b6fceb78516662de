"""Documents with one sensor that has noise."""

import pytest

from tgdsl.compiler.pipeline import compile_document
from tgdsl.errors import SpecError
from tgdsl.sensors import KINDS

SCENE = """
<mujoco><worldbody>
  <body name="a_tip"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="b_tip"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="palm"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="item"><freejoint/><geom type="sphere" size=".03"/></body>
  <body name="wheel"><joint name="wheel"/><geom size=".01"/></body>
</worldbody></mujoco>
"""
LINKS = ("a_tip", "b_tip", "palm")
STRUCK = {"modes": [{"frequency": 500.0, "decay": 10.0}]}
DEFAULTS = {
    "proximity": {"backend": "points", "points": 100},
    "temperature_grid": {"feels": [], "cells": [1, 1, 1], "material": "steel"},
    "contact_audio": STRUCK,
    "actuation_audio": {"joints": ["wheel"]},
    "microphone": {"pos": [0, 0, 1]},
}
"""What keeps compiling fast, or is needed."""
READ = {"microphone": {"struck": {"kind": "contact_audio", "links": "*", "feels": ["item"], **STRUCK}}}
"""Sensors that kinds read."""


def document(folder, kind: str, noise, profiles=None, observations=(), **sensor) -> dict:
    """A document with one sensor, `s`, on two taxels of each of three links."""
    (folder / "scene.xml").write_text(SCENE)
    points = [{"pos": [0.005 * i, 0, 0.01], "normal": [0, 0, 1]} for i in range(2)]
    layout = {name: {"method": "points", "points": points, "radius": "4 mm"} for name in LINKS}
    spec = next(own.spec for own in KINDS if own.name == kind)
    where = {name: value for name, value in {"links": "*", "feels": ["item"]}.items() if name in spec.model_fields}
    own = {"kind": kind, **where, "noise": noise, **DEFAULTS.get(kind, {}), **sensor}
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "scene.xml"),
            "layout": {"groups": {"tips": ["*_tip"]}, "resolutions": {"r": layout}},
        },
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": own, **READ.get(kind, {})},
        "noise": profiles or {},
        "observations": {name: [{"type": name, "of": "s"}] for name in observations},
    }


def planned(folder, *arguments, **keys):
    """Return the stages in the plan, and the values of their knobs."""
    plan = compile_document(document(folder, *arguments, **keys)).plan
    (sensor,) = (own for own in plan.sensors if own.name == "s")
    if sensor.noise is None:
        return (), {}
    return sensor.noise.terms, {name: plan.arrays[f"sensors/s/noise/{name}"] for name in sensor.noise.constants}


def mistakes(folder, *arguments, **keys) -> list[str]:
    with pytest.raises(SpecError) as caught:
        compile_document(document(folder, *arguments, **keys))
    return [f"{problem.path}: {problem.what}" for problem in caught.value.problems]
