"""One small module of all kinds: noisy, with memory, on two links that feel a warm ball, one joint being actuated."""

from pathlib import Path

import torch
from noisy_modules import SCENE, document

import tgdsl
from tgdsl.module.module import TactileModule

ACTUATED = """
  <body name="arm" pos="0 0 .1"><joint name="elbow" axis="0 1 0" pos=".01 0 .02"/><geom size=".01"/></body>
</worldbody>
<actuator><motor name="motor" joint="elbow"/></actuator>"""

NOISY = {"like": "noisy", "quantization": 0}
"""Without the quantiser, which makes a step of a rounding."""
EVERY_STAGE = {
    **NOISY, "read_delay": "13 ms", "jitter": "11 ms", "bias": {"force": 0.02}, "crosstalk": {"strength": 0.2, "sigma": "5 mm"},
}  # fmt: skip
FEELS = {"links": ["pad", "tip"], "feels": ["item"]}
MODES = [{"frequency": 310.0, "decay": 12.0, "gain": 2.0}, {"frequency": 845.0, "decay": 40.0}]
SENSORS = {
    "contact": {"kind": "contact", **FEELS, "threshold": "2 mm", "noise": {"like": "noisy", "release_threshold": "0.5 mm"}},
    "depth": {"kind": "contact_depth", **FEELS, "noise": NOISY, "rate": 60},
    "distance": {"kind": "surface_distance", **FEELS, "nearest": True, "max_range": "30 mm"},
    "touch": {"kind": "kinematic_taxel", **FEELS, "noise": EVERY_STAGE, "history": 3, "readout": "both"},
    "force": {"kind": "force_taxel", **FEELS, "outputs": ["pressure", "force"], "noise": NOISY},
    "solver": {"kind": "link_contact", **FEELS, "outputs": ["contact", "force", "normal_force"]},
    "near": {"kind": "proximity", **FEELS, "tolerance": 0.1, "noise": NOISY},
    "skin": {"kind": "elastomer", **FEELS, "standoff": 0.003, "friction": 0.6, "noise": NOISY},
    "heat": {"kind": "temperature_grid", **FEELS, "cells": [2, 1, 2], "material": "copper"},
    "sound": {"kind": "contact_audio", **FEELS, "samples": 8, "scrape": 0.05, "modes": MODES},
    "motors": {"kind": "actuation_audio", "samples": 8},
    "ear": {"kind": "microphone", "body": "pad", "pos": [0.01, 0.0, 0.02]},
}


def every_kind(folder: Path, sensors: dict[str, dict] = SENSORS) -> TactileModule:
    made = document(folder, {})
    (folder / "scene.xml").write_text(SCENE.replace("</worldbody>", ACTUATED))
    made["objects"]["item"] |= {"material": "aluminium", "temperature": 45.0}
    return tgdsl.compile({**made, "sensors": sensors}, dtype=torch.float32)
