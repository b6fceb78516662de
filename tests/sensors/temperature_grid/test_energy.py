"""Energy: stored heat follows from inflow and outflow, in float32 too, with contacts that come and go."""

import numpy as np
import pytest
import torch
from oracles.setups.boxes import heat_module, heat_state

from tgdsl.fields.materials import MATERIALS

LINKS = {"tip": [0.012, 0.01, 0.02], "thumb": [0.015, 0.01, 0.01]}
OBJECTS = {
    "ball": ([0.03] * 3, {"material": "rubber", "temperature": 45.0}),
    "slab": ([0.02, 0.02, 0.005], {"material": "copper", "temperature": -10.0, "cells": [2, 2, 1]}),
    "other": (LINKS["thumb"], {"body": "thumb", "material": "skin"}),
}
ALL = {"source": {"power": 1.5}, "emissivity": "material", "convection": 12.0, "feels": list(OBJECTS)}


def module_of(tmp_path, terms, dtype, **sensor):
    fields = {name: value for name, value in ALL.items() if name in terms and name != "feels"}
    objects = {name: (sides, fields) for name, (sides, fields) in OBJECTS.items() if name != "other"}
    parameters = {"cells": [2, 3, 2], "material": "steel", "temperature": 60.0, "lag": 0.1, **fields, **sensor}
    if "feels" not in terms:
        return heat_module(tmp_path, LINKS, parameters, dtype=dtype)
    return heat_module(tmp_path, LINKS, parameters, {**objects, "other": (None, OBJECTS["other"][1])}, dtype)


def states_of(module, num_envs, count, seed=0):
    """Return states in which each pair touches or not, at random places and angles, with one to four contacts."""
    rng, states = np.random.default_rng(seed), []
    for _ in range(count):
        state = heat_state(module, float(rng.choice([0.001, 0.005, 0.02])), num_envs=num_envs)
        for name, *rest in (("contact_normal",), ("contact_pos", 0.006), ("contact_force", 1.0)):
            if module.inputs.pairs and name == "contact_normal":
                shape = tuple(state.contact_normal.shape)
                normal = rng.normal(size=(*shape[:2], 1, 3))
                normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
                is_used = rng.random((*shape[:3], 1)) < 0.6 * (rng.random((*shape[:2], 1, 1)) < 0.6)
                state.contact_normal = torch.from_numpy(np.broadcast_to(normal, shape) * is_used)
            elif module.inputs.pairs and name == "contact_pos":
                state.contact_pos = torch.from_numpy(rng.normal(size=shape) * rest[0] * is_used)
            elif module.inputs.pairs:
                state.contact_force = state.contact_normal * torch.from_numpy(rng.uniform(0, 5, size=(*shape[:3], 1)))
                state.contact_netforce = state.contact_force.sum(dim=2)
        states.append(state)
    return states


class Account:
    """Inflow and exchanged heat, in float64."""

    def __init__(self):
        self.inflow, self.exchanged = 0.0, 0.0

    def add(self, readings):
        flows = [readings["heat/heat"][..., 1:4].double()]
        if "heat/objects" in readings:
            flows.append(readings["heat/objects"][..., 2:4].double())
            self.exchanged = self.exchanged + readings["heat/objects"][..., 4].double().abs().sum(dim=1)
        for flow in flows:
            self.inflow, self.exchanged = self.inflow + flow.sum(dim=(1, 2)), self.exchanged + flow.abs().sum(dim=(1, 2))


def heat_capacity(material, sides):
    properties = MATERIALS[material]
    return properties.density * properties.specific_heat * float(np.prod(sides))


def stored_heat(module):
    """Return the heat of links and objects above ambient (env,) [J], from the module's memory, in float64."""
    parts = {name: module.memory.get_buffer(f"heat:{name}") for name in module.plan.sensors[0].state}
    cells = (parts["cells"].double() + parts["cells_low"].double()).mean(dim=(2, 3, 4))
    total = sum(cells[:, i] * heat_capacity("steel", sides) for i, sides in enumerate(LINKS.values()))
    if "objects" in parts:
        objects = (parts["objects"].double() + parts["objects_low"].double()).reshape(len(cells), 3, 4)
        total = total + objects[:, 0, 0] * heat_capacity("rubber", OBJECTS["ball"][0])
        total = total + objects[:, 1].mean(dim=1) * heat_capacity("copper", OBJECTS["slab"][0])
    return total


def imbalance(module, states, num_steps):
    """Return the largest error of the balance, relative to the heat exchanged, of all environments."""
    account = Account()
    module(states[0])
    begin = stored_heat(module)
    with torch.no_grad():
        for step in range(num_steps):
            readings = module(states[step % len(states)])
            account.add(readings)
    error = (stored_heat(module) - begin - account.inflow).abs()
    assert (account.exchanged > 0).all()
    return float((error / account.exchanged).max())


@pytest.mark.parametrize("terms", [*((term,) for term in ALL), tuple(ALL)], ids="-".join)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-11)])
def test_energy_is_conserved(tmp_path, terms, dtype, tolerance):
    """For each term alone and for all together."""
    module = module_of(tmp_path, terms, dtype)
    assert imbalance(module, states_of(module, 4, 7), 28) < tolerance


@pytest.mark.parametrize("scheme", ["spectral", "semi_implicit"])
def test_energy_is_conserved_by_all_schemes(tmp_path, scheme):
    module = module_of(tmp_path, tuple(ALL), torch.float32, scheme=scheme)
    assert imbalance(module, states_of(module, 4, 7), 28) < 1e-5


def test_energy_stays_without_losses(tmp_path):
    """Conduction and contact alone neither lose nor create heat, to the resolution of the stored values."""
    module = module_of(tmp_path, ("feels",), torch.float64)
    states = states_of(module, 8, 9)
    module(states[0])
    begin = stored_heat(module)
    for state in states * 10:
        readings = module(state)
    torch.testing.assert_close(stored_heat(module), begin, rtol=1e-13, atol=0)
    torch.testing.assert_close(
        readings["heat/heat"][..., 0].sum(dim=1) + readings["heat/objects"][..., 1].sum(dim=1), begin, rtol=1e-12, atol=0
    )
    assert float((readings["heat"][:, :, 0] - 60.0).abs().max()) > 1.0


def test_changes_below_the_resolution_of_float32_add_up(tmp_path):
    """A step cools the link by less than float32 can tell at 60 °C; the low parts of the temperatures keep it."""
    cooled = []
    for dtype in (torch.float32, torch.float64):
        parameters = {"cells": [1, 1, 1], "material": "steel", "temperature": 60.0, "convection": 12.0}
        module = heat_module(tmp_path, {"tip": LINKS["tip"]}, parameters, dtype=dtype)
        state = heat_state(module, 1e-5)
        temperatures = []
        for _ in range(200):
            module(state)
            cells, low = (module.memory.get_buffer(f"heat:{name}").double() for name in ("cells", "cells_low"))
            temperatures.append(float(cells.mean() + low.mean()))
        cooled.append(temperatures[0] - temperatures[-1])
    assert 0 < cooled[1] / 199 < torch.finfo(torch.float32).eps * 32 / 2  # half the resolution from 32 on
    assert cooled[0] == pytest.approx(cooled[1], rel=1e-3)
