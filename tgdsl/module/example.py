"""Valid random states, for tests and benchmarks."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from tgdsl.module.state import SHAPES, SceneState, shape_of
from tgdsl.plan.inputs import Inputs


def example_state(inputs: Inputs, num_envs: int, seed: int, dtype: torch.dtype, spread: float) -> SceneState:
    """Return a random state of all wanted fields, with bodies close enough to touch: see `TactileModule.example_state`.

    Contacts lie around their links, with unit normals and forces inside a friction cone of 0.5; every third slot is unused, and
    the net force is the slots' sum.
    """
    generator = torch.Generator().manual_seed(seed)
    values: dict[str, Any] = {}
    for name in (name for name in inputs.fields if name in SHAPES):
        shape = (num_envs, *shape_of(name, inputs))
        value = torch.randn(shape, generator=generator, dtype=dtype)
        if name == "body_pos":
            value = spread * value
        elif name == "body_quat":
            value = value / value.norm(dim=-1, keepdim=True)
        elif name == "contact_found":
            value = value > -1.0
        elif name == "variant":
            value = torch.arange(num_envs)[:, None] % torch.tensor(inputs.num_variants)
        elif name == "object_size":
            value = 0.015 + 0.01 * value.clamp(-1, 1)
        elif name == "object_temperature":
            value = 30.0 + 15.0 * value.clamp(-1, 1)
        elif name == "object_material":
            value = torch.arange(num_envs)[:, None] % torch.tensor(inputs.num_materials)
        values[name] = value
    if "contact_force" in values:
        values |= _contacts(values, inputs, spread)
    if "dt" in inputs.fields:
        values["dt"] = inputs.dt or 0.01
    if inputs.substeps > 1:
        one = dataclasses.replace(inputs, substeps=1, fields=tuple(name for name in inputs.fields if name != "dt"))
        seeds = torch.randint(2**62, (inputs.substeps - 1,), generator=generator).tolist()
        values["substeps"] = tuple(example_state(one, num_envs, substep_seed, dtype, spread) for substep_seed in seeds)
    return SceneState(**values)


def _contacts(values: dict[str, Tensor], inputs: Inputs, spread: float) -> dict[str, Tensor]:
    """Turn random numbers into contacts that a solver could have found."""
    is_used = (torch.arange(inputs.slots) % 3 != 2)[:, None]
    links = values["body_pos"][:, [inputs.bodies.index(pair.link) for pair in inputs.pairs], None]
    normal = values["contact_normal"] / values["contact_normal"].norm(dim=-1, keepdim=True)
    raw = values["contact_force"]
    along = (raw * normal).sum(dim=-1, keepdim=True)
    tangential = raw - along * normal
    size = tangential.norm(dim=-1, keepdim=True)
    force = along.abs() * (normal + 0.5 * tangential / (size + 1.0))
    result = {
        "contact_pos": links + spread * values["contact_pos"],
        "contact_force": force,
        "contact_torque": 1e-3 * along * normal,
        "contact_normal": normal,
    }
    result = {name: torch.where(is_used, value, 0.0) for name, value in result.items()}
    return {**result, "contact_netforce": result["contact_force"].sum(dim=2)}
