"""Artefacts that were edited by hand and rehashed: indices of what is not there are refused by name when they are loaded."""

import dataclasses
import re

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.compiler.pipeline import compile_plan
from tgdsl.errors import ArtifactError
from tgdsl.module.artifact import save_plan
from tgdsl.plan import tree
from tgdsl.plan.plan import Plan

SCENE = """<mujoco>
  <asset><mesh name="block" vertex="-1 -1 -1 1 -1 -1 -1 1 -1 -1 -1 1 1 1 1" scale=".02 .02 .02"/></asset>
  <worldbody>
    <body name="pad"><joint name="one" axis="1 0 0"/><joint name="two" axis="0 1 0"/>
      <geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="tip" pos="0 .1 0"><joint axis="1 0 0"/><geom type="mesh" mesh="block"/></body>
    <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
    <body name="rock" pos="0 .1 .03"><freejoint/><geom type="mesh" mesh="block"/></body>
    <body name="ball" pos="1 0 .03"><freejoint/><geom size=".02"/></body>
  </worldbody>
  <actuator><motor joint="one"/><motor joint="two"/></actuator>
</mujoco>
"""
GRID = {"method": "grid", "rows": 4, "columns": 4, "direction": [0, 0, -1], "radius": 0.004}
POINTS = {"method": "points", "radius": 0.004, "points": [{"pos": [0, 0, 0.02], "normal": [0, 0, 1]}] * 3}
FEELS = {"links": "*", "feels": ["cube", "rock", "ball"]}
VARIANTS = [
    {"geoms": [{"type": "sphere", "size": [0.02], "density": 1000}]},
    {
        "geoms": [
            {"type": "sphere", "size": [0.01], "density": 1000},
            {"type": "box", "size": [0.01, 0.01, 0.01], "pos": [0, 0, 0.02], "density": 1000},
        ]
    },
]
DOCUMENTS = {
    "forces": {
        "touch": {"kind": "kinematic_taxel", **FEELS},
        "bit": {"kind": "contact", **FEELS, "gate": "geometric"},
        "shared": {"kind": "force_taxel", **FEELS},
        "load": {"kind": "link_contact", **FEELS},
    },
    "fields": {
        "near": {"kind": "proximity", "links": "*", "feels": ["rock", "ball"], "tolerance": 0.1},
        "sampled": {"kind": "proximity", "links": "pad", "feels": ["rock"], "backend": "points", "points": 50},
        "far": {"kind": "surface_distance", "links": "pad", "feels": ["rock"], "max_range": 0.05},
    },
    "elastomers": {
        "wave": {"kind": "elastomer", "links": "pad", "feels": ["cube"], "operator": "fft"},
        "points": {"kind": "elastomer", "links": "tip", "feels": ["cube", "ball"], "anchors": "points", "points": 20},
    },
}


@pytest.fixture(scope="module")
def plans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plans")
    (folder / "scene.xml").write_text(SCENE)

    def made(sensors) -> Plan:
        felt = {name for sensor in sensors.values() for name in sensor["feels"]}
        objects = {
            "cube": {"body": "cube"},
            "rock": {"body": "rock", "tolerance": 1e-3, "query": "raycast" if "touch" in sensors else "sdf"},
            "ball": {"body": "ball", "variants": VARIANTS},
        }
        document = {
            "tgdsl": 1,
            "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"pad": GRID, "tip": POINTS}}}},
            "objects": {name: target for name, target in objects.items() if name in felt},
            "sensors": sensors,
            "observations": {
                "policy": [{"type": "joint_pos", "joints": ["one", "two"]}, {"type": "joint_vel", "joints": ["two"]}]
            },
        }
        return compile_plan(document)

    return {name: made(sensors) for name, sensors in DOCUMENTS.items()}


def edited(plan: Plan, name: str, value: int, at: int) -> Plan:
    """Return a plan with another number in one of its arrays, whose hash is made of that when it is saved."""
    own = plan.arrays[name]
    changed = own.copy()
    changed.reshape(-1)[at] = value
    return tree.mapped(plan, lambda array: tree.frozen(changed) if array is own else array)


def refusal(path) -> str | None:
    """Return why an artefact is refused; None if it is not."""
    try:
        tgdsl.load(path)
    except ArtifactError as error:
        return str(error).removeprefix(f"{path}: ")
    return None


@pytest.mark.slow
@pytest.mark.parametrize("which", DOCUMENTS)
def test_integers_of_nothing_are_refused_or_do_no_harm(plans, which, tmp_path):
    """Each integer array in turn, its first or last number negative or huge: an error with its name, or a module that runs."""
    plan, path = plans[which], tmp_path / "edited.safetensors"
    save_plan(plan, path)
    touch = tgdsl.load(path, dtype=torch.float64)
    state = touch.example_state(2)
    readings = touch(state)
    assert all(reading.isfinite().all() for reading in readings.values())
    refused, kept = set(), set()
    names = [name for name, array in plan.arrays.items() if array.dtype.kind == "i" and array.size]
    for name in names:
        for value in (-1, int(np.iinfo(plan.arrays[name].dtype).max)):
            for at in (0, -1):
                save_plan(edited(plan, name, value, at), path)
                message = refusal(path)
                if message is None:
                    touch = tgdsl.load(path, dtype=torch.float64)
                    touch(touch.example_state(2))
                    kept.add(name)
                else:
                    found = re.fullmatch(r'the array "(.*?)" holds (-?\d+), expected .*', message)
                    assert found and (found[1] == name or found[1].startswith(f"{name}/") or name.endswith("/num")), message
                    refused.add(name)
    assert refused | kept == set(names) and "layout/link_id" in refused
    assert {name.rpartition("/")[2] for name in kept - refused} <= {"cell", "is_absolute", "0"}  # "0": a flag of a link, flat


def test_the_message_says_what_is_right(plans, tmp_path):
    plan, path = plans["forces"], tmp_path / "edited.safetensors"
    for name, value, expected in (
        ("layout/link_id", 2, "0 to 1"),
        ("pairs/gate", 6, "0 to 5"),
        ("quantities/contact_depth/queries/0/pair", -1, "0 to 1"),
        ("sensors/touch/taxels", 19, "0 to 18"),
        ("sensors/shared/row", -7, "0 to 31"),
        ("observations/policy/1/rows", 2, "0 to 1"),
        ("layout/cell", -2, "at least -1"),
    ):
        save_plan(edited(plan, name, value, 0), path)
        with pytest.raises(ArtifactError) as error:
            tgdsl.load(path)
        assert str(error.value) == f'{path}: the array "{name}" holds {value}, expected {expected}'


def test_plain_indices_are_looked_at_too(plans, tmp_path):
    """Numbers of queries, objects, tables and channels, which are no arrays."""
    plan, path = plans["fields"], tmp_path / "edited.safetensors"
    depth, moments = plan.quantities["contact_depth"], plan.quantities["moments"]
    use = dataclasses.replace(depth.uses[0], query=3)
    table = dataclasses.replace(moments.tables[0], object=-1)
    term = dataclasses.replace(plan.observations[0], channels=(1,))
    parts = {
        "quantities/contact_depth/uses/0/query": {"contact_depth": dataclasses.replace(depth, uses=(use, *depth.uses[1:]))},
        "quantities/moments/tables/0/object": {"moments": dataclasses.replace(moments, tables=(table, *moments.tables[1:]))},
    }
    edits = {name: dataclasses.replace(plan, quantities={**plan.quantities, **own}) for name, own in parts.items()}
    edits["observations/policy/0/channels"] = dataclasses.replace(plan, observations=(term, *plan.observations[1:]))
    for name, other in edits.items():
        save_plan(other, path)
        with pytest.raises(ArtifactError, match=rf'the array "{name}" holds -?\d, expected 0 to \d$'):
            tgdsl.load(path)
