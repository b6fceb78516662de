"""Contacts of environments that a reset has placed without looking for any: none, or those that were stored with the start.

Shapes: `env` environments.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.module.state import SceneState, shape_of
from tgdsl.plan.inputs import Inputs
from tgdsl.tensors.env_ids import broadcast_over

FIELDS = (
    *("contact_found", "contact_pos", "contact_force", "contact_torque", "contact_normal", "contact_netforce"),
    "joint_effort",
)
"""Fields of a state that follow from forces."""
Contacts = str | Mapping[str, Tensor]
"""How the contacts of a start are found, "evaluate" or "none", or what they are: see `Simulation.reset`."""


class StartContacts:
    """The contacts of environments that were placed since the last step, in the place of what the simulator has.

    Attributes:
        is_placed: Environments that were placed; None if none were.
        values: What was stored of their contacts, by field.
    """

    def __init__(self, inputs: Inputs):
        self._inputs = inputs
        self.is_placed: Bool[Tensor, " env"] | None = None
        self.values: dict[str, Tensor] = {}

    def forget(self, chosen: Bool[Tensor, " env"] | None = None) -> None:
        """Forget some environments (default: all), whose contacts the simulator has evaluated."""
        if chosen is None:
            self.is_placed, self.values = None, {}
        elif self.is_placed is not None:
            self.is_placed = self.is_placed & ~chosen

    def place(self, chosen: Bool[Tensor, " env"], contacts: Contacts) -> None:
        """Note environments that were placed, and their contacts: "none", or fields of a state by name, the others zero."""
        given = self._given(contacts, chosen)
        for name in {**self.values, **given}:
            old, new = self.values.get(name), given.get(name)
            like = old if new is None else new
            assert like is not None
            old, new = (torch.zeros_like(like) if value is None else value for value in (old, new))
            self.values[name] = torch.where(broadcast_over(chosen, like), new, old.to(new.dtype))
        self.is_placed = chosen.clone() if self.is_placed is None else self.is_placed | chosen

    def applied_to(
        self, state: SceneState, is_stored: bool = True, rows: Int[Tensor, " n"] | slice = slice(None)
    ) -> SceneState:
        """Return a state, of all or some rows, in which placed environments have the contacts of their start.

        Unless `is_stored`, the stored ones are not of this state's pairs and joints, and all are zero.
        """
        if self.is_placed is None:
            return state
        is_placed = self.is_placed[rows]
        values: dict[str, Any] = {}
        for name in FIELDS:
            now = getattr(state, name)
            if now is not None:
                start = self.values.get(name) if is_stored else None
                value = torch.zeros_like(now) if start is None else start[rows].to(now.device, now.dtype)
                values[name] = torch.where(broadcast_over(is_placed.to(now.device), now), value, now)
        return dataclasses.replace(state, **values)

    def _given(self, contacts: Contacts, chosen: Bool[Tensor, " env"]) -> dict[str, Tensor]:
        """Return the fields that are given for the environments, (env, …)."""
        if not isinstance(contacts, str):
            return {name: self._fitting(name, contacts[name], chosen) for name in contacts}
        if contacts != "none":
            raise SimulationError(f'contacts is "{contacts}"; {did_you_mean(contacts, ("evaluate", "none"), "choices")}')
        return {}

    def _fitting(self, name: str, value: Tensor, chosen: Bool[Tensor, " env"]) -> Tensor:
        known = [field for field in FIELDS if field in self._inputs.fields]
        if name not in known:
            raise SimulationError(f'contacts: this module wants no "{name}"; {did_you_mean(name, known, "fields")}')
        shape = (len(chosen), *shape_of(name, self._inputs))
        if tuple(value.shape) not in (shape, shape[1:]):
            raise SimulationError(f"contacts: {name} has shape {tuple(value.shape)}, expected {shape} or {shape[1:]}")
        return value.to(chosen.device).expand(shape)
