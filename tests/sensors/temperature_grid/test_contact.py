"""Heat flow between touching bodies: closed forms, hard cases, and bounds that hold for any step."""

import itertools

import numpy as np
import pytest
import torch
from oracles import heat
from oracles.setups.boxes import begin, cells_of, face_contacts, heat_module, heat_state, heated
from scipy.linalg import expm

from tgdsl.fields.materials import MATERIALS


def test_aluminium_on_warm_rubber_warms_like_two_solids():
    """Aluminium at 22 °C on rubber at 45 °C: its surface rises by 0.69 K."""
    assert heat.two_bodies(1).atol == pytest.approx(0.01 * 0.69, rel=0.01)


def test_a_patch_that_covers_the_face_is_not_constricted():
    """Only half a cell resists heat then; larger patches act the same, and patches beyond the face are moved in."""
    from tgdsl.sensors.temperature_grid.patch_flow import conductances
    from tgdsl.sensors.temperature_grid.rows import Boxes

    def column(*values):
        return tuple(torch.tensor([v], dtype=torch.float64) for v in values)

    boxes = Boxes(column(0, 0, 0), column(0.02, 0.02, 0.03), column(0.01, 0.005, 0.01), column(2, 4, 3))

    def conductance_of(area, x, y):
        area = torch.full((1, 1, 1), area, dtype=torch.float64)
        pos = tuple(torch.full((1, 1, 1), v, dtype=torch.float64) for v in (x, y, 0.031))
        normal = tuple(torch.full((1, 1, 1), v, dtype=torch.float64) for v in (0.0, 0.0, -1.0))
        return conductances(area, pos, normal, torch.full((1, 1), 5.0, dtype=torch.float64), boxes, (2, 4, 3))[0, 0, 0].numpy()

    expected = np.zeros((2, 4, 3))
    expected[..., 2] = 2 * 5.0 * 0.0004 / 0.01 / 8
    np.testing.assert_allclose(conductance_of(0.0004, 0.01, 0.01), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(conductance_of(0.0004, 0.03, -0.01), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(conductance_of(0.01, 0.01, 0.01), expected, rtol=1e-12, atol=1e-15)


def test_two_links_read_the_object_between_them_equally(tmp_path):
    """All links take one common step: their order does not matter, however long the step is."""
    ball = {"material": "rubber", "temperature": 45.0}
    links = {"left": [0.01, 0.01, 0.01], "right": [0.01, 0.01, 0.01]}
    module = heat_module(
        tmp_path, links, {"cells": [2, 2, 2], "material": "steel", "contact_area": "20 mm2"}, {"ball": ([0.02] * 3, ball)}
    )
    contacts = {("left", "ball"): [((0, 0, 0.005), (0, 0, -1), 2.0)], ("right", "ball"): [((0, 0, 0.005), (0, 0, -1), 2.0)]}
    state = heat_state(module, 10.0, contacts)
    begin(module, state)
    for _ in range(3):
        temperatures = module(state)["heat"][0, :, 0]
        torch.testing.assert_close(temperatures[:8], temperatures[8:], rtol=1e-14, atol=0)


@pytest.mark.parametrize(("cells", "dtype"), [([1, 1, 1], torch.float32), ([10, 10, 10], torch.float64)])
def test_temperatures_stay_in_the_range_of_all_bodies(tmp_path, cells, dtype):
    """For any step, conductivity and area, with two objects and another link at once, and losses; few cells are a hard case of `oracles`."""
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
                temperatures = torch.cat([readings["heat"][0, :, 0], readings["heat/objects"][0, :, 0]])
                assert float(temperatures.min()) >= -20.0 - slack and float(temperatures.max()) <= 80.0 + slack


@pytest.mark.parametrize(("dt", "duration"), [(0.001, 0.1), (0.02, 0.4)])
def test_two_solids_exchange_heat_by_their_cells_equations(tmp_path, dt, duration):
    """Two columns of 8 cells of 2 mm, against their common matrix exponential: αΔt/Δ² from 0.02 to 0.5."""
    metal, cell, num, area = MATERIALS["aluminium"], 0.002, 8, 4e-4
    sides = [0.02, 0.02, num * cell]
    slab = {"material": "aluminium", "temperature": 45.0, "cells": [1, 1, num]}
    module = heat_module(
        tmp_path, {"tip": sides}, {"cells": [1, 1, num], "material": "aluminium", "contact_area": area}, {"slab": (sides, slab)}
    )
    state = heat_state(module, dt, {("tip", "slab"): face_contacts(sides, -0.5 * sides[2])})
    state.body_pos[:, module.inputs.bodies.index("slab"), 2] = -sides[2]
    begin(module, state)
    heat = sum(float(module(state)["heat/heat"][0, 0, 4]) for _ in range(round(duration / dt)))
    coupled = np.diff(np.eye(2 * num), axis=0)
    rate = metal.conductivity / (metal.density * metal.specific_heat * cell**2)
    after = expm(-duration * rate * coupled.T @ coupled) @ np.repeat([0.0, 23.0], num)
    assert heat == pytest.approx(after[:num].sum() * metal.density * metal.specific_heat * cell * area, rel=0.003)


@pytest.mark.parametrize("fourier", [0.5, 3.0, 8.0, 30.0])
def test_two_solids_exchange_heat_by_their_cells_equations_in_long_steps(tmp_path, fourier):
    """Two columns of 60 cells of 1 mm, in eight steps: the first, with the largest change of flow, to 1 %."""
    metal, cell, num, area = MATERIALS["aluminium"], 0.001, 60, 4e-4
    rate = metal.conductivity / (metal.density * metal.specific_heat * cell**2)
    dt, sides = fourier / rate, [0.02, 0.02, num * cell]
    slab = {"material": "aluminium", "temperature": 45.0, "cells": [1, 1, num]}
    sensor = {"cells": [1, 1, num], "material": "aluminium", "contact_area": area}
    contacts = {("tip", "slab"): face_contacts(sides, -0.5 * sides[2])}
    stream = heated({"tip": sides}, sensor, dt, 8, {"slab": (sides, slab)}, contacts, {"slab": -sides[2]})
    heat = np.cumsum([float(readings["heat/heat"][0, 0, 4]) for readings in stream])
    coupled = np.diff(np.eye(2 * num), axis=0)
    initial, step = np.repeat([0.0, 23.0], num), expm(-dt * rate * coupled.T @ coupled)
    exact = [(np.linalg.matrix_power(step, n) @ initial)[:num].sum() for n in range(1, 9)]
    exact = np.array(exact) * metal.density * metal.specific_heat * cell * area
    np.testing.assert_allclose(heat, exact, rtol=0.01)
    np.testing.assert_allclose(heat[1:], exact[1:], rtol=0.002)


def coarse_and_fine_steps(dt, steps, links, sensor, objects, contacts):
    """Return the cells [K] after some steps (step, cell), and the same by 25 times as many steps."""
    results = []
    for parts in (1, 25):
        stream = heated(links, sensor, dt / parts, parts * steps, objects, contacts)
        results.append(np.array([readings["heat"][0, :, 0].numpy() for readings in stream])[parts - 1 :: parts] - 22.0)
    return results


@pytest.mark.parametrize(
    ("temperatures", "cells", "fourier"),
    [
        ((80.0, -20.0), [1, 1, 4], 0.6),
        ((80.0, 80.0), [2, 2, 2], 0.6),
        ((80.0, -20.0), [2, 2, 2], 3.0),
        ((80.0, 80.0), [1, 1, 4], 3.0),
    ],
)
def test_two_contacts_on_a_thin_link_follow_its_cells_equations(temperatures, cells, fourier):
    """A copper link of 1 cm between two bodies, in steps of αΔt/L²: cells are right to 1 % of the largest value."""
    copper = MATERIALS["copper"]
    dt = fourier * 0.01**2 * copper.density * copper.specific_heat / copper.conductivity
    bodies = {
        name: (None, {"material": "copper", "temperature": t}) for name, t in zip(("one", "other"), temperatures, strict=True)
    }
    contacts = {("tip", name): [((0, 0, z), (0, 0, -z / abs(z)), 1.0)] for name, z in (("one", 0.005), ("other", -0.005))}
    sensor = {"cells": cells, "material": "copper", "contact_area": 1e-4}
    coarse, exact = coarse_and_fine_steps(dt, 3, {"tip": [0.01] * 3}, sensor, bodies, contacts)
    np.testing.assert_allclose(coarse, exact, atol=0.01 * np.abs(exact).max())
    np.testing.assert_allclose(coarse.sum(axis=1), exact.sum(axis=1), rtol=0.01)


@pytest.mark.parametrize(("fourier", "area"), [(30.0, 2e-6), (4.0, 4e-5), (30.0, 2e-4)])
def test_spots_follow_their_cells_equations_from_the_first_step_on(area, fourier):
    """A cube of 20 mm in 4³ cells, αΔt/L² up to 1.9."""
    metal = MATERIALS["aluminium"]
    dt = fourier * 0.005**2 * metal.density * metal.specific_heat / metal.conductivity
    hot = {"hot": (None, {"material": "copper", "temperature": 80.0})}
    contacts = {("tip", "hot"): [((0.001, -0.002, 0.01), (0, 0, -1), 1.0)]}
    sensor = {"cells": [4, 4, 4], "material": "aluminium", "contact_area": area}
    coarse, exact = coarse_and_fine_steps(dt, 3, {"tip": [0.02] * 3}, sensor, hot, contacts)
    np.testing.assert_allclose(coarse.sum(axis=1), exact.sum(axis=1), rtol=0.01)


def test_two_contacts_on_one_cell_count_each_other_once():
    """Two hot bodies on a link of one cell, in steps of a tenth of its diffusion time: as in short steps."""
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
    """A hot and a cold body touch elsewhere at each call, of varying length: within 5 % of the range, at 0.1 W/(m·K) or 400."""
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
            temperatures = module(heat_state(module, float(rng.choice([1e-3, 0.01, 0.1, 1.0])), contacts))["heat"]
            assert float(temperatures.min()) > -25.0 and float(temperatures.max()) < 85.0


def test_a_pinched_link_does_not_oscillate(tmp_path):
    """Between a hot and a cold body, with all of it within one step's reach: each contact accounts for the other."""
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
    deviation = np.abs(np.array(means) - 30.0)
    assert deviation[0] == 8.0 and (np.diff(deviation) < 1e-9).all() and deviation[-1] < 0.1


def test_reading_more_often_reads_the_same(tmp_path):
    """At every physics step or every fifth, while skin warms by 1 K: the difference is of second order in the step."""
    temperatures = {}
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
            temperatures[dt, every] = readings["heat"][0, :, 0]
    difference = [float((temperatures[dt, 1] - temperatures[dt, 5]).abs().max()) for dt in (2.0, 1.0)]
    assert cells_of(module).abs().max() > 0.1
    assert difference[0] < 1e-3
    assert difference[0] / difference[1] > 2**1.8
