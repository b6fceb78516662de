"""Intervals of 95 % on recordings made with known parameters, noise and two clocks, for each kind that has parameters.

`PYTHONPATH=tests/helpers python tests/calibration/test_coverage.py 200` prints the share that holds in 200 sets of each.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from recorded_presses import SCENE, motion

import tgdsl
from tgdsl.calibration.recordings import velocities

LAG, NOISE, NUM = 0.12, 0.01, 25
"""How far the sensor's clock is behind the states' [s]; noise over the RMS of the reading; samples."""


class Case(NamedTuple):
    """A sensor as guessed, its true parameters, how far the ball is lower [m], and parameters that no reading tells apart."""

    sensor: dict[str, Any]
    true: dict[str, float]
    lower: float = 0.0
    untold: tuple[str, ...] = ()


STILL = {"normal_damping": 0, "shear_damping": 0, "outputs": ["force"]}
ELASTIC = {"shear_strength": 0, "youngs_modulus": 1e5, "normal_stiffness": 1e7}
MODULI = ("youngs_modulus", "normal_stiffness")
CASES = {
    "kinematic_taxel": Case(
        {"kind": "kinematic_taxel", **STILL, "normal_stiffness": 500, "depth_exponent": 1},
        {"normal_stiffness": 900, "depth_exponent": 1.3},
    ),
    "kinematic_taxel, loop": Case(
        {"kind": "kinematic_taxel", **STILL, "depth_exponent": 1, "loop": {"force": 0.3, "width": 2e-4}},
        {"normal_stiffness": 900, "loop.force": 0.5},
    ),
    "elastomer, gaussian": Case(
        {"kind": "elastomer", "shear_strength": 0, "dilation_falloff": 2e4, "dilation_strength": 80},
        {"dilation_falloff": 3e4, "dilation_strength": 100},
        3e-3,
    ),
    "elastomer, half_space": Case(
        {"kind": "elastomer", "kernel": "half_space", **ELASTIC, "poissons_ratio": 0.3, "marker_depth": 2e-3},
        {"poissons_ratio": 0.4, "marker_depth": 1.5e-3},
        3e-3,
        MODULI,
    ),
    "elastomer, bonded_layer": Case(
        {"kind": "elastomer", "kernel": "bonded_layer", **ELASTIC, "poissons_ratio": 0.3, "thickness": 4e-3},
        {"poissons_ratio": 0.4, "thickness": 3e-3},
        3e-3,
        MODULI,
    ),
}


def document(folder: Path, case: Case) -> Path:
    (folder / "scene.xml").write_text(SCENE)
    places = [(1e-3 * x, 1e-3 * y, 0.0) for x in (-4, 0, 3) for y in (-3, 0, 5)]
    points = {"method": "points", "radius": 4e-3, "points": [{"pos": place, "normal": [0, 0, 1]} for place in places]}
    content = {
        "tgdsl": 1,
        "robot": {"model": "scene.xml", "layout": {"resolutions": {"r": {"pad": points}}}},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"touch": {"links": "pad", "feels": ["ball"], "gate": "geometric", **case.sensor}},
    }
    (folder / "touch.yaml").write_text(json.dumps(content))
    return folder / "touch.yaml"


def recording(path: Path, case: Case, seed: int) -> dict[str, Any]:
    """Return poses on one clock, and on another what a sensor with the true parameters read, with noise."""
    states, clock = motion(1200), np.linspace(0.4, 2.6, NUM)
    states["body_pos"][:, 0, 2] -= case.lower
    touch = tgdsl.compile(path, dtype="float64", overrides={f"sensors.touch.{name}": v for name, v in case.true.items()})
    fields = {name: states[name] for name in ("body_pos", "body_quat")}
    fields |= velocities(states["time"], fields)
    now = {}
    for name in touch.inputs.fields:
        columns = fields[name].reshape(len(fields[name]), -1).T
        columns = np.stack([np.interp(clock, states["time"], column) for column in columns], axis=1)
        now[name] = torch.from_numpy(columns.reshape(NUM, *fields[name].shape[1:]))
    if touch.has_state:
        each = [touch(tgdsl.SceneState(**{n: v[i : i + 1] for n, v in now.items()}))["touch"].clone() for i in range(NUM)]
        target = torch.cat(each).numpy()
    else:
        target = touch(tgdsl.SceneState(**now))["touch"].numpy()
    noise = NOISE * np.sqrt((target**2).mean())
    target = target + np.random.default_rng(seed).normal(0.0, noise, target.shape)
    (output,) = touch.outputs
    of_target = {"target": target, "clock": clock + LAG, "clock_width": 0.2, "unit": output.units[0], "floor": noise}
    return states | {f"{key}:touch": value for key, value in of_target.items()}


def covered(folder: Path, case: Case, num: int) -> float:
    """Return how often intervals hold the true value."""
    path, hits = document(folder, case), []
    for seed in range(num):
        fit = tgdsl.calibrate(path, recording(path, case, seed), [f"touch.{name}" for name in case.true], starts=1)
        hits += [
            fit.parameters[f"touch.{name}"].low <= v <= fit.parameters[f"touch.{name}"].high for name, v in case.true.items()
        ]
    return float(np.mean(hits))


def test_intervals_cover_the_truth(tmp_path):
    """Of 4 sets: at most 2 of 8 intervals miss, of which 95 % should hold."""
    assert covered(tmp_path, CASES["elastomer, gaussian"], 4) >= 0.75


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_intervals_of_each_kind_cover_the_truth(tmp_path, case):
    """Of 8 sets: at most 3 of 16 intervals miss, which of intervals that hold 95 % happens in 99 of 100 runs."""
    assert covered(tmp_path, case, 8) >= 0.8


@pytest.mark.parametrize("case", [case for case in CASES.values() if case.untold], ids=lambda c: c.sensor["kernel"])
def test_what_no_reading_tells_apart_is_named(tmp_path, case):
    """Displacement depends on the ratio of the two moduli alone."""
    path = document(tmp_path, case)
    for seed in range(3):
        names = [f"touch.{name}" for name in case.untold]
        fit = tgdsl.calibrate(path, recording(path, case, seed), names, starts=1, intervals="none")
        assert any(all(f"touch.{name}" in text for name in case.untold) for text in fit.warnings), fit.warnings


if __name__ == "__main__":
    for name, each in CASES.items():
        with tempfile.TemporaryDirectory() as scratch:
            print(f"{name}: {covered(Path(scratch), each, int(sys.argv[1])):.3f}", flush=True)
