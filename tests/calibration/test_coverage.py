"""Coverage of 95 % intervals on recordings with known parameters, noise and two clocks, for each kind.

`PYTHONPATH=tests/helpers python tests/calibration/test_coverage.py 200 [CASE …]` prints the coverage over 200 sets of each.

Kinds without a case: `contact` and `link_contact` read bits, which have no derivative; `contact_depth` and
`surface_distance` have no parameter that changes their values; the scraping of `contact_audio` is random. A fit of
`microphone` takes minutes, step by step. `proximity` is not tested. A cooling block of `temperature_grid` has a closed form.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from scipy import optimize, stats

import tgdsl
from tgdsl.calibration.recordings import NAMES_OF, velocities
from tgdsl.module.state import SHAPES

LAG, NOISE, NUM = 0.12, 0.01, 25
"""Lag of the sensor's clock behind the states' [s]; noise over the RMS of the reading; samples."""
SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01" pos="0 0 -.01"/></body>
  <body name="ball" pos="0 0 .05"><freejoint/><geom type="sphere" size=".03"/></body>
  <body name="arm" pos="0 .1 0"><joint name="hinge"/><geom size=".01" pos="0 .05 0"/></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>
"""


class Case(NamedTuple):
    """Guessed sensor; true parameters; how much lower the ball is [m]; unidentifiable parameters; sets of the slow test."""

    sensors: dict[str, dict[str, Any]]
    true: dict[str, float]
    lower: float = 0.0
    untold: tuple[str, ...] = ()
    num_tested: int = 6


def on_pad(kind: str, **keys: Any) -> dict[str, dict[str, Any]]:
    return {"touch": {"kind": kind, "links": "pad", "feels": ["ball"], **keys}}


STILL = {"gate": "geometric", "normal_damping": 0, "shear_damping": 0, "outputs": ["force"]}
SKIN = {"gate": "geometric", "shear_strength": 0}
ELASTIC = {**SKIN, "youngs_modulus": 1e5, "normal_stiffness": 1e7, "poissons_ratio": 0.3}
MODULI = ("touch.youngs_modulus", "touch.normal_stiffness")
WHINE = {
    "kind": "actuation_audio",
    "samples": 4,
    "friction": 0,
    "hum": 0,
    "pitch": 0.4,
    "partials": [1],
    "load": 1e-3,
    "power": 0,
}
CASES = {
    "kinematic_taxel": Case(
        on_pad("kinematic_taxel", **STILL, normal_stiffness=500, depth_exponent=1),
        {"touch.normal_stiffness": 900, "touch.depth_exponent": 1.3},
    ),
    "kinematic_taxel, loop": Case(
        on_pad("kinematic_taxel", **STILL, depth_exponent=1, loop={"force": 0.3, "width": 2e-4}),
        {"touch.normal_stiffness": 900, "touch.loop.force": 0.5},
        num_tested=1,
    ),
    "elastomer, gaussian": Case(
        on_pad("elastomer", **SKIN, dilation_falloff=2e4, dilation_strength=80),
        {"touch.dilation_falloff": 3e4, "touch.dilation_strength": 100},
        3e-3,
    ),
    "elastomer, half_space": Case(
        on_pad("elastomer", kernel="half_space", **ELASTIC, marker_depth=2e-3),
        {"touch.poissons_ratio": 0.4, "touch.marker_depth": 1.5e-3},
        3e-3,
        MODULI,
    ),
    "elastomer, bonded_layer": Case(
        on_pad("elastomer", kernel="bonded_layer", **ELASTIC, thickness=4e-3),
        {"touch.poissons_ratio": 0.4, "touch.thickness": 3e-3},
        3e-3,
        MODULI,
    ),
    "force_taxel": Case(
        on_pad("force_taxel", gate="geometric", footprint=8e-3, moment_iterations=0, slots=1), {"touch.footprint": 1e-2}, 3e-3
    ),
    "actuation_audio": Case({"touch": WHINE}, {"touch.load": 2e-3, "touch.pitch": 0.5}, num_tested=1),
}
QUICK = "elastomer, gaussian"
"""The case whose test is not slow."""


def document(folder: Path, case: Case) -> Path:
    (folder / "scene.xml").write_text(SCENE)
    places = [(1e-3 * x, 1e-3 * y, 0.0) for x in (-4, 0, 3) for y in (-3, 0, 5)]
    points = {"method": "points", "radius": 4e-3, "points": [{"pos": place, "normal": [0, 0, 1]} for place in places]}
    content = {
        "tgdsl": 1,
        "robot": {"model": "scene.xml", "layout": {"resolutions": {"r": {"pad": points}}}},
        "objects": {"ball": {"body": "ball"}},
        "sensors": case.sensors,
    }
    (folder / "touch.yaml").write_text(json.dumps(content))
    return folder / "touch.yaml"


def scene_states(lower: float, num: int = 1200) -> dict[str, np.ndarray]:
    """Return states of a ball that presses at varying depths and speeds and slides a bit, and of a driven arm."""
    time = np.linspace(0.0, 3.0, num)
    pos, quat = np.zeros((num, 3, 3)), np.zeros((num, 3, 4))
    pos[:, 0, 0] = 1e-3 * np.sin(2 * time)
    pos[:, 0, 2] = 0.034 - 1.2e-3 * (1 - np.cos(4 * time)) - 4e-4 * np.sin(9 * time) - lower
    pos[:, 2, 1] = 0.1
    quat[..., 0] = 1.0
    down, load = np.array([0.0, 0.0, -1.0]), 2.0 + np.sin(4 * time)
    contact = {
        "contact_pos": np.stack([pos[:, 0, 0], 0 * time, 0 * time], axis=1),
        "contact_force": load[:, None] * down,
        "contact_normal": np.tile(down, (num, 1)),
        "contact_torque": np.zeros((num, 3)),
    }
    fields = {name: value[:, None, None] for name, value in contact.items()}
    fields |= {"contact_netforce": contact["contact_force"][:, None], "contact_found": np.ones((num, 1))}
    fields |= {"joint_vel": 4 * np.cos(3 * time)[:, None], "joint_effort": 1 + 0.5 * np.sin(2 * time)[:, None]}
    return {"time": time, "body_pos": pos, "body_quat": quat, **fields}


def recording(path: Path, case: Case, seed: int) -> dict[str, Any]:
    """Return states on one clock, and noisy readings with the true parameters on another."""
    states, clock = scene_states(case.lower), np.linspace(0.4, 2.6, NUM)
    touch = tgdsl.compile(path, dtype="float64", overrides={f"sensors.{name}": value for name, value in case.true.items()})
    fields = states | velocities(states["time"], states)
    names, interpolated = {"body": ["ball", "pad", "arm"]}, {}
    for name in (name for name in touch.inputs.fields if name != "dt"):
        value, axis = fields[name], str(SHAPES[name][0])
        value = value[:, [names[axis].index(parts) for parts in touch.inputs.names[axis]]] if axis in names else value
        columns = value.reshape(len(value), -1).T
        columns = np.stack([np.interp(clock, states["time"], column) for column in columns], axis=1)
        interpolated[name] = torch.from_numpy(columns.reshape(NUM, *value.shape[1:]))
    if touch.has_state:
        dt = float(clock[1] - clock[0])
        parts = [
            touch(tgdsl.SceneState(**{n: v[i : i + 1] for n, v in interpolated.items()}, dt=dt))["touch"].clone()
            for i in range(NUM)
        ]
        target = torch.cat(parts).numpy()
    else:
        target = touch(tgdsl.SceneState(**interpolated))["touch"].numpy()
    noise = NOISE * np.sqrt((target**2).mean())
    target = target + np.random.default_rng(seed).normal(0.0, noise, target.shape)
    output = next(output for output in touch.outputs if output.name == "touch")
    of_target = {"target": target, "clock": clock + LAG, "clock_width": 0.2, "unit": output.units[0], "floor": noise}
    used = {name: states[name] for name in ("time", *touch.inputs.fields) if name in states}
    return used | {NAMES_OF["body"]: np.array(names["body"])} | {f"{key}:touch": value for key, value in of_target.items()}


def hits(folder: Path, case: Case, num: int) -> list[bool]:
    """Return which intervals of `num` sets contain the true value."""
    path, result = document(folder, case), []
    for seed in range(num):
        fit = tgdsl.calibrate(path, recording(path, case, seed), list(case.true), starts=1)
        result += [fit.parameters[name].low <= value <= fit.parameters[name].high for name, value in case.true.items()]
    return result


def assert_covered(held: list[bool]) -> None:
    """Assert that no more intervals miss than in 998 of 1000 runs with true 95 % coverage."""
    assert held.count(False) <= stats.binom.ppf(0.998, len(held), 0.05), held


def test_intervals_cover_the_truth(tmp_path):
    assert_covered(hits(tmp_path, CASES[QUICK], 4))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name != QUICK])
def test_intervals_of_each_kind_cover_the_truth(tmp_path, name):
    assert_covered(hits(tmp_path, CASES[name], CASES[name].num_tested))


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.untold])
def test_unidentifiable_parameters_are_named(tmp_path, name):
    """Displacement depends only on the ratio of the two moduli."""
    case = CASES[name]
    path = document(tmp_path, case)
    fit = tgdsl.calibrate(path, recording(path, case, 0), list(case.untold), starts=1, intervals="none")
    assert any(all(name in text for name in case.untold) for text in fit.warnings), fit.warnings


def cooling(path: Path) -> Path:
    """Write the document of a 24 mm aluminium cube at 60 °C in air of 22 °C: one cell without radiation."""
    path.with_name("scene.xml").write_text(SCENE.replace(".02 .02 .01", ".012 .012 .012"))
    sensor = {"kind": "temperature_grid", "links": "pad", "feels": ["ball"], "cells": [1, 1, 1], "material": "aluminium"}
    sensor |= {"temperature": "60 degC", "emissivity": 0, "convection": 15, "outputs": "mean"}
    objects = {"ball": {"body": "ball", "material": "steel"}}
    content = {"tgdsl": 1, "robot": {"model": "scene.xml"}, "objects": objects, "sensors": {"touch": sensor}}
    path.write_text(json.dumps(content))
    return path


@pytest.mark.slow
def test_convection_and_its_interval_match_the_closed_form(tmp_path):
    """T = T_a + (T_0 − T_a) exp(−U A t / C), U = 1 / (1/h + Δ/2k): least squares with Student's interval of one parameter."""
    path, true, num = cooling(tmp_path / "touch.yaml"), 20.0, 13
    edge, (conductivity, density, heat) = 0.024, (237.0, 2702.0, 903.0)  # Incropera
    time = 20.0 * np.arange(num)

    def temperature(film: float) -> np.ndarray:
        rate = 6.0 / (edge * density * heat) / (1.0 / film + edge / (2.0 * conductivity))
        return 22.0 + 38.0 * np.exp(-rate * time)

    read = temperature(true) + np.random.default_rng(0).normal(0.0, 0.5, num)
    inputs = tgdsl.compile(path).inputs
    fields = [name for name in inputs.fields if name != "dt"]
    still = {name: np.zeros((num, *(inputs.sizes.get(axis, axis) for axis in SHAPES[name]))) for name in fields}
    still["body_quat"][..., 0] = 1.0
    of_target = {"target:touch": read[:, None, None], "clock:touch": time, "unit:touch": "degC"}
    fit = tgdsl.calibrate(path, {"time": time, **still, **of_target}, ["touch.convection=5:80"], starts=1)
    closed_fit = optimize.least_squares(lambda film: temperature(film[0]) - read, [15.0])
    error = np.sqrt((closed_fit.fun**2).sum() / (num - 1) / (closed_fit.jac**2).sum())
    convection, half = fit.parameters["touch.convection"], stats.t.ppf(0.975, num - 1) * error
    assert convection.value == pytest.approx(closed_fit.x[0], rel=2e-3)
    assert (convection.low, convection.high) == pytest.approx((closed_fit.x[0] - half, closed_fit.x[0] + half), rel=5e-3)


if __name__ == "__main__":
    for name, each in CASES.items():
        if name in sys.argv[2:] or len(sys.argv) == 2:
            with tempfile.TemporaryDirectory() as scratch:
                print(f"{name}: {np.mean(hits(Path(scratch), each, int(sys.argv[1]))):.3f}", flush=True)
