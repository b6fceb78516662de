"""The conformance suite for temperatures: uniform objects, objects with cells, and links that touch."""

import pytest
import torch

from tgdsl.sensors import TEMPERATURE_GRID
from tgdsl.testing import KindConformance

HEAT = {
    "item": {"body": "item", "material": "aluminium", "temperature": 45.0},
    "tool": {"body": "tool", "material": "rubber", "temperature": -5.0},
    "floor": {"body": "floor", "material": "wood"},
}


class TestTemperatureGrid(KindConformance):
    kind = TEMPERATURE_GRID
    gates = ()
    rest = 22.0
    is_differentiable = False  # the first reading after a reset is the initial temperature; see below
    parameters = {"cells": [3, 2, 2], "material": "copper", "emissivity": 0.5, "convection": 20.0}
    objects = HEAT
    test_taxel_permutation_commutes = None  # it reads no taxels
    test_compiled_equals_eager = None  # `TestPerEnvironment` or `../test_compiled.py` includes its graph

    def document(self, scene, **changes):
        return {**super().document(scene, **changes), "objects": self.objects}

    def test_a_broken_pose_is_seen(self, scene):
        """From the second reading on contacts count, and with them the links' poses."""
        module, _ = self.build(self.document(scene), torch.float32)
        first, second, *_ = self.states(module, 2)
        module(first)
        second.body_quat[1] = torch.nan
        with pytest.warns(UserWarning, match="poses of bodies are not finite in environments 1"):
            readings = module(second)["s"]
        assert not readings[0].isnan().any()
        assert readings[1].isnan().any()

    def test_gradients_equal_finite_differences_at_the_second_call(self, scene):
        module, _ = self.build(self.document(scene), torch.float64)
        first, second, *_ = self.states(module, 2)
        names = ("contact_pos", "contact_force", "body_pos")
        tensors = [getattr(second, name).clone().requires_grad_() for name in names]
        is_used = (second.contact_normal != 0).any(dim=-1, keepdim=True)

        def readings(*values):
            module.reset()
            module(first)
            changed = dict(zip(names, values, strict=True))
            for name in names[:2]:
                changed[name] = torch.where(is_used, changed[name], getattr(second, name))
            return module(type(second)(**{**vars(second), **changed}))["s"]

        assert torch.autograd.gradcheck(readings, tensors, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


class TestObjectsWithCells(TestTemperatureGrid):
    objects = HEAT | {"item": {**HEAT["item"], "cells": [2, 3, 4]}}
    parameters = {"spacing": 0.009, "material": "skin", "contact_conductance": 500.0, "source": {"power": 2.0}, "lag": 0.3}


class TestFixedAreas(TestTemperatureGrid):
    parameters = {
        "cells": [1, 4, 1], "material": "steel", "contact_area": "1 cm2", "source": {"flux": 5000.0, "face": "-z"}, "outputs": "max",
    }  # fmt: skip


class TestSurface(TestTemperatureGrid):
    parameters = {"cells": [3, 3, 3], "material": "copper", "scheme": "spectral", "outputs": "surface", "temperature": 30.0}
    rest = 30.0


class TestSemiImplicit(TestTemperatureGrid):
    parameters = {"cells": [4, 3, 2], "material": "copper", "scheme": "semi_implicit", "outputs": "mean", "temperature": 30.0}
    rest = 30.0


class TestLinksThatTouch(TestTemperatureGrid):
    objects = HEAT | {"other": {"body": "tip", "material": "rubber"}}
    parameters = {"cells": [2, 2, 2], "material": "skin", "materials": {"tip": "copper"}, "temperature": 30.0}
    rest = 30.0

    def sensor(self):
        return {**super().sensor(), "feels": ["item", "tool", "floor", "other"]}


class TestPaper(TestTemperatureGrid):
    objects = HEAT | {"other": {"body": "tip", "material": "skin"}}
    parameters = {
        "cells": [2, 3, 2], "material": "skin", "model": "paper", "contact_area": "1 mm2", "temperature": 30.0, "lag": 0.3,
        "emissivity": "material", "convection": 5.0, "source": {"flux": 500.0, "face": "+y"},
    }  # fmt: skip
    rest = 30.0

    def sensor(self):
        return {**super().sensor(), "feels": ["item", "tool", "floor", "other"]}


class TestPaperByTheManifold(TestTemperatureGrid):
    parameters = {"cells": [2, 2, 2], "material": "copper", "model": "paper"}


class TestPerEnvironment(TestTemperatureGrid):
    """Temperatures and materials from the state, and an object with cells: one graph of all options."""

    test_compiled_equals_eager = KindConformance.test_compiled_equals_eager
    objects = HEAT | {
        "item": {"body": "item", "material": ["aluminium", "wood", "steel"], "temperature": {"per_env": 45.0}},
        "tool": {**HEAT["tool"], "cells": [1, 2, 1], "temperature": {"per_env": 10.0}},
    }
    parameters = {
        "cells": [2, 2, 2], "material": "copper", "emissivity": "material", "contact_area": "2 cm2", "contact_conductance": 500.0,
        "source": {"power": 2.0}, "lag": 0.3,
    }  # fmt: skip

    def sensor(self):
        return {**super().sensor(), "feels": ["item", "tool"]}

    def test_temperatures_come_from_the_state(self, scene):
        module, _ = self.build(self.document(scene), torch.float64)
        assert {"object_temperature", "object_material"} <= set(module.inputs.fields)
        state = module.example_state(3, seed=0)
        state.object_temperature[:] = torch.tensor([[50.0], [60.0], [70.0]])
        readings = module(state)["s/objects"]
        place = module.inputs.heated.index("item")
        assert readings[:, 0, 0].tolist() == state.object_temperature[:, place].tolist()
