"""What a module wants, read from MuJoCo Warp's arrays where they are.

Shapes: `env` environments, `body`, `pair` and `slot` as the module's `inputs` list them.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.plan import SLOT_FIELDS, Inputs
from tgdsl.runtime.lookup import body_id, contact_sensor

SOURCES = ("xpos", "xquat", "cvel", "subtree_com", "sensordata")
"""Arrays of MuJoCo that a state is read from: all of them are of one instant."""
_SLOT_SIZE = 16
_FORCE, _TORQUE, _POS, _NORMAL, _TANGENT = (slice(first, first + 3) for first in (1, 4, 7, 10, 13))
"""Where they stand in a slot."""


class StateReader:
    """Gathers the fields of a state by index, on the device."""

    def __init__(self, inputs: Inputs, model: mujoco.MjModel, sources: Mapping[str, Tensor]):
        """Look up where everything is.

        Args:
            inputs: What the module wants.
            model: The scene.
            sources: The arrays that `SOURCES` names, (env, …).

        Raises:
            SimulationError: If the model lacks a body or a contact sensor.
        """
        self._fields = inputs.fields
        self._sources = sources
        device = sources["xpos"].device
        bodies = [body_id(model, name) for name in inputs.bodies]
        slots = [list(contact_sensor(model, pair, 0)) for pair in inputs.pairs]
        nets = [contact_sensor(model, pair, 1).start for pair in inputs.pairs] if "contact_netforce" in self._fields else []
        self._bodies = torch.tensor(bodies, dtype=torch.int64, device=device)
        self._roots = torch.tensor(model.body_rootid[bodies], dtype=torch.int64, device=device)
        self._found = torch.tensor([own[0] for own in slots], dtype=torch.int64, device=device)
        self._nets = torch.tensor([[at + 1, at + 2, at + 3] for at in nets], dtype=torch.int64, device=device)
        self._slots = torch.empty(0, dtype=torch.int64, device=device)
        if any(name in self._fields for name in SLOT_FIELDS):
            self._slots = torch.tensor(slots, device=device).reshape(len(slots), -1, _SLOT_SIZE)

    def read(self) -> dict[str, Tensor]:
        """Return the fields of a state that are poses, velocities or contacts, each a tensor of its own."""
        values: dict[str, Tensor] = {}
        if "body_pos" in self._fields:
            values["body_pos"] = self._sources["xpos"][:, self._bodies]
        if "body_quat" in self._fields:
            values["body_quat"] = self._sources["xquat"][:, self._bodies]
        if "body_linvel" in self._fields or "body_angvel" in self._fields:
            values |= self._velocities()
        if "contact_found" in self._fields:
            values["contact_found"] = self._sources["sensordata"][:, self._found]
        if self._slots.numel():
            values |= self._contacts()
        if "contact_netforce" in self._fields:
            values["contact_netforce"] = self._sources["sensordata"][:, self._nets]
        return {name: value for name, value in values.items() if name in self._fields}

    def _velocities(self) -> dict[str, Float[Tensor, "env body 3"]]:
        """Move MuJoCo's spatial velocity from the centre of mass of the kinematic tree to the body frame's origin."""
        spatial = self._sources["cvel"][:, self._bodies]
        angular, linear = spatial[..., :3], spatial[..., 3:]
        arm = self._sources["xpos"][:, self._bodies] - self._sources["subtree_com"][:, self._roots]
        return {"body_angvel": angular, "body_linvel": linear + torch.linalg.cross(angular, arm)}

    def _contacts(self) -> dict[str, Float[Tensor, "env pair slot 3"]]:
        """Rotate forces and torques from the contact's frame (normal, tangent, their cross product) to the world."""
        slots = self._sources["sensordata"][:, self._slots]
        normal, tangent = slots[..., _NORMAL], slots[..., _TANGENT]
        axes = torch.stack([normal, tangent, torch.linalg.cross(normal, tangent)], dim=-2)
        return {
            "contact_pos": slots[..., _POS],
            "contact_normal": normal,
            "contact_force": (slots[..., _FORCE, None] * axes).sum(dim=-2),
            "contact_torque": (slots[..., _TORQUE, None] * axes).sum(dim=-2),
        }
