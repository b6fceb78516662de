"""One module of every kind, noisy and with memory, in one compiled graph; `make test-full` compiles each kind by itself."""

import pytest
import torch
from noisy_modules import FLOAT32_TOLERANCE, SCENE, document, read

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.sensors import KINDS
from tgdsl.tensors.torch_internals import num_compiled_graphs
from tgdsl.testing import full_scale_error

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


@pytest.fixture
def touch(tmp_path):
    """The module of all kinds, on two links that feel a warm ball, one joint being actuated."""
    made = document(tmp_path, {})
    (tmp_path / "scene.xml").write_text(SCENE.replace("</worldbody>", ACTUATED))
    made["objects"]["item"] |= {"material": "aluminium", "temperature": 45.0}
    return tgdsl.compile({**made, "sensors": SENSORS}, dtype=torch.float32)


def test_all_kinds_in_one_graph(touch):
    """Compiled readings are the eager ones, over states with memory and a reset, at two numbers of environments."""
    assert {sensor["kind"] for sensor in SENSORS.values()} == {kind.name for kind in KINDS}
    more, compiled = (TactileModule(touch.plan, dtype=torch.float32) for _ in range(2))
    torch.compiler.reset()
    num_graphs = num_compiled_graphs()
    compiled.compile(
        options={**compiled.inductor_options(), "cpp.simdlen": 1}
    )  # code for vectors takes twice the time to write
    assert_same_readings(compiled, touch, range(4), 7)
    read(more, range(2), 11)
    compiled.load_state_dict(more.state_dict())
    assert_same_readings(compiled, more, range(2, 5), 11)
    assert num_compiled_graphs() == num_graphs + 1


def assert_same_readings(compiled, eager, calls, num_envs):
    """Assert that readings of all calls together agree, of which the last one follows a reset of two environments."""
    found, expected = [], []
    for call in calls:
        for module, readings in ((compiled, found), (eager, expected)):
            if call == calls[-1]:
                module.reset([1, 3])
            readings += read(module, range(call, call + 1), num_envs)
    assert found[0].keys() == expected[0].keys() and len(found[0]) > len(SENSORS)
    for name in found[0]:
        compared, exact = (torch.stack([reading[name] for reading in readings]) for readings in (found, expected))
        assert exact.isfinite().all() and (exact != 0).any(), name
        assert full_scale_error(compared, exact.double().numpy()).max() < FLOAT32_TOLERANCE, name
