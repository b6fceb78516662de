"""Documents with one sensor that has noise."""

import pytest

from tgdsl.compiler.pipeline import compile_plan
from tgdsl.errors import SpecError

SCENE = """
<mujoco><worldbody>
  <body name="a_tip"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="b_tip"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="palm"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="item"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
LINKS = ("a_tip", "b_tip", "palm")
DEFAULTS = {
    "proximity": {"backend": "points", "points": 100},
    "temperature_grid": {"feels": [], "cells": [1, 1, 1], "material": "steel"},
    "contact_audio": {"modes": [{"frequency": 500.0, "decay": 10.0}]},
}
"""What keeps compiling fast."""


def document(folder, kind: str, noise, profiles=None, observations=(), **sensor) -> dict:
    """A document with one sensor, `s`, on two taxels of each of three links."""
    (folder / "scene.xml").write_text(SCENE)
    points = [{"pos": [0.005 * i, 0, 0.01], "normal": [0, 0, 1]} for i in range(2)]
    layout = {name: {"method": "points", "points": points, "radius": "4 mm"} for name in LINKS}
    own = {"kind": kind, "links": "*", "feels": ["item"], "noise": noise, **DEFAULTS.get(kind, {}), **sensor}
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "scene.xml"),
            "layout": {"groups": {"tips": ["*_tip"]}, "resolutions": {"r": layout}},
        },
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": own},
        "noise": profiles or {},
        "observations": {name: [{"type": name, "of": "s"}] for name in observations},
    }


def planned(folder, *arguments, **keys):
    """Return the stages in the plan, and the values of their knobs."""
    plan = compile_plan(document(folder, *arguments, **keys))
    (sensor,) = plan.sensors
    if sensor.noise is None:
        return (), {}
    return sensor.noise.terms, {name: plan.arrays[f"sensors/s/noise/{name}"] for name in sensor.noise.constants}


def mistakes(folder, *arguments, **keys) -> list[str]:
    with pytest.raises(SpecError) as caught:
        compile_plan(document(folder, *arguments, **keys))
    return [f"{problem.path}: {problem.what}" for problem in caught.value.problems]
