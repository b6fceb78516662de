"""Temperatures in a module: turned and distant scenes, varying steps, some environments alone, peeking, samples."""

import numpy as np
import pytest
import torch
from oracles.setups.boxes import begin, cells_of, face_contacts, heat_module, heat_state
from scipy.spatial.transform import Rotation

TIP = {"tip": [0.012, 0.01, 0.02]}
SENSOR = {"cells": [2, 3, 2], "material": "steel", "convection": 20.0, "lag": 0.3}
OBJECTS = {
    "ball": ([0.02] * 3, {"material": "copper", "temperature": 45.0, "cells": [2, 2, 1]}),
    "chip": ([0.01] * 3, {"material": "wood", "temperature": -5.0}),
}
CONTACTS = {
    ("tip", "ball"): face_contacts([0.006, 0.004], -0.01),
    ("tip", "chip"): [((0.006, 0.001, 0.003), (-1, 0, 0), 2.0)],
}


def touching(module, dt=0.05, num_envs=1):
    """Return a state with the tip on the ball and the chip leaning on the tip."""
    state = heat_state(module, dt, CONTACTS, num_envs)
    state.body_pos[:, module.inputs.bodies.index("ball"), 2] = -0.02
    return state


def turned_state(state, degrees, shift):
    """Return the whole scene pitched and shifted."""
    rotation = Rotation.from_euler("y", degrees, degrees=True)
    matrix, shift = torch.from_numpy(rotation.as_matrix()), torch.tensor(shift, dtype=torch.float64)
    for name in ("body_pos", "contact_pos"):
        setattr(state, name, getattr(state, name) @ matrix.T + shift)
    for name in ("contact_force", "contact_normal", "contact_netforce"):
        setattr(state, name, getattr(state, name) @ matrix.T)
    state.body_quat[:] = torch.from_numpy(np.roll(rotation.as_quat(), 1))
    return state


def read(module, state, num=20):
    with torch.no_grad():
        for _ in range(num):
            readings = module(state)
    return {name: value.clone() for name, value in readings.items()}


@pytest.mark.parametrize(("dtype", "shift", "tolerance"), [(torch.float64, 50.0, 1e-9), (torch.float32, 0.3, 1e-3)])
def test_a_pitched_link_equals_an_upright_one(tmp_path, dtype, shift, tolerance):
    """By 110°, and elsewhere. In float32 the rounding of positions counts: 3e-8 m in cells of 5 mm."""
    module = heat_module(tmp_path, TIP, SENSOR, OBJECTS, dtype)
    upright = read(module, touching(module).to("cpu", dtype))
    module.reset()
    pitched = read(module, turned_state(touching(module), 110.0, [shift, -shift, shift]).to("cpu", dtype))
    assert float(upright["heat"].max() - upright["heat"].min()) > 1.0
    for name in ("heat", "heat/objects"):
        torch.testing.assert_close(pitched[name], upright[name], rtol=1e-6 if dtype == torch.float32 else 1e-12, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_opposing_contacts_conduct_like_one_of_their_total_force(tmp_path, dtype):
    """Their normals cancel, so the first one's counts."""
    place, one, other = (0.006, 0.004, -0.01), (0, 0, 1), (0, 0, -1)
    module, rises = heat_module(tmp_path, TIP, SENSOR, OBJECTS, dtype), []
    for contacts in ([(place, one, 2.0), (place, other, 2.0)], [(place, one, 4.0)]):
        module.reset()
        state = heat_state(module, 0.05, {("tip", "ball"): contacts})
        rises.append(read(module, state.to("cpu", dtype))["heat"] - 22.0)
    assert float(rises[0].max()) > 0.05
    torch.testing.assert_close(rises[0], rises[1], rtol=0, atol=3e-6 if dtype == torch.float32 else 1e-12)


def test_the_step_may_change_from_call_to_call(tmp_path):
    """Two steps of 50 ms conduct as much as one of 100 ms, whatever came before."""
    module, results = heat_module(tmp_path, {"tip": [0.01] * 3}, {"cells": [3, 3, 3], "material": "steel"}), []
    above = 10 * np.random.default_rng(0).normal(size=(3, 3, 3))
    for steps in ([0.1], [0.05, 0.05], [0.001, 0.099], [0.07, 0.01, 0.02]):
        module.reset()
        begin(module, heat_state(module, 0.3), above)
        for dt in steps:
            module(heat_state(module, dt))
        results.append(cells_of(module).clone())
    for other in results[1:]:
        torch.testing.assert_close(other, results[0], rtol=0, atol=1e-12)


def test_environments_that_are_not_read_hold_their_heat(tmp_path):
    """They catch up to the bit: two environments read at other times agree."""
    module = heat_module(tmp_path, TIP, SENSOR, OBJECTS)
    state = touching(module, num_envs=4)
    initial = read(module, state, 5)
    some = {name: value.clone() for name, value in module(state, env_ids=[1, 3]).items()}
    for name, value in initial.items():
        assert torch.equal(some[name][[0, 2]], value[[0, 2]]) and not torch.equal(some[name][1], value[1])
    rest = module(state, env_ids=[0, 2])
    for name, value in rest.items():
        assert torch.equal(value[0], value[1]), name


def test_a_reset_restores_links_and_objects_in_its_environments_alone(tmp_path):
    module = heat_module(tmp_path, TIP, SENSOR, OBJECTS)
    state = touching(module, num_envs=3)
    previous, twin = read(module, state, 10), heat_module(tmp_path, TIP, SENSOR, OBJECTS)
    read(twin, state, 10)
    module.reset([1])
    after, expected = read(module, state, 1), read(twin, state, 1)
    assert (after["heat"][1] == 22.0).all() and after["heat/objects"][1, :, 0].tolist() == [45.0, -5.0]
    assert (after["heat/heat"][1] == 0).all() and (after["heat/objects"][1, :, 2:] == 0).all()
    assert (previous["heat/objects"][:, 0, 0] < 45.0).all()
    for name, value in after.items():
        assert torch.equal(value[[0, 2]], expected[name][[0, 2]]), name


def test_peeking_changes_nothing_and_equals_the_next_reading(tmp_path):
    module = heat_module(tmp_path, TIP, SENSOR, OBJECTS)
    state = touching(module)
    read(module, state, 3)
    peeks, readings = [module.peek(state) for _ in range(2)], module(state)
    for name, value in readings.items():
        assert torch.equal(peeks[0][name], value) and torch.equal(peeks[1][name], value), name


def test_samples_and_stacks_do_not_affect_temperatures(tmp_path):
    """A sensor with a rate and a history holds its reading; its stored heat equals a plain sensor's."""
    plain = heat_module(tmp_path, TIP, SENSOR, OBJECTS)
    held = heat_module(tmp_path, TIP, {**SENSOR, "rate": "5 Hz", "history": 3}, OBJECTS)
    state, temperatures = touching(plain, 0.05), []
    for _ in range(13):
        temperatures.append(plain(state)["heat"].clone())
        stack = held(state)["heat"]
    torch.testing.assert_close(stack[:, -1], temperatures[12], rtol=0, atol=0)
    assert any(torch.equal(stack[:, 0], value) for value in temperatures[:12])
    assert torch.equal(cells_of(held), cells_of(plain))


def test_links_that_touch_each_other_keep_their_heat(tmp_path):
    """Felt from both sides, heat flows once: one link loses what the other gains, until their temperatures agree."""
    objects = {
        "first": (None, {"body": "a", "material": "copper"}),
        "second": (None, {"body": "b", "material": "steel"}),
    }
    sensor = {"cells": [2, 2, 2], "material": "copper", "materials": {"b": "steel"}, "contact_area": "20 mm2"}
    module = heat_module(tmp_path, {"a": [0.01] * 3, "b": [0.01] * 3}, sensor, objects)
    contacts = {
        (pair.link, pair.object): [((0, 0, 0.005), (0, 0, -1.0 if pair.link == "a" else 1.0), 1.0)]
        for pair in module.inputs.pairs
    }
    state = heat_state(module, 0.1, contacts)
    begin(module, state, 20 * np.ones((2, 2, 2)))
    first = read(module, state, 1)["heat/heat"][0]
    for _ in range(200):
        readings = module(state)
        heat = readings["heat/heat"][0]
        assert float(heat[0, 4] + heat[1, 4]) == pytest.approx(0.0, abs=1e-12)
    assert float(heat[:, 0].sum()) == pytest.approx(float(first[:, 0].sum()), rel=1e-12)
    assert float(readings["heat"].max() - readings["heat"].min()) < 0.2
