"""What flows between what touches: closed forms, hard cases, and bounds that hold for any step."""

import itertools

import numpy as np
import pytest
import torch
from oracles import heat
from oracles.setups.boxes import begin, cells_of, face_contacts, heat_module, heat_state, heated
from scipy.linalg import expm

from tgdsl.fields.materials import MATERIALS


def test_aluminium_on_warm_rubber_warms_as_two_solids_do():
    """Aluminium at 22 °C on rubber at 45 °C: its surface rises by 0.69 K."""
    assert heat.two_bodies(1).atol == pytest.approx(0.01 * 0.69, rel=0.01)


def test_a_patch_that_covers_the_face_is_not_constricted():
    """Then half a cell is all that heat passes; so it is for a larger one, and one that stands over is moved in."""
    from tgdsl.sensors.temperature_grid.patch_flow import conductances
    from tgdsl.sensors.temperature_grid.rows import Boxes

    def column(*values):
        return tuple(torch.tensor([v], dtype=torch.float64) for v in values)

    boxes = Boxes(column(0, 0, 0), column(0.02, 0.02, 0.03), column(0.01, 0.005, 0.01), column(2, 4, 3))

    def of(area, x, y):
        area = torch.full((1, 1, 1), area, dtype=torch.float64)
        pos = tuple(torch.full((1, 1, 1), v, dtype=torch.float64) for v in (x, y, 0.031))
        normal = tuple(torch.full((1, 1, 1), v, dtype=torch.float64) for v in (0.0, 0.0, -1.0))
        return conductances(area, pos, normal, torch.full((1, 1), 5.0, dtype=torch.float64), boxes, (2, 4, 3))[0, 0, 0].numpy()

    whole = np.zeros((2, 4, 3))
    whole[..., 2] = 2 * 5.0 * 0.0004 / 0.01 / 8
    np.testing.assert_allclose(of(0.0004, 0.01, 0.01), whole, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(of(0.0004, 0.03, -0.01), whole, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(of(0.01, 0.01, 0.01), whole, rtol=1e-12, atol=1e-15)


def test_an_object_between_two_links_is_told_by_both_alike(tmp_path):
    """One step for all of them: which link stands first does not matter, however long the step is."""
    ball = {"material": "rubber", "temperature": 45.0}
    links = {"left": [0.01, 0.01, 0.01], "right": [0.01, 0.01, 0.01]}
    module = heat_module(
        tmp_path, links, {"cells": [2, 2, 2], "material": "steel", "contact_area": "20 mm2"}, {"ball": ([0.02] * 3, ball)}
    )
    contacts = {("left", "ball"): [((0, 0, 0.005), (0, 0, -1), 2.0)], ("right", "ball"): [((0, 0, 0.005), (0, 0, -1), 2.0)]}
    state = heat_state(module, 10.0, contacts)
    begin(module, state)
    for _ in range(3):
        found = module(state)["heat"][0, :, 0]
        torch.testing.assert_close(found[:8], found[8:], rtol=1e-14, atol=0)


@pytest.mark.parametrize(("cells", "dtype"), [([1, 1, 1], torch.float32), ([10, 10, 10], torch.float64)])
def test_nothing_leaves_the_range_of_what_there_is(tmp_path, cells, dtype):
    """For any step, conductivity and area, with two objects and another link at once, losses on; a few cells are a hard case of `oracles`."""
    rng = np.random.default_rng(1)
    slack = 1e-10 if dtype == torch.float64 else 3e-5
    for k, area in itertools.product((0.1, 400.0), (1e-9, 1e-5, 1e-2)):
        material = {"like": "steel", "conductivity": k}
        objects = {
            "hot": ([0.03] * 3, {"material": {"like": "copper", "conductivity": k}, "temperature": 80.0}),
            "cold": ([0.01] * 3, {"material": "rubber", "temperature": -20.0, "cells": [2, 2, 2]}),
            "plate": (None, {"material": "steel", "temperature": 10.0}),
        }
        sensor = {"cells": cells, "material": material, "contact_area": area, "convection": 50.0, "emissivity": 0.9}
        module = heat_module(tmp_path, {"tip": [0.01, 0.012, 0.008]}, sensor, objects, dtype)
        contacts = {
            ("tip", name): [(tuple(rng.uniform(-5e-3, 5e-3, 3)), tuple(n), 1.0)]
            for name, n in zip(objects, np.eye(3), strict=True)
        }
        for dt in (1e-4, 0.01, 1.0, 10.0):
            module.reset()
            state = heat_state(module, dt, contacts)
            begin(module, state)
            for _ in range(3):
                readings = module(state)
                every = torch.cat([readings["heat"][0, :, 0], readings["heat/objects"][0, :, 0]])
                assert float(every.min()) >= -20.0 - slack and float(every.max()) <= 80.0 + slack


@pytest.mark.parametrize(("dt", "duration"), [(0.001, 0.1), (0.02, 0.4)])
def test_two_solids_exchange_what_their_cells_equations_say(tmp_path, dt, duration):
    """Twice 8 cells of 2 mm, against the exponential of all of them: αΔt/Δ² from 0.02 to 0.5."""
    own, cell, num, area = MATERIALS["aluminium"], 0.002, 8, 4e-4
    sides = [0.02, 0.02, num * cell]
    slab = {"material": "aluminium", "temperature": 45.0, "cells": [1, 1, num]}
    module = heat_module(
        tmp_path, {"tip": sides}, {"cells": [1, 1, num], "material": "aluminium", "contact_area": area}, {"slab": (sides, slab)}
    )
    state = heat_state(module, dt, {("tip", "slab"): face_contacts(sides, -0.5 * sides[2])})
    state.body_pos[:, module.inputs.bodies.index("slab"), 2] = -sides[2]
    begin(module, state)
    found = sum(float(module(state)["heat/heat"][0, 0, 4]) for _ in range(round(duration / dt)))
    coupled = np.diff(np.eye(2 * num), axis=0)
    rate = own.conductivity / (own.density * own.specific_heat * cell**2)
    after = expm(-duration * rate * coupled.T @ coupled) @ np.repeat([0.0, 23.0], num)
    assert found == pytest.approx(after[:num].sum() * own.density * own.specific_heat * cell * area, rel=0.003)


@pytest.mark.parametrize("fourier", [0.5, 3.0, 8.0, 30.0])
def test_two_solids_exchange_what_their_cells_equations_say_in_long_steps(tmp_path, fourier):
    """Twice 60 cells of 1 mm, in eight steps: the first, in which the flow changes most, to 1 %."""
    own, cell, num, area = MATERIALS["aluminium"], 0.001, 60, 4e-4
    rate = own.conductivity / (own.density * own.specific_heat * cell**2)
    dt, sides = fourier / rate, [0.02, 0.02, num * cell]
    slab = {"material": "aluminium", "temperature": 45.0, "cells": [1, 1, num]}
    sensor = {"cells": [1, 1, num], "material": "aluminium", "contact_area": area}
    contacts = {("tip", "slab"): face_contacts(sides, -0.5 * sides[2])}
    stream = heated({"tip": sides}, sensor, dt, 8, {"slab": (sides, slab)}, contacts, {"slab": -sides[2]})
    found = np.cumsum([float(readings["heat/heat"][0, 0, 4]) for readings in stream])
    coupled = np.diff(np.eye(2 * num), axis=0)
    begun, step = np.repeat([0.0, 23.0], num), expm(-dt * rate * coupled.T @ coupled)
    exact = [(np.linalg.matrix_power(step, n) @ begun)[:num].sum() for n in range(1, 9)]
    exact = np.array(exact) * own.density * own.specific_heat * cell * area
    np.testing.assert_allclose(found, exact, rtol=0.01)
    np.testing.assert_allclose(found[1:], exact[1:], rtol=0.002)


def in_steps_and_parts(dt, steps, links, sensor, objects, contacts):
    """Return the cells [K] after some steps (step, cell), and after 25 times as many of a 25th."""
    found = []
    for parts in (1, 25):
        stream = heated(links, sensor, dt / parts, parts * steps, objects, contacts)
        found.append(np.array([readings["heat"][0, :, 0].numpy() for readings in stream])[parts - 1 :: parts] - 22.0)
    return found


@pytest.mark.parametrize(
    ("temperatures", "cells", "fourier"),
    [
        ((80.0, -20.0), [1, 1, 4], 0.6),
        ((80.0, 80.0), [2, 2, 2], 0.6),
        ((80.0, -20.0), [2, 2, 2], 3.0),
        ((80.0, 80.0), [1, 1, 4], 3.0),
    ],
)
def test_two_contacts_on_a_thin_link_exchange_what_its_cells_equations_say(temperatures, cells, fourier):
    """A copper link of 1 cm between two bodies, in steps of αΔt/L²: its cells are right to 1 % of what there is."""
    copper = MATERIALS["copper"]
    dt = fourier * 0.01**2 * copper.density * copper.specific_heat / copper.conductivity
    bodies = {
        name: (None, {"material": "copper", "temperature": t}) for name, t in zip(("one", "other"), temperatures, strict=True)
    }
    contacts = {("tip", name): [((0, 0, z), (0, 0, -z / abs(z)), 1.0)] for name, z in (("one", 0.005), ("other", -0.005))}
    sensor = {"cells": cells, "material": "copper", "contact_area": 1e-4}
    found, exact = in_steps_and_parts(dt, 3, {"tip": [0.01] * 3}, sensor, bodies, contacts)
    np.testing.assert_allclose(found, exact, atol=0.01 * np.abs(exact).max())
    np.testing.assert_allclose(found.sum(axis=1), exact.sum(axis=1), rtol=0.01)


@pytest.mark.parametrize(("fourier", "area"), [(30.0, 2e-6), (4.0, 4e-5), (30.0, 2e-4)])
def test_spots_take_up_what_their_cells_equations_say_from_the_first_step_on(area, fourier):
    """On a cube of 20 mm in 4³ cells, αΔt/L² up to 1.9."""
    metal = MATERIALS["aluminium"]
    dt = fourier * 0.005**2 * metal.density * metal.specific_heat / metal.conductivity
    hot = {"hot": (None, {"material": "copper", "temperature": 80.0})}
    contacts = {("tip", "hot"): [((0.001, -0.002, 0.01), (0, 0, -1), 1.0)]}
    sensor = {"cells": [4, 4, 4], "material": "aluminium", "contact_area": area}
    found, exact = in_steps_and_parts(dt, 3, {"tip": [0.02] * 3}, sensor, hot, contacts)
    np.testing.assert_allclose(found.sum(axis=1), exact.sum(axis=1), rtol=0.01)


def test_two_contacts_on_one_cell_count_each_other_once():
    """Two hot bodies on a link of one cell, in steps of a tenth of the time that heat takes through it: as in short steps."""
    bodies = {name: (None, {"material": "copper", "temperature": 80.0}) for name in ("one", "other")}
    contacts = {("tip", name): [((0, 0, z), (0, 0, -z / abs(z)), 1.0)] for name, z in (("one", 0.005), ("other", -0.005))}
    sensor = {"cells": [1, 1, 1], "material": "copper", "contact_area": 1e-4, "temperature": 30.0}
    copper = MATERIALS["copper"]
    dt = 0.1 * 1e-4 * copper.density * copper.specific_heat / copper.conductivity
    first = []
    for parts in (1, 50):
        stream = heated({"tip": [0.01] * 3}, sensor, dt / parts, parts, bodies, contacts)
        first.append(sum(float(readings["heat/heat"][0, 0, 4]) for readings in stream))
    assert first[0] == pytest.approx(first[1], rel=0.005)


@pytest.mark.parametrize("area", [1e-6, 1e-4])
def test_contacts_that_jump_keep_temperatures_near_the_range(tmp_path, area):
    """A hot and a cold body that touch elsewhere at each call of some length: within 5 % of what there is, 0.1 W/(m·K) or 400."""
    rng = np.random.default_rng(0)
    for k in (0.1, 400.0):
        sensor = {"cells": [3, 4, 3], "material": {"like": "steel", "conductivity": k}, "contact_area": area}
        bodies = {
            "hot": (None, {"material": "copper", "temperature": 80.0}),
            "cold": (None, {"material": "copper", "temperature": -20.0}),
        }
        module = heat_module(tmp_path, {"tip": [0.01, 0.012, 0.008]}, sensor, bodies)
        module(heat_state(module, 0.01))
        for _ in range(60):
            contacts = {
                ("tip", name): [(tuple(rng.uniform(-5e-3, 5e-3, 3)), tuple(np.eye(3)[rng.integers(3)]), 1.0)] for name in bodies
            }
            found = module(heat_state(module, float(rng.choice([1e-3, 0.01, 0.1, 1.0])), contacts))["heat"]
            assert float(found.min()) > -25.0 and float(found.max()) < 85.0


def test_a_link_that_is_pinched_does_not_swing(tmp_path):
    """Between a hot and a cold body, all of it within one step's reach: each contact counts what the other does."""
    bodies = {
        "hot": (None, {"material": "copper", "temperature": 80.0}),
        "cold": (None, {"material": "copper", "temperature": -20.0}),
    }
    module = heat_module(
        tmp_path, {"tip": [0.01] * 3}, {"cells": [2, 2, 2], "material": "copper", "contact_area": 1e-4}, bodies
    )
    contacts = {("tip", name): [((0, 0, z), (0, 0, -z / abs(z)), 1.0)] for name, z in (("hot", 0.005), ("cold", -0.005))}
    means = []
    for _ in range(8):
        means.append(float(module(heat_state(module, 5.0, contacts))["heat"].mean()))
    apart = np.abs(np.array(means) - 30.0)
    assert apart[0] == 8.0 and (np.diff(apart) < 1e-9).all() and apart[-1] < 0.1


def test_reading_more_often_reads_the_same(tmp_path):
    """At every physics step or at every fifth, while skin warms by 1 K: what differs is of second order in the step."""
    found = {}
    for dt in (2.0, 1.0):
        for every in (1, 5):
            module = heat_module(
                tmp_path,
                {"tip": [0.01] * 3},
                {"cells": [2, 2, 2], "material": "skin", "contact_area": "20 mm2"},
                {"ball": ([0.02] * 3, {"material": "rubber", "temperature": 45.0})},
            )
            state = heat_state(module, dt * every / 5, {("tip", "ball"): [((0.003, 0.001, 0.005), (0, 0, -1), 2.0)]})
            begin(module, state)
            for _ in range(round(10.0 / (dt * every / 5))):
                readings = module(state)
            found[dt, every] = readings["heat"][0, :, 0]
    apart = [float((found[dt, 1] - found[dt, 5]).abs().max()) for dt in (2.0, 1.0)]
    assert cells_of(module).abs().max() > 0.1
    assert apart[0] < 1e-3
    assert apart[0] / apart[1] > 2**1.8
