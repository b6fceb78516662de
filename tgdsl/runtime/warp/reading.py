"""What a module wants, read from MuJoCo Warp's arrays where they are.

Shapes: `env` environments, `body` as the module's `inputs` list them.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.joint_fields import JointPlaces
from tgdsl.runtime.simulators.lookup import body_id
from tgdsl.runtime.warp.contacts import PairContacts

SOURCES = ("xpos", "xquat", "cvel", "subtree_com", "sensordata")
"""Arrays of MuJoCo that are of a state's instant: what it is read from, and what other sensors of the model say."""


class StateReader:
    """Gathers the fields of a state by index, on the device."""

    def __init__(
        self,
        inputs: Inputs,
        model: mujoco.MjModel,
        sources: Mapping[str, Tensor],
        kept: Mapping[str, Tensor],
        contacts: PairContacts,
    ):
        """Look up where everything is.

        Args:
            inputs: What the module wants.
            model: The scene.
            sources: The arrays that `SOURCES` names and those of `joints.FORCES`, (env, …).
            kept: The arrays of joints and actuators at the state's instant, (env, …).
            contacts: The contacts that the module wants.

        Raises:
            SimulationError: If the model lacks a body, a joint or an actuator.
        """
        self._fields = inputs.fields
        self._sources, self._contacts = sources, contacts
        device = sources["xpos"].device
        bodies = [body_id(model, name) for name in inputs.bodies]
        self._bodies = torch.tensor(bodies, dtype=torch.int64, device=device)
        self._roots = torch.tensor(model.body_rootid[bodies], dtype=torch.int64, device=device)
        places = JointPlaces.of(inputs, model)
        self._joints = {
            name: ({**sources, **kept}[array], torch.from_numpy(places.by_array[array]).to(device))
            for name, array in places.fields.items()
        }

    def read(self) -> dict[str, Tensor]:
        """Return the fields of a state that are poses, velocities, contacts or joints, each a tensor of its own."""
        values: dict[str, Tensor] = {}
        if "body_pos" in self._fields:
            values["body_pos"] = self._sources["xpos"][:, self._bodies]
        if "body_quat" in self._fields:
            values["body_quat"] = self._sources["xquat"][:, self._bodies]
        if "body_linvel" in self._fields or "body_angvel" in self._fields:
            values |= self._velocities()
        values |= self._contacts.read()
        values |= {name: array[:, columns] for name, (array, columns) in self._joints.items()}
        return {name: value for name, value in values.items() if name in self._fields}

    def _velocities(self) -> dict[str, Float[Tensor, "env body 3"]]:
        """Move MuJoCo's spatial velocity from the centre of mass of the kinematic tree to the body frame's origin."""
        spatial = self._sources["cvel"][:, self._bodies]
        angular, linear = spatial[..., :3], spatial[..., 3:]
        arm = self._sources["xpos"][:, self._bodies] - self._sources["subtree_com"][:, self._roots]
        return {"body_angvel": angular, "body_linvel": linear + torch.linalg.cross(angular, arm)}
