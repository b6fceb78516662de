"""Hard cases of temperatures: any step, conductivity and area; resets with a lag; rotated links; energy."""

import itertools
from functools import cache, partial
from typing import Any

import numpy as np
import torch

from oracles.hard import case
from oracles.setups.boxes import begin, heat_module, heat_state
from oracles.setups.scenes import compiled, folder, temporary
from tgdsl.fields.materials import MATERIALS
from tgdsl.module.module import TactileModule

STEPS = (1e-4, 0.01, 1.0, 10.0)
"""Seconds between calls."""
ONE_CONTACT = [((0, 0, 0.005), (0, 0, -1), 2.0)]
GRID = list(itertools.product(STEPS, (0.1, 400.0), (1e-9, 1e-5, 1e-2)))
"""Step [s], conductivity [W/(m·K)] and contact area [m²]."""
hard = partial(case.hard, "heat")


OBJECTS = ("hot", "cold", "plate")


@cache
def _with_three_objects(k: float, area: float, dtype: torch.dtype) -> TactileModule:
    objects: dict[str, Any] = {
        "hot": ([0.03] * 3, {"material": {"like": "copper", "conductivity": k}, "temperature": 80.0}),
        "cold": ([0.01] * 3, {"material": "rubber", "temperature": -20.0, "cells": [2, 2, 2]}),
        "plate": (None, {"material": "steel", "temperature": 10.0}),
    }
    sensor = {
        "cells": [2, 3, 2], "material": {"like": "steel", "conductivity": k}, "contact_area": area, "convection": 50.0,
        "emissivity": 0.9,
    }  # fmt: skip
    return temporary(heat_module, {"tip": [0.01, 0.012, 0.008]}, sensor, objects, dtype)


def _beyond(dt: float, k: float, area: float, dtype: torch.dtype, rng: np.random.Generator) -> float:
    """Return how far temperatures of a link and three objects leave their initial range, −20 to 80 °C [K]."""
    pairs = zip(OBJECTS, np.eye(3), strict=True)
    contacts = {("tip", name): [(tuple(rng.uniform(-5e-3, 5e-3, 3)), tuple(n), 1.0)] for name, n in pairs}
    module, worst = _with_three_objects(k, area, dtype), 0.0
    module.reset()
    state = heat_state(module, dt, contacts)
    begin(module, state)
    for _ in range(4):
        readings = module(state)
        every = torch.cat([readings["heat"][0, :, 0], readings["heat/objects"][0, :, 0]]).double()
        worst = max(worst, float(-20.0 - every.min()), float(every.max() - 80.0))
        worst = worst if torch.isfinite(every).all() else np.inf
    return worst


@hard(
    "conduction for any step, conductivity and area", "an explicit step that overshoots", "the range of all bodies", "K",
    [f"{dt:g} s, {k:g} W/mK, {area:g} m²" for dt, k, area in GRID], float64=1e-10, float32=3e-5, defects=(13,),
)  # fmt: skip
def bounds(dtype: torch.dtype):
    rng = np.random.default_rng(1)
    return [_beyond(dt, k, area, dtype, rng) for dt, k, area in GRID]


@hard(
    "energy of a pair in contact", "heat is made by the step", "what was there at first", "of the heat",
    {f"{dt:g} s": dt for dt in STEPS}, float64=1e-12, float32=1e-5, defects=(13,),
)  # fmt: skip
def energy(dtype: torch.dtype, dt: float):
    ball = {"material": "rubber", "temperature": 45.0, "cells": [2, 2, 2]}
    sensor = {"cells": [2, 2, 2], "material": "steel", "contact_area": "20 mm2", "temperature": 60.0}
    module = temporary(heat_module, {"tip": [0.01] * 3}, sensor, {"ball": ([0.02] * 3, ball)}, dtype)
    state = heat_state(module, dt, {("tip", "ball"): ONE_CONTACT})
    totals, flows = [], []
    for _ in range(20):
        readings = module(state)
        link, other = readings["heat/heat"][..., 0].double(), readings["heat/objects"][..., 1].double()
        totals.append(float(link.sum() + other.sum()))
        flows.append(float(other.sum()))
    return (max(totals) - min(totals)) / abs(totals[0]) if flows[-1] != flows[0] else np.inf


@hard(
    "a reset with a sensor's lag", "the filter starts from zero, or all environments do", "the link's temperature", "K",
    {f"{lag:g} s": lag for lag in (0.1, 2.0, 100.0)}, defects=(14, 16),
)  # fmt: skip
def reset_with_lag(dtype: torch.dtype, lag: float):
    sensor = {"cells": [1, 2, 1], "material": "aluminium", "temperature": 60.0, "convection": 900.0, "lag": lag}
    module = temporary(heat_module, {"block": (0.02, 0.03, 0.04)}, sensor, dtype=dtype)
    state = heat_state(module, 0.5, num_envs=3)
    for _ in range(5):
        before = module(state)["heat"].clone()
    module.reset([1])
    after = module(state)["heat"]
    others_go_on = bool((after[[0, 2]] < before[[0, 2]]).all())
    return float((after[1] - 60.0).abs().max()) if others_go_on else np.inf


@hard(
    "cells of a turned link", "a box in the world's axes, of a negative volume", "P t/ρcV", "of the rise",
    {f"{angle}°": angle for angle in (0, 45, 110, 200, 359)}, float64=1e-11, float32=1e-5, defects=(12,),
)  # fmt: skip
def turned_links(dtype: torch.dtype, angle: float):
    steel = MATERIALS["steel"]
    exact = 0.5 * 5.0 / (steel.density * steel.specific_heat * 6e-6)
    with folder() as where:
        (where / "turned.xml").write_text(
            '<mujoco><worldbody><body name="block" euler="10 20 30"><freejoint/>'
            f'<body name="tip" euler="0 {angle} 0"><joint axis="1 0 0"/><geom type="box" size=".005 .01 .015"/></body>'
            '<geom size=".01" contype="0" conaffinity="0"/></body></worldbody></mujoco>',
            encoding="utf-8",
        )
        fields = {"cells": [2, 2, 3], "material": "steel", "source": {"power": 0.5}}
        sensor = {"kind": "temperature_grid", "links": "tip", "feels": [], **fields}
        document = {"tgdsl": 1, "robot": {"model": str(where / "turned.xml")}, "sensors": {"heat": sensor}}
        module = compiled(document, dtype)
    state = heat_state(module, 0.1)
    for _ in range(51):
        readings = module(state)
    return float((readings["heat"].double() - 22.0 - exact).abs().max()) / exact
