"""What a module wants, read from the arrays of MuJoCo's batch.

Shapes: `env` environments, `body` as the module's `inputs` list them.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float

from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.batch.contact_sensors import ContactSensors
from tgdsl.runtime.simulators.lookup import body_id

Array = np.ndarray
DERIVED = ("xpos", "xquat", "cvel", "subtree_com", "sensordata")
"""Arrays of MuJoCo that a state is read from."""


class BatchReader:
    """Gathers the fields of a state that are poses, velocities or contacts."""

    def __init__(self, inputs: Inputs, model: mujoco.MjModel, batch: mujoco.batch.Batch):
        """Look up where everything is.

        Args:
            inputs: What the module wants.
            model: The scene.
            batch: The environments.

        Raises:
            SimulationError: If the model lacks a body or a contact sensor.
        """
        self._batch = batch
        self._body_ids = np.array([body_id(model, name) for name in inputs.bodies], dtype=np.intp)
        self._root_ids = model.body_rootid[self._body_ids]
        self._contacts = ContactSensors(model, inputs)
        self._readers = {name: _READERS[name] for name in inputs.fields if name in _READERS}
        for name in DERIVED:
            batch.bind(name)  # an array is filled only by calls that come after its first use

    def read(self) -> dict[str, Array]:
        """Return the fields, each an array of its own."""
        arrays = {name: reader(self) for name, reader in self._readers.items()} | self._contacts.read(self._batch.sensordata)
        return {name: np.ascontiguousarray(array) for name, array in arrays.items()}

    def _body_pos(self) -> Float[Array, "env body 3"]:
        return self._batch.xpos[:, self._body_ids]

    def _body_quat(self) -> Float[Array, "env body 4"]:
        return self._batch.xquat[:, self._body_ids]

    def _body_angvel(self) -> Float[Array, "env body 3"]:
        return self._batch.cvel[:, self._body_ids, :3]

    def _body_linvel(self) -> Float[Array, "env body 3"]:
        """Move MuJoCo's spatial velocity from the centre of mass of the kinematic tree to the body frame's origin."""
        angular, linear = self._body_angvel(), self._batch.cvel[:, self._body_ids, 3:]
        return linear + np.cross(angular, self._body_pos() - self._batch.subtree_com[:, self._root_ids])


_READERS: dict[str, Callable[[BatchReader], Array]] = {
    "body_pos": BatchReader._body_pos,
    "body_quat": BatchReader._body_quat,
    "body_linvel": BatchReader._body_linvel,
    "body_angvel": BatchReader._body_angvel,
}
