"""Without contacts, depths behind gates are not measured on a CPU; readings are the same to the last bit."""

import numpy as np
import pytest
import torch
from pressed_pads import PAD, compiled

from tgdsl.module.state import example_state
from tgdsl.quantities import contact_depth

ITEMS = '<body name="item"><freejoint/><geom size=".02"/></body><body name="cube"><freejoint/><geom type="box" size=".02 .02 .02"/></body>'
VARIANTS = [
    {"type": "box", "size": [0.02, 0.015, 0.01]},
    {
        "geoms": [
            {"type": "capsule", "size": [0.01, 0.02]},
            {"type": "ellipsoid", "size": [0.02, 0.01, 0.03], "pos": [0, 0, 0.01]},
        ]
    },
]
OBJECTS = {"item": {"body": "item", "variants": VARIANTS}, "cube": {"body": "cube", "size": "per_env"}}
GATED = {
    "depth": {"kind": "contact_depth"},
    "touch": {"kind": "contact", "threshold": "0.5 mm"},
    "force": {"kind": "kinematic_taxel"},
    "balanced": {"kind": "kinematic_taxel", "balance": "solver"},
    "rough": {"kind": "contact_depth", "noise": {"radius_noise": "1 mm"}},
}
OPEN = {
    "skin": {"kind": "elastomer"},  # reads positions of objects too
    "near": {"kind": "contact_depth", "gate": "geometric"},
    "gap": {"kind": "surface_distance", "max_range": "5 cm"},
}


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    """Return modules by the names of their sets of sensors."""
    folder = tmp_path_factory.mktemp("pad")
    feels = {"feels": ["item", "cube"]}
    return {
        name: compiled(
            folder, ITEMS, OBJECTS, {sensor_name: sensor | feels for sensor_name, sensor in sensors.items()}, pad=PAD
        )
        for name, sensors in (("gated", GATED), ("all", GATED | OPEN))
    }


def closed_state(touch, num_envs=5, dtype=torch.float64):
    """Return a state of overlapping bodies without contacts."""
    state = example_state(touch.inputs, num_envs, 0, dtype, 0.02)
    state.contact_found = torch.zeros_like(state.contact_found)
    state.body_pos[1], state.body_quat[1] = 0.0, torch.tensor([1.0, 0, 0, 0], dtype=dtype)  # overlapping deeply
    return state


def bits(touch, state):
    """Return all readings of a restarted module as bytes."""
    touch.free()
    with torch.no_grad():
        return {name: (value.shape, value.contiguous().numpy().tobytes()) for name, value in touch(state).items()}


def measured(monkeypatch, touch, state):
    """Return the readings with and without a check of the gates, and how many queries the check left."""
    calls, measure = [], contact_depth.measure

    def counted(*args):
        calls.append(args)
        return measure(*args)

    with monkeypatch.context() as patch:
        patch.setattr(contact_depth, "measure", counted)
        checked = bits(touch, state)
        num = len(calls)
        patch.setattr(contact_depth, "_are_closed", lambda scene: False)
        return checked, bits(touch, state), num


@pytest.mark.parametrize("which", ["gated", "all"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gated_depths_are_skipped_without_changing_readings(modules, monkeypatch, which, dtype):
    touch = modules[which].to(dtype)
    checked, unchecked, num = measured(monkeypatch, touch, closed_state(touch))
    assert checked == unchecked and num == (0 if which == "gated" else 1)
    assert np.frombuffer(checked["force"][1], dtype=str(dtype).removeprefix("torch.")).max() == 0.0
    checked, unchecked, num = measured(monkeypatch, touch, closed_state(touch, dtype=torch.float32))
    assert checked == unchecked and num == (0 if which == "gated" else 1)


@pytest.mark.parametrize(
    ("field", "place", "value"),
    [
        ("contact_found", (1, 0), 1.0),
        ("contact_found", (2, 1), torch.nan),
        *(
            ("body_pos", (1, body, axis), value)
            for body in (0, 1)
            for axis, value in ((0, torch.nan), (2, torch.inf), (1, 1e300))
        ),
        ("body_pos", (1, 0, 1), 1e25),
        ("body_quat", (0, 2, 1), torch.nan),
        ("object_size", (4, 0, 2), torch.nan),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.filterwarnings("ignore:poses of bodies are not finite")
def test_one_contact_or_invalid_number_makes_all_depths_measured(modules, monkeypatch, field, place, value, dtype):
    touch = modules["gated"].to(dtype)
    state = closed_state(touch)
    state.contact_found = state.contact_found.double()
    getattr(state, field)[place] = value
    checked, unchecked, num = measured(monkeypatch, touch, state)
    assert checked == unchecked and num > 0
    assert (checked != bits(touch, closed_state(touch))) == (value != 1e25 or dtype == torch.float32)


def test_masked_environments_read_the_same(modules, monkeypatch):
    """As after resets: the masked environments have no contacts, but others do."""
    touch, mask = modules["gated"].double(), torch.tensor([False, True, False, False, True, False])
    state = closed_state(touch, 6)
    state.contact_found[0] = True
    readings = []
    for look in (contact_depth._are_closed, lambda scene: False):
        monkeypatch.setattr(contact_depth, "_are_closed", look)
        touch.free()
        touch.memory.keeps_last = True
        with torch.no_grad():
            touch(state)
            touch.reset(mask)
            readings.append({name: value.contiguous().numpy().tobytes() for name, value in touch(state, mask).items()})
    assert readings[0] == readings[1]


def test_derivatives_behind_closed_gates_are_zero(modules):
    touch = modules["gated"].double()
    state = closed_state(touch)
    state.body_pos.requires_grad_(True)
    touch.free()
    touch(state)["depth"].sum().backward()
    assert state.body_pos.grad is not None and not state.body_pos.grad.any()
