"""What a module wants, read from MuJoCo Warp's arrays where they are.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import torch
from torch import Tensor

from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.simulators.bodies import BodyFields
from tgdsl.runtime.simulators.joint_fields import JointColumns
from tgdsl.runtime.warp.contacts import PairContacts


class StateReader:
    """Gathers the fields of a state by index, on the device."""

    def __init__(
        self,
        inputs: Inputs,
        model: mujoco.MjModel,
        sources: Mapping[str, Tensor],
        kept: Mapping[str, Tensor],
        contacts: PairContacts | None = None,
    ):
        """Look up where everything is.

        Args:
            inputs: What the module wants.
            model: The scene.
            sources: The arrays that `STATE_ARRAYS` names and those of `joint_fields.FORCES`, (env, …).
            kept: The arrays of joints and actuators at the state's instant, (env, …).
            contacts: The contacts that are wanted; default: none.

        Raises:
            SimulationError: If the model lacks a body, a joint or an actuator.
        """
        self._sources, self._contacts = sources, contacts
        device = sources["xpos"].device
        self._bodies = BodyFields(
            inputs,
            model,
            index=lambda ids: torch.from_numpy(ids).to(device),
            take=lambda array, ids: array[:, ids],
            cross=torch.linalg.cross,
        )
        indices = JointColumns.of(inputs, model)
        self._joints = {
            name: ({**sources, **kept}[array], torch.from_numpy(indices.by_array[array]).to(device))
            for name, array in indices.fields.items()
        }

    def read(self) -> dict[str, Tensor]:
        """Return the fields of a state that are poses, velocities, contacts or joints, each a tensor of its own."""
        values = self._bodies.read(self._sources) | ({} if self._contacts is None else self._contacts.read())
        values |= {name: array[:, columns] for name, (array, columns) in self._joints.items()}
        return values
