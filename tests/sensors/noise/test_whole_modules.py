"""The noisy reading of a module equals the definition applied to its clean reading."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from noise_stages import ALL_TOGETHER, DT, NORMAL
from oracles.setups.signals import MM, ReferenceNoise

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.sensors.noise import Knobs, random

PADS = """
<mujoco><worldbody>
  <body name="a"><freejoint/><geom type="sphere" size=".02"/></body>
  <body name="b"><freejoint/><geom type="sphere" size=".02"/></body>
  <body name="item"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""


def pads(folder: Path, kind: str, noise: dict[str, Any], **sensor: Any) -> TactileModule:
    """Return a module with one sensor, `s`, on two bodies of 4 and 3 probes that reach 50 mm."""
    model = folder / "pads.xml"
    model.write_text(PADS)
    points = [{"pos": [x * MM, 0, 20 * MM], "normal": [0, 0, 1], "radius": "50 mm"} for x in range(4)]
    layout = {
        "resolutions": {"r": {"a": {"method": "points", "points": points}, "b": {"method": "points", "points": points[:3]}}}
    }
    document = {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": layout},
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": {"kind": kind, "links": ["a", "b"], "feels": ["item"], "noise": noise, "readout": "both", **sensor}},
    }
    return tgdsl.compile(document, dtype=torch.float64)


def definitions_of(touch: TactileModule, seed: int, rows: list[dict[str, Any]], num_envs: int, first: int = 0) -> list[Any]:
    sets, layout = [Knobs.model_validate(row) for row in rows], touch.plan.layout_of(touch.plan.sensors[0])
    key, channels = random.sensor_key(seed, "s"), touch.outputs[0].channels
    return [ReferenceNoise(sets, channels, key, first + env, layout) for env in range(num_envs)]


def test_a_module_matches_the_definition(tmp_path):
    on_b = {"hysteresis": {"strength": 0.2, "time_constant": 0.5}, "read_delay": [0, 3e-3], "drift": 1e-3, "gain": [2, 3]}
    common = {**ALL_TOGETHER, "white_noise": 1e-3}
    touch = pads(tmp_path, "kinematic_taxel", {**common, "links": {"b": on_b}}, gate="geometric").seed(5, first_env=100)
    definitions = definitions_of(touch, 5, [common] * 4 + [{**common, **on_b}] * 3, 3, first=100)
    scale = 0.0
    for call in range(30):
        for env in {6: [2], 7: [2], 15: [0, 1]}.get(call, []):
            touch.reset([env])
            definitions[env].reset()
        readings = touch(dataclasses.replace(touch.example_state(3, seed=call), dt=DT))
        clean, measured = readings["s/clean"].numpy(), readings["s"].numpy()
        expected = [d.read(d.gain * clean[env], DT) for env, d in enumerate(definitions)]
        scale = max(scale, np.abs(clean).max())
        np.testing.assert_allclose(measured, expected, rtol=0, atol=NORMAL)
    assert scale > 1


def test_a_module_disturbs_radii_first_and_holds_between_samples(tmp_path):
    """Depth is γ (R̃ − φ), clean depth R − φ; taxels are far inside. The sensor samples every fourth call."""
    noise = {"radius_noise": [1 * MM, 3 * MM], "gain": [0.5, 1.5], "bias": 0.1, "drift": 1e-3}
    touch = pads(tmp_path, "contact_depth", noise, gate="geometric", rate=1 / (4 * DT))
    definitions = definitions_of(touch, 0, [noise] * 7, 3)
    for call in range(21):
        if call == 10:
            touch.reset([1])
            definitions[1].reset()
        readings = touch(dataclasses.replace(touch.example_state(3, seed=call // 4, spread=1 * MM), dt=DT))
        if call == 10:
            assert not torch.equal(readings["s"][1], readings["s"][0])
        clean = readings["s/clean"].numpy()
        for env, definition in enumerate(definitions):
            since = call - 10 if env == 1 and call >= 10 else call
            is_sample = since % 4 == 0
            depth = clean[env] + (definition.radius(np.full(7, 50 * MM)) - 50 * MM)[:, None]
            expected = definition.read(definition.gain * depth, DT, is_sample)
            np.testing.assert_allclose(readings["s"][env].numpy(), expected, rtol=0, atol=NORMAL)


@pytest.mark.parametrize("name", ["foo_x", "y", "ball_y_z"])
def test_a_distance_is_named_by_its_object_whatever_the_names_end(tmp_path, name):
    """`distance_foo_x` names no component of `distance_foo`: module and definition agree."""
    model = tmp_path / "pads.xml"
    model.write_text(PADS)
    points = [{"pos": [0, 0, 20 * MM], "normal": [0, 0, 1], "radius": "50 mm"}]
    noise = {"bias": {f"distance_{name}": 0.25}, "white_noise": {f"distance_{name}": 1e-3}}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": {"resolutions": {"r": {"a": {"method": "points", "points": points}}}}},
        "objects": {name: {"body": "item"}},
        "sensors": {"s": {"kind": "surface_distance", "links": ["a"], "feels": [name], "noise": noise, "readout": "both"}},
    }
    touch = tgdsl.compile(document, dtype=torch.float64).seed(5)
    (definition,) = definitions_of(touch, 5, [noise], 1)
    readings = touch(dataclasses.replace(touch.example_state(1), dt=DT))
    read, clean = readings["s"][0].numpy(), readings["s/clean"][0].numpy()
    np.testing.assert_allclose(read, definition.read(clean, DT), rtol=0, atol=1e-12)
    assert np.abs(read - clean - 0.25).max() < 0.02
