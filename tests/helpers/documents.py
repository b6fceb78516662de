"""A small document and its layout, and the errors of wrong ones."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from tgdsl.errors import SpecError
from tgdsl.schema.load import Loaded, load

DOCUMENT = """\
tgdsl: 1
robot: {model: xhand1, layout: layout.yaml}
objects:
  ball: {body: ball}
  cube: {body: cube}
resolution: low
sensors:
  touch:
    kind: contact
    links: tips
    feels: [ball]
"""
LAYOUT = """\
groups:
  tips: ["*_tip"]
resolutions:
  low:
    index_tip: {method: poisson, count: 3, radius: 2 mm}
  high:
    index_tip: {method: poisson, count: 9, radius: 2 mm}
"""

POISSON = "{method: poisson, count: 3, radius: 2 mm}"
"""The first placement of `LAYOUT`."""


def write(folder: Path, document: str = DOCUMENT, layout: str = LAYOUT) -> Path:
    (folder / "hand.yaml").write_text(document, encoding="utf-8")
    (folder / "layout.yaml").write_text(layout, encoding="utf-8")
    return folder / "hand.yaml"


def read(folder: Path, document: str = DOCUMENT, layout: str = LAYOUT, overrides: Mapping[str, str] | None = None) -> Loaded:
    loaded = load(write(folder, document, layout), overrides)
    loaded.raise_problems()
    return loaded


def mistakes(
    folder: Path, document: str = DOCUMENT, layout: str = LAYOUT, overrides: Mapping[str, str] | None = None
) -> list[str]:
    """Return the lines of the error, without the folder."""
    with pytest.raises(SpecError) as caught:
        read(folder, document, layout, overrides)
    assert caught.value.problems == tuple(sorted(set(caught.value.problems)))
    return str(caught.value).replace(f"{folder}/", "").split("\n")


def valid() -> dict:
    """Return a document that uses much of the grammar, its layout in line."""
    region = [{"facing": [0, 0, 1], "within": "60 deg"}, {"box": {"min": [0, 0, 0], "max": [1, 1, 1]}}, {"geoms": "a"}]
    grid = {"method": "grid", "rows": 2, "columns": 2, "radius": 0, "direction": [0, 0, 1], "region": region}
    point = {"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": 0.001}
    return {
        "tgdsl": 1,
        "robot": {
            "model": "xhand1",
            "layout": {
                "groups": {"tips": ["*_tip"], "hand": {"include": ["tips"], "exclude": ["a"]}},
                "resolutions": {"low": {"a": grid, "b": {"method": "points", "points": [point]}}},
            },
        },
        "objects": {
            "ball": {"body": "ball", "material": "steel", "temperature": "45 degC", "cells": [2, 2, 2]},
            "cube": {"body": "cube", "material": ["wood", {"like": "steel", "density": 7800}], "temperature": {"per_env": 30}},
        },
        "resolution": "low",
        "sensors": {
            "touch": {"kind": "contact", "links": "tips", "feels": ["ball"], "noise": "mine"},
            "force": {"kind": "kinematic_taxel", "links": "tips", "feels": ["ball"], "noise": {"gain": [1, 1]}},
        },
        "noise": {"mine": {"bias": 0, "hysteresis": None}},
        "observations": {"policy": [{"type": "bool", "of": "touch"}, {"type": "force", "of": "force"}]},
    }
