"""Geoms that no environment has are skipped on a CPU; readings are the same to the last bit."""

import math

import numpy as np
import pytest
import torch
from pressed_pads import PAD, compiled

from tgdsl.module.state import example_state
from tgdsl.quantities import geoms as geoms_room

ITEM = '<body name="item"><freejoint/><geom size=".02"/></body>'
VARIANTS = [
    {"type": "box", "size": [0.02, 0.015, 0.01]},
    {"type": "cylinder", "size": [0.02, 0.015]},
    {"geoms": [{"type": "capsule", "size": [0.01, 0.02]}, {"type": "box", "size": [0.02, 0.01, 0.03], "pos": [0, 0, 0.01]}]},
]
SENSORS = {
    "depth": {"kind": "contact_depth", "gate": "geometric"},
    "force": {"kind": "kinematic_taxel"},
    "skin": {"kind": "elastomer"},
    "gap": {"kind": "surface_distance", "max_range": "5 cm"},
}


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    objects = {"item": {"body": "item", "variants": VARIANTS}}
    sensors = {name: sensor | {"feels": ["item"]} for name, sensor in SENSORS.items()}
    return compiled(tmp_path_factory.mktemp("pad"), ITEM, objects, sensors, pad=PAD)


def bits(touch, state):
    touch.free()
    with torch.no_grad():
        return {name: value.contiguous().numpy().tobytes() for name, value in touch(state).items()}


@pytest.mark.parametrize("variants", [[0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 2, 0], [0, 1, 2]])
@pytest.mark.parametrize("odd", [None, math.nan, math.inf])
@pytest.mark.filterwarnings("ignore:poses of bodies are not finite")
def test_skipping_absent_geoms_does_not_change_readings(touch, monkeypatch, variants, odd):
    state = example_state(touch.inputs, 3, 0, torch.float64, 0.02)
    state.variant = torch.tensor(variants)[:, None]
    if odd is not None:
        state.body_pos[1, 0, 2] = odd
    counts = []
    select = geoms_room._had_by_some

    def counted(geoms, is_absent):
        counts.append((len(select(geoms, is_absent).shapes), len(geoms.shapes)))
        return select(geoms, is_absent)

    monkeypatch.setattr(geoms_room, "_had_by_some", counted)
    readings = bits(touch, state)
    assert counts and all((num_selected < num) == (len(set(variants)) < 3) for num_selected, num in counts)
    monkeypatch.setattr(geoms_room, "_had_by_some", lambda geoms, is_absent: geoms)
    assert readings == bits(touch, state)


def test_sizes_in_the_state_apply_to_the_shape_of_each_environment(tmp_path):
    """Distances by hand from a ball and boxes to the points of a pad 5 cm below."""
    variants = [{"type": "sphere", "size": [0.02]}, {"type": "box", "size": [0.01, 0.01, 0.01]}]
    objects = {"item": {"body": "item", "variants": variants, "size": "per_env"}}
    sensor = {"kind": "surface_distance", "max_range": "20 cm", "feels": ["item"]}
    touch = compiled(tmp_path, ITEM, objects, {"gap": sensor}, pad=PAD)
    state = example_state(touch.inputs, 3, 0, torch.float64, 0.02)
    state.variant = torch.tensor([0, 1, 1])[:, None]
    size = np.array([[0.03, 0.03, 0.03], [0.01, 0.02, 0.03], [0.015, 0.025, 0.005]])
    state.object_size = torch.from_numpy(size)[:, None]
    state.body_pos[:] = 0.0
    state.body_pos[:, touch.inputs.bodies.index("item"), 2] = 0.06
    state.body_quat[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    pos = touch.plan.layout.pos - [0, 0, 0.06]
    beyond = np.maximum(np.abs(pos) - size[1:, None], 0)
    expected = [np.linalg.norm(pos, axis=1) - 0.03, *np.linalg.norm(beyond, axis=2)]
    np.testing.assert_allclose(touch(state)["gap"][..., 0], expected, rtol=1e-12)
